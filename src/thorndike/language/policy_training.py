"""The loop of PPO, GRPO and RLOO: write texts, score them, look whether all is well, learn. It goes on bit for bit where it was cut off.

Writing, measuring and learning are a compiled program each; only scoring, which may be any Python function, is on the host. Every key
follows from the seed and the iteration's number.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from thorndike.language.decoder import Params
from thorndike.language.lora import LowRank
from thorndike.language.model import LanguageModel, stop_tokens
from thorndike.language.over_optimisation import Limits, Signals, mean_disagreement, mean_repetition, trouble, watched
from thorndike.language.policy_descent import check_ratio
from thorndike.language.policy_files import Log, Progress, load_progress, save_progress, set_outcome
from thorndike.language.policy_learner import PolicyLearner
from thorndike.language.rewards import Score, checked_scores
from thorndike.language.rollouts import (
    Distance,
    Prompts,
    Rollout,
    Written,
    as_written,
    choose_prompts,
    distance,
    distance_metrics,
    sample_rollout,
    scored,
)
from thorndike.training.run_lock import run_lock
from thorndike.training.stopping import stop_requests

Members = Callable[[Written], Float[np.ndarray, "E B"]]
"""The scores of each member of an ensemble of reward models."""
Told = Callable[[int, dict[str, float]], None]
"""Called with every iteration's number and metrics."""


class LoopConfig(Protocol):
    """What the loop needs to know of a learner's settings."""

    @property
    def total_steps(self) -> int:
        """Iterations of the run."""
        ...

    @property
    def episodes(self) -> int:
        """Texts of an iteration."""
        ...

    @property
    def max_new_tokens(self) -> int:
        """Tokens of a completion at most."""
        ...

    @property
    def temperature(self) -> float:
        """Of sampling."""
        ...

    @property
    def missing_eos_penalty(self) -> float | None:
        """Taken off the score of a text that did not end."""
        ...


@dataclass(frozen=True)
class Task:
    """What a policy is trained on."""

    base: LanguageModel
    prompts: Prompts
    score: Score
    members: Members | None = None
    shown: Mapping[str, Score] = field(default_factory=dict)
    """Scores that are logged and not learnt from, by name."""


NO_MORE_THAN_USUAL = Limits()
"""The limits of a run that names none."""


class Outcome(NamedTuple):
    """What came of it."""

    params: Params
    """The last that kept all limits."""
    iterations: int
    kl: float
    """Of these parameters, nats a text, on the last texts that they wrote in training."""
    stopped: str | None
    """Which limit ended the run, in words; None if none did."""
    finished: bool
    """False where it was interrupted, or paused: called again, it goes on."""
    adapter: LowRank | None
    """That makes these parameters of the base; None where all are learnt, or the run was begun by a version that kept none."""


class Kept(NamedTuple):
    """The last policy that kept all limits."""

    params: Params
    kl: Float[Array, ""]
    adapter: LowRank | None


class Iteration(NamedTuple):
    """An iteration's texts and all that was measured of them."""

    rollout: Rollout
    distance: Distance
    score: Float[Array, " B"]
    signals: Signals
    metrics: dict[str, float]


