"""Stable-Baselines3 PPO on Pong, the settings of task ``pong``: NatureCNN, 8 games in one process (DummyVecEnv)."""

from measurement import cpu_seconds
from sb3_atari import NUM_ENVS, pong
from sb3_window import measure, parse
from settings import PPO_PONG as SETTINGS
from stable_baselines3 import PPO

if __name__ == "__main__":
    options = parse(default_steps=3_072)
    import_cpu_s = cpu_seconds()
    env = pong(options.seed)
    model = PPO("CnnPolicy", env, seed=options.seed, device="cpu", policy_kwargs={"net_arch": {"pi": [], "vf": []}}, **SETTINGS)
    measure(model, options.steps, warm_up=NUM_ENVS * 128, import_cpu_s=import_cpu_s)
