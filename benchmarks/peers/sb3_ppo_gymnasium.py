"""Stable-Baselines3 PPO on Gymnasium's own CartPole-v1, the settings of task ``gymnasium``: 8 environments in one process (DummyVecEnv)."""

from measurement import cpu_seconds
from sb3_window import measure, parse
from settings import PPO_GYMNASIUM as SETTINGS
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

if __name__ == "__main__":
    options = parse(default_steps=30_720)
    import_cpu_s = cpu_seconds()
    env = make_vec_env("CartPole-v1", n_envs=8, seed=options.seed)
    model = PPO("MlpPolicy", env, seed=options.seed, device="cpu", policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}}, **SETTINGS)
    measure(model, options.steps, warm_up=2 * 1024, import_cpu_s=import_cpu_s)
