"""Training reward models: an ensemble whose members differ in their heads and their orders of the data, in one compiled program."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from thorndike.errors import UserError
from thorndike.language.comparisons import ComparisonBatch, ComparisonData
from thorndike.language.decoder import Params
from thorndike.language.learner import Learner, State
from thorndike.language.model_config import ModelConfig
from thorndike.language.reward_model import Config, score_batch
from thorndike.language.reward_report import HeldOut, held_out_report
from thorndike.types import Metrics

Log = Callable[[int, dict[str, list[float]]], None]
"""Gradient steps so far, and each member's metrics."""


def as_one(learner: Learner, members: int) -> Learner:
    """So many independent reward models on one trunk as one learner; its batches have an axis of members in front, ``params`` gives a list.

    Members run one after the other inside one program: on a CPU a matrix product with an axis of members in front is slower.
    """

    def init(params: Params, key: Key[Array, ""]) -> State:
        keys = jax.random.split(key, members)
        return State(jax.jit(lambda ks: jax.lax.map(lambda key: learner.init(params, key), ks))(keys), (), jnp.int32(0))

    def update(state: State, frozen: Params, batches: ComparisonBatch) -> tuple[State, Metrics]:
        states, metrics = jax.lax.map(lambda each: learner.update(each[0], frozen, each[1]), (state.trained, batches))
        return State(states, (), state.step + 1), metrics

    def evaluate(state: State, frozen: Params, batches: ComparisonBatch) -> Metrics:
        found: Metrics = jax.lax.map(lambda each: learner.evaluate(each[0], frozen, each[1]), (state.trained, batches))
        return found

    def params(state: State, frozen: Params) -> list[Params]:
        return [learner.params(_member(state.trained, number), frozen) for number in range(members)]

    return Learner(init, update, evaluate, params, learner.frozen)


def passes(data: ComparisonData, config: Config, members: int, seed: int) -> Callable[[int, State], ComparisonBatch]:
    """The batch of a step, of every member: in passes over the data, each member's in an order of its own.

    Raises ``UserError`` where there are fewer comparisons than a step takes.
    """
    rows = len(data.valid)
    if rows < config.batch_size:
        raise UserError(f"{rows} comparisons do not fill a batch of batch_size = {config.batch_size}: lower it")
    orders = [_order(np.random.default_rng([seed, member]), rows, config) for member in range(members)]
    return lambda step, state: data.rows(np.stack([order[step] for order in orders]))


def fit(
    learner: Learner, config: Config, params: Params, data: ComparisonData, *, members: int = 1, seed: int = 0, log: Log | None = None
) -> list[Params]:
    """The parameters of each member after ``config.total_steps`` steps. Raises ``UserError`` where ``passes`` does."""
    batch, joint = passes(data, config, members, seed), as_one(learner, members)
    state, frozen, update = joint.init(params, jax.random.key(seed)), joint.frozen(params), jax.jit(joint.update, donate_argnums=0)
    for step in range(config.total_steps):
        state, metrics = update(state, frozen, batch(step, state))
        if log is not None:
            log(step + 1, {name: np.asarray(value).tolist() for name, value in metrics.items()})
    return list(joint.params(state, params))


def steps_of_an_epoch(rows: int, batch_size: int, epochs: int = 1) -> int:
    """Gradient steps of passes over the data; a last part that fills no batch is left out, of another order each pass."""
    return max(1, epochs * (rows // batch_size))


def scores_of(
    members: list[Params], config: ModelConfig, data: ComparisonData, pool: str, batch_size: int = 64
) -> Float[np.ndarray, "E R K"]:
    """The rewards of all texts by each member."""
    rows = len(data.valid)
    score = jax.jit(lambda params, batch: score_batch(params, config, batch, pool))
    found = []
    for start in range(0, rows, batch_size):
        numbers = np.minimum(np.arange(start, start + batch_size), rows - 1)
        batch = data.rows(numbers)
        found.append(np.stack([np.asarray(score(params, batch)) for params in members]))
    return np.concatenate(found, axis=1)[:, :rows]


def report_on(scores: Float[np.ndarray, "R K"], data: ComparisonData) -> HeldOut:
    """Held-out accuracy of rewards; the evidence is that of so many comparisons, not of so many pairs."""
    counts = data.weight > 0
    first, second = (np.take_along_axis(scores, index, axis=1)[counts] for index in (data.first, data.second))
    sure = counts & (data.p_first != 0.5)
    return held_out_report(first, second, data.p_first[counts], independent=_independent(data, sure))


def _independent(data: ComparisonData, sure: np.ndarray) -> int:
    """K texts that are compared with each other tell at most K - 1 independent pairs."""
    return int(np.minimum(sure.sum(axis=1), np.maximum(data.valid.sum(axis=1) - 1, 1))[sure.any(axis=1)].sum()) or 1


def _member(states: State, number: int) -> State:
    return jax.tree.map(lambda leaf: leaf[number], states)


def _order(generator: np.random.Generator, rows: int, config: Config) -> np.ndarray:
    per_epoch = rows // config.batch_size
    epochs = -(-config.total_steps // per_epoch)
    orders = [generator.permutation(rows)[: per_epoch * config.batch_size].reshape(per_epoch, -1) for _ in range(epochs)]
    return np.concatenate(orders)
