"""Stable-Baselines3's and SBX's contestants: a callback that takes the moments, and one that stops at a mean return.

SBX runs Stable-Baselines3's own loop, so both are measured by the same lines.
"""

import argparse

from measurement import Moment, now, report, window
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback


class Window(BaseCallback):
    """From the first rollout after ``warm_up`` environment steps to the end of the last update."""

    def __init__(self, warm_up: int) -> None:
        """Args: warm_up: environment steps ahead of the window (compilation, filling of the replay buffer)."""
        super().__init__()
        self.warm_up = warm_up
        self.start: Moment | None = None
        self.end: Moment | None = None

    def _on_rollout_start(self) -> None:
        if self.start is None and self.num_timesteps >= self.warm_up:
            self.start = now(self.num_timesteps)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.end = now(self.num_timesteps)


class Threshold(BaseCallback):
    """Stops when the mean return of the last 100 episodes reaches ``threshold``; looked at once a rollout."""

    def __init__(self, threshold: float) -> None:
        """Args: threshold: mean return at which the run counts as solved."""
        super().__init__()
        self.threshold = threshold
        self.reached: Moment | None = None
        self.curve: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        return self.reached is None

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer]
        if not returns:
            return
        mean = float(sum(returns) / len(returns))
        self.curve.append((self.num_timesteps, mean))
        if len(returns) == 100 and mean >= self.threshold and self.reached is None:
            self.reached = now(self.num_timesteps)


def parse(default_steps: int) -> argparse.Namespace:
    """The options every contestant takes: ``--steps`` and ``--seed``."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=default_steps)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def measure(model: BaseAlgorithm, steps: int, warm_up: int, import_cpu_s: float) -> None:
    """Learn ``warm_up + steps`` environment steps and report the window."""
    began = now()
    callback = Window(warm_up)
    model.learn(warm_up + steps, callback=callback)
    if callback.start is None or callback.end is None:
        raise ValueError(f"no window: {model.num_timesteps} steps were made, the warm-up is {warm_up}")
    warm_up_cpu_s = callback.start.cpu - began.cpu
    report(**window(callback.start, callback.end), compile_s=None, warm_up_cpu_s=warm_up_cpu_s, import_cpu_s=import_cpu_s)


def measure_threshold(model: BaseAlgorithm, steps: int, threshold: float, import_cpu_s: float) -> None:
    """Learn until the threshold, at most ``steps`` environment steps, and report when it was reached (CPU-seconds from process start)."""
    callback = Threshold(threshold)
    model.learn(steps, callback=callback)
    reached = callback.reached
    report(
        steps=model.num_timesteps if reached is None else reached.steps,
        reached=reached is not None,
        cpu_s=None if reached is None else reached.cpu,
        reached_at=None if reached is None else reached.wall,
        curve=callback.curve[:: max(len(callback.curve) // 50, 1)],
        import_cpu_s=import_cpu_s,
    )
