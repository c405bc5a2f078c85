"""The settings of the tasks in the words of Stable-Baselines3; SBX takes the same names."""

PPO = {
    "learning_rate": 2.5e-4,
    "n_steps": 128,
    "batch_size": 128,
    "n_epochs": 4,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.01,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}
PPO_GYMNASIUM = {**PPO, "batch_size": 256}
DQN = {
    "learning_rate": 2.5e-4,
    "buffer_size": 10_000,
    "learning_starts": 1_000,
    "batch_size": 128,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "target_update_interval": 500,
    "exploration_fraction": 0.5,
    "exploration_final_eps": 0.05,
}
CONTINUOUS = {
    "learning_rate": 3e-4,
    "buffer_size": 100_000,
    "learning_starts": 100,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
}
# RL Baselines3 Zoo, hyperparams/ppo.yml, CartPole-v1: 100,000 steps, both rates falling linearly to 0.
PPO_ZOO = {"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20, "ent_coef": 0.0}
PPO_ZOO_ENVS = 8
PPO_ZOO_STEPS = 100_000


def ppo_zoo() -> dict[str, object]:
    """The zoo's settings with its two schedules (functions of the remaining progress, 1 to 0)."""
    return {**PPO_ZOO, "learning_rate": lambda remaining: 1e-3 * remaining, "clip_range": lambda remaining: 0.2 * remaining}
