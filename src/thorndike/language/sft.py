"""Supervised fine-tuning (SFT), and pre-training, which is the same on plain text: the next token of texts, by maximum likelihood.

Radford et al. 2018 ("Improving Language Understanding by Generative Pre-Training"); on answers to prompts Ouyang et al. 2022
(arXiv:2203.02155). Deviations:

1. Short texts are packed into one row and never see each other (segments), instead of each being padded to the longest.
2. The loss is the mean over the tokens of the whole step that count, also with gradient accumulation.
3. No dropout.

Logs ``train/loss`` (nats a token), ``train/perplexity``, ``train/tokens`` (that counted, a step), ``train/grad_norm``,
``train/learning_rate``. Results and their commands: docs/language.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from thorndike.errors import UserError
from thorndike.language.decoder import Params, hidden_states, token_log_probs
from thorndike.language.learner import Learner, State, accumulated, adamw, descend, rate_at, what_is_trained
from thorndike.language.lora import LoraConfig
from thorndike.language.model_config import ModelConfig
from thorndike.settings import AtLeast, Between, MoreThan, check
from thorndike.types import Metrics


@dataclass(frozen=True)
class Config:
    """Settings of supervised fine-tuning."""

    total_steps: Annotated[int, AtLeast(1)] = 1000  # gradient steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = "cosine(2e-5, 2e-6)"  # AdamW's step size, or a schedule
    warmup_fraction: Annotated[float, Between(0, 1)] = 0.05  # of the run, over which the rate rises from 0
    batch_size: Annotated[int, AtLeast(1)] = 32  # rows of a gradient step
    gradient_accumulation: Annotated[int, AtLeast(1)] = 1  # parts of a step, one in memory at a time
    max_length: Annotated[int, AtLeast(2)] = 512  # tokens of a row
    weight_decay: Annotated[float, AtLeast(0)] = 0.0  # of matrices, lambda
    adam_beta1: Annotated[float, Between(0, 1)] = 0.9
    adam_beta2: Annotated[float, Between(0, 1)] = 0.95
    adam_epsilon: Annotated[float, MoreThan(0)] = 1e-8
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # a longer gradient is made this long
    remat: bool = False  # compute activations again in the backward pass: less memory, a third more time

    def __post_init__(self) -> None:
        check(self)
        if self.batch_size % self.gradient_accumulation:
            raise UserError(
                f"sft: batch_size {self.batch_size} does not divide into gradient_accumulation = {self.gradient_accumulation} parts"
            )


class TextBatch(NamedTuple):
    """Rows of packed texts."""

    tokens: Int[Array, "B T"]
    segments: Int[Array, "B T"]
    """0: padding; tokens of one text have one number."""
    learn: Bool[Array, "B T"]
    """Whether a token is to be predicted from those before it."""


def token_losses(
    params: Params, config: ModelConfig, batch: TextBatch, remat: bool = False
) -> tuple[Float[Array, "B T-1"], Float[Array, "B T-1"]]:
    """``-log pi`` of every token but the first, and 1 for those that count: to be learnt, and not the first of a text."""
    hidden = hidden_states(params, config, batch.tokens, batch.segments, remat)
    losses = -token_log_probs(params, config, hidden[:, :-1], batch.tokens[:, 1:])
    return losses, counted(batch)


def counted(batch: TextBatch) -> Float[Array, "B T-1"]:
    """1 for every token but the first that counts in the loss."""
    inside = (batch.segments[:, 1:] == batch.segments[:, :-1]) & (batch.segments[:, 1:] > 0)
    return (inside & batch.learn[:, 1:]).astype(jnp.float32)


def sft(config: Config, model_config: ModelConfig, lora: LoraConfig | None = None) -> Learner:
    """Maximum likelihood of texts, for all parameters or an adapter's."""
    optimizer = adamw(config.adam_beta1, config.adam_beta2, config.adam_epsilon, config.weight_decay, config.max_grad_norm)
    trained = what_is_trained(model_config, lora)

    def init(params: Params, key: Key[Array, ""]) -> State:
        begin = trained.begin(params, key)
        return State(begin, optimizer.init(begin), jnp.int32(0))

    def update(state: State, frozen: Params, batch: TextBatch) -> tuple[State, Metrics]:
        total = jnp.maximum(jnp.sum(counted(batch)), 1.0)

        def loss(learnt: Params, part: TextBatch) -> tuple[Float[Array, ""], Metrics]:
            losses, weights = token_losses(trained.params(learnt, frozen), model_config, part, config.remat)
            mean = jnp.sum(losses * weights) / total
            return mean, {"train/loss": mean}

        gradient, metrics = accumulated(loss, state.trained, batch, config.gradient_accumulation)
        rate = rate_at(config.learning_rate, config.warmup_fraction, state.step, config.total_steps)
        after, norm = descend(optimizer, rate, state, gradient)
        more = {
            "train/perplexity": jnp.exp(metrics["train/loss"]),
            "train/tokens": total,
            "train/grad_norm": norm,
            "train/learning_rate": rate,
        }
        return after, metrics | more

    def evaluate(state: State, frozen: Params, batch: TextBatch) -> Metrics:
        losses, weights = token_losses(trained.params(state.trained, frozen), model_config, batch)
        return {"eval/loss_sum": jnp.sum(losses * weights), "eval/tokens": jnp.sum(weights)}

    return Learner(init, update, evaluate, lambda state, frozen: trained.params(state.trained, frozen), trained.frozen)
