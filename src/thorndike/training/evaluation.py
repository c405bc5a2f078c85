"""Evaluation on fresh reference environments: the final policy, every seed, a fixed number of episodes of each environment."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.statistics import summary
from thorndike.training.host_source import HostEngine, environment_seeds
from thorndike.training.policy import Policy
from thorndike.training.sources import to_environment, where_done

_EVALUATION = 0x45564131
"""Separates the seeds of evaluation from those of training, whatever the run's seed is."""


class Episode(NamedTuple):
    """One evaluated episode, a line of evaluations.jsonl."""

    seed: int
    episode: int
    return_: float
    length: int
    terminated: bool


class Evaluation(NamedTuple):
    """What an evaluation found. ``iqm``, ``min`` and ``ci95`` are over the seeds' means."""

    run: Path | None
    environment: str
    episodes: int
    """Episodes of each seed."""
    mean: float
    iqm: float
    min: float
    ci95: tuple[float, float]
    """95 % interval of the mean, by stratified bootstrap over seeds (over episodes where there is one seed)."""
    per_seed: tuple[float, ...]
    rows: tuple[Episode, ...]


def evaluate(
    policy: Policy, build: Callable[[int], HostEngine], episodes: int = 100, seed: int = 0, num_envs: int = 20, deterministic: bool = True
) -> Evaluation:
    """Run every seed of ``policy`` for ``episodes`` episodes on an engine of ``build(number of environments)``.

    Each environment plays the same number of episodes, so that short episodes are not over-represented.
    """
    seeds = policy.number_of_seeds
    num_envs = max(n for n in range(1, min(num_envs, episodes) + 1) if episodes % n == 0)
    engine = build(seeds * num_envs)
    try:
        rows = _play(policy, engine, seeds, num_envs, episodes // num_envs, seed, deterministic)
    finally:
        engine.close()
    returns = np.array([[row.return_ for row in rows if row.seed == i] for i in range(seeds)])
    found = summary(returns)
    return Evaluation(
        policy.run, engine.spec.id, episodes, found.mean, found.iqm, found.min, found.ci95, tuple(found.per_seed), tuple(rows)
    )


def _play(policy: Policy, engine: HostEngine, seeds: int, num_envs: int, each: int, seed: int, deterministic: bool) -> list[Episode]:
    algorithm, wrapper = policy.algorithm, policy.wrapper
    choose = algorithm.greedy if deterministic else algorithm.act

    def decide(actor, memory, seen, noise):  # noqa: ANN001, ANN202
        memory, action, _ = choose(actor, memory, seen, noise)
        return memory, to_environment(policy.spec.action_space, action)

    decide_all, see = jax.jit(jax.vmap(decide)), jax.jit(jax.vmap(wrapper.step))
    forget = jax.jit(jax.vmap(lambda done, memory: where_done(done, algorithm.memory(num_envs), memory)))
    noise_of = jax.jit(lambda t: _noise(policy, seed, t, seeds, num_envs))

    def by_seed(x: np.ndarray) -> np.ndarray:
        return x.reshape((seeds, num_envs, *x.shape[1:]))

    obs = jax.tree.map(by_seed, engine.reset(environment_seeds(seed, range(seeds), num_envs, _EVALUATION)))
    wrapper_memory, seen = jax.jit(jax.vmap(wrapper.init))(policy.statistics, obs)
    memory = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *x.shape)), algorithm.memory(num_envs))
    total, age = np.zeros((seeds, num_envs)), np.zeros((seeds, num_envs), np.int64)
    played = np.zeros((seeds, num_envs), np.int64)
    rows: list[Episode] = []
    noise = noise_of(0)
    for t in range(1, 2**62):
        memory, action = decide_all(policy.actors, memory, seen, noise)
        host_action = np.asarray(action)
        raw = jax.tree.map(by_seed, engine.step(host_action.reshape((seeds * num_envs, *host_action.shape[2:]))))
        total += raw.reward * raw.valid
        age += raw.valid
        for s, e in np.argwhere(raw.done & raw.valid):
            if played[s, e] < each:
                rows.append(Episode(int(s), int(e * each + played[s, e]), float(total[s, e]), int(age[s, e]), bool(raw.terminated[s, e])))
            played[s, e] += 1
            total[s, e], age[s, e] = 0.0, 0
        if (played >= each).all():
            break
        wrapper_memory, step = see(policy.statistics, wrapper_memory, obs, action, raw)
        if jax.tree.leaves(memory):
            memory = forget(raw.done, memory)
        obs, seen = raw.obs, step.obs
        noise = noise if deterministic else noise_of(np.int32(t))
    return sorted(rows)


def _noise(policy: Policy, seed: int, t: int, seeds: int, num_envs: int):  # noqa: ANN202
    """Noise ``[S, N, ...]`` of one step; the algorithm draws ``[steps, its own number of environments]``."""
    each = policy.spec.num_envs
    steps = -(-num_envs // each)
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), _EVALUATION), t)
    drawn = jax.vmap(lambda k: policy.algorithm.draw(k, steps))(jax.random.split(key, seeds))
    return jax.tree.map(lambda x: x.reshape((seeds, steps * each, *x.shape[3:]))[:, :num_envs], drawn)
