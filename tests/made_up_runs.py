"""Run directories with the scores a test wants, written in a millisecond: nothing is trained."""

import json


def write_run(
    directory,
    scores=(),
    *,
    algorithm="ppo",
    environment="CartPole-v1",
    seed=0,
    episodes=2,
    steps=1000,
    curves=None,
    status="finished",
    config=None,
    **facts,
):
    """A run with one recorded evaluation: each seed's mean return is its number in ``scores``; ``curves [points][seeds]`` are logged."""
    seeds = len(scores) or facts.pop("seeds", 1)
    policy = directory / "policy"
    policy.mkdir(parents=True)
    (policy / "manifest.json").write_text("{}")
    told = {"format": 1, "algorithm": algorithm, "environment": environment, "env_kwargs": {}, "max_episode_steps": None, "status": status}
    told |= {"config": config or {"gamma": 0.99}, "seeds": seeds, "seed": seed, "steps": steps, "steps_done": steps, "num_envs": 1}
    (directory / "run.json").write_text(json.dumps(told | {"wrappers": [], "network": "default"} | facts))
    if scores:
        write_evaluation(directory, scores, episodes)
    points = enumerate(curves or [], start=1)
    rows = [{"steps": number * 100, "rollout/ep_rew_mean": list(values)} for number, values in points]
    if rows:
        (directory / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return directory


def write_evaluation(directory, scores, episodes=2, deterministic=True):
    """Append an evaluation in which every episode of a seed but the first two returns its score, and these differ by 2."""
    offsets = [1.0, -1.0, *[0.0] * episodes][:episodes] if episodes > 1 else [0.0]
    rows = [
        {"evaluation_seed": 0, "deterministic": deterministic, "seed": seed, "episode": number, "return": score + offset, "length": 9}
        for seed, score in enumerate(scores)
        for number, offset in enumerate(offsets)
    ]
    with (directory / "evaluations.jsonl").open("a") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)
