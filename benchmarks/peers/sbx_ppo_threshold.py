"""SBX PPO on CartPole-v1 to a mean return of 475 over 100 episodes, with the RL Baselines3 Zoo's settings."""

from measurement import cpu_seconds
from sb3_window import measure_threshold, parse
from sbx import PPO
from settings import PPO_ZOO_ENVS, PPO_ZOO_STEPS, ppo_zoo
from stable_baselines3.common.env_util import make_vec_env

if __name__ == "__main__":
    options = parse(default_steps=PPO_ZOO_STEPS)
    import_cpu_s = cpu_seconds()
    env = make_vec_env("CartPole-v1", n_envs=PPO_ZOO_ENVS, seed=options.seed)
    model = PPO("MlpPolicy", env, seed=options.seed, device="cpu", **ppo_zoo())
    measure_threshold(model, options.steps, threshold=475.0, import_cpu_s=import_cpu_s)
