"""DPO: a policy learnt from comparisons directly, the reward being its log-probability beside the reference's.

Rafailov et al. 2023 (arXiv:2305.18290); label smoothing (cDPO): Mitchell 2023; robust DPO: Chowdhury et al. 2024 (arXiv:2403.00409); IPO:
Azar et al. 2023 (arXiv:2310.12036). Deviations:

1. Soft labels: a pair that is right with probability p is learnt as p times itself and (1 - p) times its opposite.
2. The reference's log-probabilities are computed once, before learning.
3. A pair's prompt is read with each of its completions.

Logs ``train/loss``, ``train/accuracy`` (the implicit reward prefers the better one), ``train/reward_margin``, ``train/chosen_log_prob`` and
``train/rejected_log_prob`` relative to the reference (both may fall, the margin is what rises), ``train/grad_norm``,
``train/learning_rate``.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from thorndike.errors import UserError
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.preference_losses import DpoLoss, dpo_loss
from thorndike.language.comparisons import ComparisonBatch, ComparisonData
from thorndike.language.decoder import Params, hidden_states, token_log_probs
from thorndike.language.learner import Learner, State, accumulated, adamw, descend, rate_at, what_is_trained
from thorndike.language.lora import LoraConfig
from thorndike.language.model_config import ModelConfig
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.training.devices import rows_shared
from thorndike.types import Metrics


@dataclass(frozen=True)
class Config:
    """Settings of DPO."""

    total_steps: Annotated[int, AtLeast(1)] = 1000  # gradient steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = "linear(5e-6, 0)"  # AdamW's step size, or a schedule
    warmup_fraction: Annotated[float, Between(0, 1)] = 0.1  # of the run, over which the rate rises from 0
    batch_size: Annotated[int, AtLeast(1)] = 32  # comparisons of a gradient step
    gradient_accumulation: Annotated[int, AtLeast(1)] = 1  # parts of a step, one in memory at a time
    beta: Annotated[float, MoreThan(0)] = 0.1  # how strongly the policy is held to the reference
    loss: Annotated[str, OneOf("sigmoid", "robust", "ipo")] = "sigmoid"  # see functional/preference_losses.py
    label_smoothing: Annotated[float, Between(0, 0.49)] = 0.0  # the share of labels that are wrong
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # a longer gradient is made this long
    remat: bool = False  # compute activations again in the backward pass: less memory, a third more time

    def __post_init__(self) -> None:
        check(self)
        if self.loss == "ipo" and self.label_smoothing:
            raise UserError(f"dpo: the loss ipo takes no label_smoothing; got {self.label_smoothing}")
        if self.batch_size % self.gradient_accumulation:
            raise UserError(f"dpo: batch_size {self.batch_size} does not divide into {self.gradient_accumulation} parts")


class Batch(NamedTuple):
    """Comparisons, and the reference's log-probability of every completion."""

    comparisons: ComparisonBatch
    reference: Float[Array, "R K"]


def completion_log_probs(params: Params, config: ModelConfig, batch: ComparisonBatch, remat: bool = False) -> Float[Array, "R K"]:
    """The log-probability of each completion given its prompt: the sum over its tokens."""
    rows, texts, width = batch.tokens.shape
    tokens, segments = batch.tokens.reshape(-1, width), batch.segments.reshape(-1, width)
    hidden = hidden_states(params, config, tokens, segments, remat)
    log_probs = token_log_probs(params, config, hidden[:, :-1], tokens[:, 1:])
    begins = jnp.repeat(batch.prompt_lengths, texts)[:, None]
    learn = (segments[:, 1:] > 0) & (jnp.arange(1, width)[None] >= begins)
    return jnp.sum(jnp.where(learn, log_probs, 0.0), axis=1).reshape(rows, texts)


def preference_loss(log_probs: Float[Array, "R K"], batch: Batch, config: Config) -> tuple[Float[Array, ""], Metrics]:
    """The loss of the policy's log-probabilities, and what is logged of it."""
    pairs = batch.comparisons
    implicit = log_probs - batch.reference
    first, second = (jnp.take_along_axis(implicit, index, axis=1) for index in (pairs.first, pairs.second))
    margin = first - second
    either = (
        dpo_loss(sign * margin, pairs.weight * share, config.beta, cast(DpoLoss, config.loss), config.label_smoothing)
        * jnp.sum(pairs.weight * share)
        for sign, share in ((1.0, pairs.p_first), (-1.0, 1.0 - pairs.p_first))
    )
    loss = sum(either, jnp.zeros(())) / jnp.maximum(jnp.sum(pairs.weight), 1e-8)
    right_way, sure = jnp.sign(pairs.p_first - 0.5), pairs.weight * (pairs.p_first != 0.5)
    better, worse = jnp.where(right_way > 0, first, second), jnp.where(right_way > 0, second, first)
    metrics = {
        "train/loss": loss,
        "train/accuracy": weighted_mean((better > worse).astype(jnp.float32), sure),
        "train/reward_margin": config.beta * weighted_mean(better - worse, sure),
        "train/chosen_log_prob": weighted_mean(better, sure),
        "train/rejected_log_prob": weighted_mean(worse, sure),
    }
    return loss, metrics


def dpo(config: Config, model_config: ModelConfig, lora: LoraConfig | None = None) -> Learner:
    """DPO for all parameters or an adapter's; its batches are ``Batch``."""
    optimizer = adamw(0.9, 0.999, 1e-8, 0.0, config.max_grad_norm)
    trained = what_is_trained(model_config, lora)

    def init(params: Params, key: Key[Array, ""]) -> State:
        begin = trained.begin(params, key)
        return State(begin, optimizer.init(begin), jnp.int32(0))

    def update(state: State, frozen: Params, batch: Batch) -> tuple[State, Metrics]:
        total = jnp.maximum(jnp.sum(batch.comparisons.weight), 1e-8)

        def loss(learnt: Params, part: Batch) -> tuple[Float[Array, ""], Metrics]:
            found = completion_log_probs(trained.params(learnt, frozen), model_config, part.comparisons, config.remat)
            mean, metrics = preference_loss(found, part, config)
            share = jnp.sum(part.comparisons.weight) / total
            return mean * share, {name: value * share for name, value in metrics.items()}

        gradient, metrics = accumulated(loss, state.trained, batch, config.gradient_accumulation)
        rate = rate_at(config.learning_rate, config.warmup_fraction, state.step, config.total_steps)
        after, norm = descend(optimizer, rate, state, gradient)
        return after, metrics | {"train/grad_norm": norm, "train/learning_rate": rate}

    def evaluate(state: State, frozen: Params, batch: Batch) -> Metrics:
        found = completion_log_probs(trained.params(state.trained, frozen), model_config, batch.comparisons)
        return {name.replace("train/", "eval/"): value for name, value in preference_loss(found, batch, config)[1].items()}

    return Learner(init, update, evaluate, lambda state, frozen: trained.params(state.trained, frozen), trained.frozen)


def reference_log_probs(params: Params, config: ModelConfig, data: ComparisonData, batch_size: int = 32) -> Float[np.ndarray, "R K"]:
    """What the reference says of every completion: once, for all passes over the data."""
    rows = len(data.valid)
    compute = jax.jit(lambda params, batch: completion_log_probs(params, config, batch))
    parts = []
    for start in range(0, rows, batch_size):
        numbers: Int[np.ndarray, " n"] = np.minimum(np.arange(start, start + batch_size), rows - 1)
        parts.append(np.asarray(compute(params, rows_shared(data.rows(numbers)))))
    return np.concatenate(parts)[:rows]