def train_policy(
    task: Task, learner: PolicyLearner, config: LoopConfig, run: Path, *, seed: int = 0, limits: Limits = NO_MORE_THAN_USUAL,
    checkpoint_every: int = 20, until: int | None = None, told: Told | None = None,
) -> Outcome:  # fmt: skip
    """Train to ``config.total_steps`` iterations, or to a limit, from the newest checkpoint in ``run`` if there is one.

    ``until`` pauses before, as an interruption does: called again, it goes on.
    """
    key, began = jax.random.key(seed), time.perf_counter()
    state = learner.init(jax.random.fold_in(key, 2**31 - 1))
    kept = _kept(learner, state, 0.0)
    (state, params, kl), progress, adapter = load_progress(run, (state, kept.params, kept.kl), kept.adapter)
    kept = Kept(params, kl, adapter)
    iteration, watch, stopped = progress.iteration, progress.watch, None

    def save() -> None:
        save_progress(run, (state, kept.params, kept.kl), Progress(iteration, watch, _since(progress, began)), kept.adapter)

    with ExitStack() as stack:
        stack.enter_context(run_lock(run))
        log = Log(run)
        stack.callback(log.close)
        interrupted = stack.enter_context(stop_requests())
        while iteration < config.total_steps:
            if iteration == until or interrupted() is not None:
                save()
                return Outcome(kept.params, iteration, float(kept.kl), None, False, kept.adapter)
            key_write, key_learn = jax.random.split(jax.random.fold_in(key, iteration))
            found = write(task, learner.params(state), config, learner.samples, key_write)
            watch = watched(watch, found.signals)
            stopped = trouble(limits, watch, found.signals)
            if stopped is not None:
                break
            kept = _kept(learner, state, found.signals.kl)
            state, metrics = learner.update(state, found.rollout, found.distance, found.score, key_learn)
            check_ratio(metrics, task.base.config.dtype)
            iteration += 1
            values = found.metrics | {name: float(value) for name, value in metrics.items()}
            log.write(iteration, _since(progress, began), values)
            if told is not None:
                told(iteration, values)
            if iteration % checkpoint_every == 0:
                save()
        if stopped is None:
            # What the last step made has been seen by nobody yet.
            found = write(task, learner.params(state), config, learner.samples, jax.random.fold_in(key, iteration))
            stopped = trouble(limits, watched(watch, found.signals), found.signals)
            if stopped is None:
                kept = _kept(learner, state, found.signals.kl)
        save()
    set_outcome(
        run, {"status": "finished" if stopped is None else "stopped", "iterations": iteration, "kl": float(kept.kl), "why": stopped}
    )
    return Outcome(kept.params, iteration, float(kept.kl), stopped, True, kept.adapter)


def write(task: Task, params: Params, config: LoopConfig, samples: int, key: Key[Array, ""]) -> Iteration:
    """Let the policy write, and measure it."""
    base = task.base
    key_prompts, key_tokens = jax.random.split(key)
    rows = choose_prompts(task.prompts, key_prompts, config.episodes // samples)
    rollout = sample_rollout(
        params, base.config, task.prompts, rows, key_tokens, max_new_tokens=config.max_new_tokens, temperature=config.temperature,
        stop_tokens=stop_tokens(base), pad_id=base.tokenizer.pad_id, samples=samples,
    )  # fmt: skip
    found = distance(params, base.params, base.config, rollout, config.temperature)
    written = as_written(rollout, base.tokenizer)
    raw, score = scored(task.score, written, config.missing_eos_penalty)
    metrics = {name: float(value) for name, value in distance_metrics(rollout, found).items()}
    width = rollout.tokens.shape[1] - rollout.valid.shape[1]
    signals = Signals(
        kl=metrics["objective/kl"],
        repetition=mean_repetition(np.asarray(rollout.tokens)[:, width:], written.lengths),
        length=float(written.lengths.mean()),
        disagreement=None if task.members is None else mean_disagreement(task.members(written)),
    )
    metrics |= {
        "objective/score": float(raw.mean()),
        "objective/score_std": float(raw.std()),
        "rollout/ep_rew_mean": float(score.mean()),
        "rollout/ep_len_mean": signals.length,
        "rollout/repetition": signals.repetition,
        "rollout/ended": float(written.ended.mean()),
    }
    for name, shown in task.shown.items():
        metrics[f"objective/{name}"] = float(checked_scores(shown, written.prompts, written.completions, written.ids).mean())
    if signals.disagreement is not None:
        metrics["objective/disagreement"] = signals.disagreement
    return Iteration(rollout, found, jnp.asarray(score, jnp.float32), signals, metrics)


def _kept(learner: PolicyLearner, state: PyTree, kl: float) -> Kept:
    """Copies, because the learner's own arrays are used up by its next step."""
    params, adapter = jax.tree.map(jnp.copy, (learner.params(state), learner.adapter(state)))
    return Kept(params, jnp.float32(kl), adapter)


def _since(progress: Progress, began: float) -> float:
    return progress.wall_s + time.perf_counter() - began
