"""SBX DQN on CartPole-v1, the settings of task ``dqn``: 10 environments, one update each 10 environment steps.

SBX 0.28.0 builds both hidden layers with the first width, so its network is 120-120 instead of 120-84.
"""

from measurement import cpu_seconds
from sb3_window import measure, parse
from sbx import DQN
from settings import DQN as SETTINGS
from stable_baselines3.common.env_util import make_vec_env

if __name__ == "__main__":
    options = parse(default_steps=15_000)
    import_cpu_s = cpu_seconds()
    env = make_vec_env("CartPole-v1", n_envs=10, seed=options.seed)
    model = DQN("MlpPolicy", env, seed=options.seed, device="cpu", policy_kwargs={"net_arch": [120]}, **SETTINGS)
    measure(model, options.steps, warm_up=3_000, import_cpu_s=import_cpu_s)
