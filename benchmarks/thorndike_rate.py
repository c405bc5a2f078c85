"""Thorndike's contestant of a rate task: ``thorndike.api.train`` in a process of its own.

The rate is taken from the run's own ``metrics.jsonl``, between the first log point past a fifth of the run (by then everything is
compiled) and the last one; what ``train`` itself says of the whole run is reported beside it.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent / "peers"))
from measurement import cpu_seconds, report


class Job(NamedTuple):
    """What is trained in a task: the settings of ``contestants.py`` in Thorndike's words."""

    algorithm: str
    environment: str
    steps: int
    num_envs: int | None
    settings: Mapping[str, object]
    engine: str = "auto"
    flat: bool = False
    """Whether images go through a plain multilayer perceptron, as the peer's do."""


PPO: dict[str, object] = {
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
    "net_arch": (64, 64),
}
DQN = {
    "learning_rate": 2.5e-4,
    "buffer_size": 10_000,
    "learning_starts": 1_000,
    "batch_size": 128,
    "gamma": 0.99,
    "train_freq": 10,
    "gradient_steps": 1,
    "target_update_interval": 500,
    "net_arch": (120, 84),
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
    "net_arch": (256, 256),
}
Q_LEARNING = {"learning_rate": 0.1, "gamma": 0.99, "exploration_fraction": 0.5, "exploration_final_eps": 0.1}
JOBS = {
    "ppo": Job("ppo", "CartPole-v1", 1_024_000, 4, PPO),
    "dqn": Job("dqn", "CartPole-v1", 300_000, 10, DQN),
    "q_learning": Job("q_learning", "FrozenLake-v1", 2_000_000, 1, Q_LEARNING),
    "sac": Job("sac", "HalfCheetah-v5", 8_000, 1, CONTINUOUS),
    "td3": Job("td3", "HalfCheetah-v5", 8_000, 1, CONTINUOUS),
    "minatar_ppo": Job("ppo", "MinAtar/Breakout-v1", 409_600, 64, {**PPO, "batch_size": 2_048}, flat=True),
    "minatar_dqn": Job("dqn", "MinAtar/Breakout-v1", 200_000, 10, {**DQN, "net_arch": (64, 64)}, flat=True),
    "gymnasium": Job("ppo", "CartPole-v1", 102_400, 8, {**PPO, "batch_size": 256}, engine="gymnasium"),
}


def perceptron(job: Job):
    """The builder of a network that sees an image as one row of numbers; hidden layers as the job's own would be."""
    import gymnasium

    from thorndike.networks.heads import actor_critic, q_values
    from thorndike.networks.network import Network

    def build(spec, outputs: int) -> Network:
        row = gymnasium.spaces.Box(0, 1, (spec.observation_space.shape[0] ** 2 * spec.observation_space.shape[-1],))
        hidden = job.settings["net_arch"]
        net = actor_critic(row, outputs, 0, hidden, "tanh") if job.algorithm == "ppo" else q_values(row, outputs, hidden, "relu")

        def flat(obs):
            return obs.reshape((obs.shape[0], -1)).astype("float32")

        return Network(lambda key, obs: net.init(key, flat(obs)), lambda params, obs: net.apply(params, flat(obs)))

    return build


def log_points(run: Path) -> list[dict]:
    """The lines of a run's metrics.jsonl."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def steady(points: list[dict]) -> dict[str, float]:
    """Steps, wall and CPU-seconds from the first log point past a fifth of the run to the last.

    Raises:
        ValueError: fewer than three log points.
    """
    if len(points) < 3:
        raise ValueError(f"expected at least 3 log points, got {len(points)}: train for longer")
    last = points[-1]
    first = next(point for point in points if point["steps"] >= last["steps"] / 5)
    return {name: last[name] - first[name] for name in ("steps", "wall_s", "cpu_s")}


def main() -> None:
    """Train the job of the task named on the command line and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=JOBS)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    from thorndike import api

    import_cpu_s = cpu_seconds()
    job = JOBS[options.task]
    with tempfile.TemporaryDirectory() as folder:
        result = api.train(
            job.algorithm,
            job.environment,
            steps=options.steps or job.steps,
            seeds=options.seeds,
            seed=options.seed,
            num_envs=job.num_envs,
            settings=job.settings,
            preset="none",
            engine=job.engine,
            network=perceptron(job) if job.flat else None,
            device="cpu",
            output=folder,
        )
        points = log_points(result.run)
    found = steady(points)
    found["steps"] *= options.seeds
    report(
        **found,
        compile_s=result.compile_s,
        import_cpu_s=import_cpu_s,
        whole_run={
            "steps_per_s": result.steps_per_s,
            "steps_per_cpu_s": result.steps_per_cpu_s,
            "wall_s": result.wall_s,
            "cpu_s": result.cpu_s,
        },
        mean_return=result.mean_return,
    )


if __name__ == "__main__":
    main()
