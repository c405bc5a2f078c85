"""SBX SAC or TD3 on HalfCheetah-v5, the settings of tasks ``sac`` and ``td3``: one update an environment step."""

import argparse

import gymnasium
from measurement import cpu_seconds
from sb3_window import measure
from sbx import SAC, TD3
from settings import CONTINUOUS

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("algorithm", choices=("sac", "td3"))
    parser.add_argument("--steps", type=int, default=3_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    import_cpu_s = cpu_seconds()
    model = {"sac": SAC, "td3": TD3}[options.algorithm](
        "MlpPolicy",
        gymnasium.make("HalfCheetah-v5"),
        seed=options.seed,
        device="cpu",
        policy_kwargs={"net_arch": [256, 256]},
        **CONTINUOUS,
    )
    measure(model, options.steps, warm_up=1_000, import_cpu_s=import_cpu_s)
