"""Reward model: a scalar head on a language model, learnt from comparisons of texts.

Stiennon et al. 2020 (arXiv:2009.01325), section 3.4; Ouyang et al. 2022 (arXiv:2203.02155), section 3.5. Deviations:

1. Labels may be soft (raters that err, ties) and weighted; the papers know certain ones only.
2. Rankings may be learnt by Plackett-Luce's likelihood (``loss="plackett_luce"``) instead of all their pairs.
3. The head may read the mean of all tokens (``pool="mean"``): models of a few million parameters learn little from the last token alone.
4. Rewards are drawn towards 0 by ``(r_a + r_b)^2`` (Eisenstein et al. 2023, arXiv:2312.09244), and shifted and scaled to mean 0 and
   deviation 1 on samples of the base once learning is over: see ``reward_files.py``.

Logs ``train/loss``, ``train/accuracy`` (of the minibatch's pairs that are no ties), ``train/reward_margin``, ``train/grad_norm``,
``train/learning_rate``.
"""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from thorndike.errors import UserError
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.preference_losses import bradley_terry_loss, centring_penalty, plackett_luce_loss
from thorndike.language.comparisons import ComparisonBatch
from thorndike.language.decoder import Params
from thorndike.language.learner import Learner, State, accumulated, adamw, descend, rate_at
from thorndike.language.lora import Adapter, LoraConfig, initial_adapter, merged
from thorndike.language.model_config import ModelConfig
from thorndike.language.scalar_head import text_scores, with_scalar_head
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Metrics

HELD_LEARNING_RATE = 2e-3
"""What models 128 wide learn with (measured); narrower steps for wider ones."""


@dataclass(frozen=True)
class Config:
    """Settings of a reward model."""

    total_steps: Annotated[int, AtLeast(1)] = 1000  # gradient steps of the run; a pass over the data is usual
    learning_rate: Annotated[float | str | None, AtLeast(0)] = None  # Adam's, or a schedule; None: linear to 0, from a start by width
    batch_size: Annotated[int, AtLeast(1)] = 32  # comparisons of a gradient step
    gradient_accumulation: Annotated[int, AtLeast(1)] = 1  # parts of a step, one in memory at a time
    loss: Annotated[str, OneOf("bradley_terry", "plackett_luce")] = "bradley_terry"  # of pairs, or of whole rankings
    pool: Annotated[str, OneOf("last", "mean")] = "last"  # what the head reads: the last token, or the mean of all
    center_rewards_coefficient: Annotated[float, AtLeast(0)] = 0.01  # weight of (r_a + r_b)^2
    label_smoothing: Annotated[float, Between(0, 0.5)] = 0.0  # labels are drawn this far towards their opposite
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # a longer gradient is made this long
    remat: bool = False  # compute activations again in the backward pass: less memory, a third more time

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size % self.gradient_accumulation:
            raise UserError(f"reward_model: batch_size {self.batch_size} does not divide into {self.gradient_accumulation} parts")


def rate_by_width(hidden_size: int) -> str:
    """A schedule for a model of this width: 2e-3 at 128, falling with the width to the power 1.5."""
    return f"linear({HELD_LEARNING_RATE * (128 / hidden_size) ** 1.5:.3g}, 0)"


def score_batch(params: Params, config: ModelConfig, batch: ComparisonBatch, pool: str, remat: bool = False) -> Float[Array, "R K"]:
    """The reward of every text; of padding, a number without meaning."""
    rows, texts, width = batch.tokens.shape
    tokens, segments = batch.tokens.reshape(-1, width), batch.segments.reshape(-1, width)
    return text_scores(params, config, tokens, segments, "mean" if pool == "mean" else "last", remat).reshape(rows, texts)


def comparison_loss(scores: Float[Array, "R K"], batch: ComparisonBatch, config: Config) -> tuple[Float[Array, ""], Metrics]:
    """The loss of rewards, and what is logged of it."""
    first, second = (jnp.take_along_axis(scores, index, axis=1) for index in (batch.first, batch.second))
    smooth = config.label_smoothing
    p_first = batch.p_first * (1.0 - smooth) + (1.0 - batch.p_first) * smooth
    if config.loss == "plackett_luce":
        fit = plackett_luce_loss(scores, batch.valid, jnp.any(batch.valid, axis=1).astype(jnp.float32))
    else:
        fit = bradley_terry_loss(first, second, p_first, batch.weight)
    loss = fit + config.center_rewards_coefficient * centring_penalty(first, second, batch.weight)
    sure = batch.weight * (batch.p_first != 0.5)
    right = ((first > second) == (batch.p_first > 0.5)).astype(jnp.float32)
    metrics = {
        "train/loss": loss,
        "train/accuracy": weighted_mean(right, sure),
        "train/reward_margin": weighted_mean((first - second) * jnp.sign(batch.p_first - 0.5), sure),
    }
    return loss, metrics


def reward_model(config: Config, model_config: ModelConfig, lora: LoraConfig | None = None) -> Learner:
    """A reward model on a language model's trunk; with ``lora`` an adapter and the head are learnt. Its State holds the head too."""
    optimizer = adamw(0.9, 0.999, 1e-5, 0.0, config.max_grad_norm)
    learning_rate = rate_by_width(model_config.hidden_size) if config.learning_rate is None else config.learning_rate

    def init(params: Params, key: Key[Array, ""]) -> State:
        key_head, key_adapter = jax.random.split(key)
        scored, _ = with_scalar_head(params, model_config, key_head)
        scored = jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), scored)
        if lora is not None:
            scored = {"adapter": initial_adapter(model_config, lora, key_adapter).pairs, "score": scored["score"]}
        return State(scored, optimizer.init(scored), jnp.int32(0))

    def params_of(learnt: Params, frozen: Params) -> Params:
        if lora is None:
            return learnt
        return {**merged(frozen, model_config, Adapter(lora, learnt["adapter"])), "score": learnt["score"]}

    def update(state: State, frozen: Params, batch: ComparisonBatch) -> tuple[State, Metrics]:
        def loss(learnt: Params, part: ComparisonBatch) -> tuple[Float[Array, ""], Metrics]:
            scores = score_batch(params_of(learnt, frozen), model_config, part, config.pool, config.remat)
            found, metrics = comparison_loss(scores, part, config)
            # The sums of all parts are what the whole batch gives, however its weight is spread.
            share = jnp.sum(part.weight) / jnp.maximum(jnp.sum(batch.weight), 1e-8)
            return found * share, {name: value * share for name, value in metrics.items()}

        gradient, metrics = accumulated(loss, state.trained, batch, config.gradient_accumulation)
        rate = rate_at(learning_rate, 0.0, state.step, config.total_steps)
        after, norm = descend(optimizer, rate, state, gradient)
        return after, metrics | {"train/grad_norm": norm, "train/learning_rate": rate}

    def evaluate(state: State, frozen: Params, batch: ComparisonBatch) -> Metrics:
        return {"scores": score_batch(params_of(state.trained, frozen), model_config, batch, config.pool)}

    def frozen_of(params: Params) -> Params:
        return () if lora is None else {name: part for name, part in params.items() if name not in ("output", "score")}

    return Learner(init, update, evaluate, lambda state, frozen: params_of(state.trained, frozen), frozen_of)
