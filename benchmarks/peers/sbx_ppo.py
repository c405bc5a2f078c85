"""SBX PPO on CartPole-v1, the settings of task ``ppo``: 4 environments in one process (DummyVecEnv)."""

from measurement import cpu_seconds
from sb3_window import measure, parse
from sbx import PPO
from settings import PPO as SETTINGS
from stable_baselines3.common.env_util import make_vec_env

if __name__ == "__main__":
    options = parse(default_steps=20_480)
    import_cpu_s = cpu_seconds()
    env = make_vec_env("CartPole-v1", n_envs=4, seed=options.seed)
    model = PPO("MlpPolicy", env, seed=options.seed, device="cpu", policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}}, **SETTINGS)
    measure(model, options.steps, warm_up=4 * 512, import_cpu_s=import_cpu_s)
