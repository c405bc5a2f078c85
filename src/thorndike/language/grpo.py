"""GRPO and RLOO: several completions of each prompt are each other's baseline, so that no value is learnt.

GRPO: Shao et al. 2024 (arXiv:2402.03300); without division by the deviation it is Dr. GRPO (Liu et al. 2025, arXiv:2503.20783). RLOO:
Ahmadian et al. 2024 (arXiv:2402.14740). Deviations:

1. The loss is the mean over all tokens of a minibatch (DAPO, Yu et al. 2025, arXiv:2503.14476), not the mean of texts' means, which favours
   long texts that are wrong.
2. GRPO's penalty in the loss is k2, whose gradient is that of the divergence; the paper's k3 has that of the reversed one.
3. RLOO's penalty is in the reward, by text, as in its paper; so is GRPO's with ``kl_in="reward"``.
4. The coefficient may be steered to a divergence, as PPO's is; the papers keep it.

Logs what ``ppo.py`` does, but for values, and ``objective/teaching_share``: of prompts, those whose completions differ in score. The others
teach nothing.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.functional.token_rewards import adapted_coefficient, group_advantages, kl_estimate, leave_one_out_advantages
from thorndike.language.decoder import Params
from thorndike.language.learner import what_is_trained
from thorndike.language.lora import LoraConfig
from thorndike.language.model_config import ModelConfig
from thorndike.language.policy_descent import descend_epochs, policy_terms
from thorndike.language.policy_learner import PolicyLearner
from thorndike.language.rollouts import Distance, Rollout
from thorndike.settings import AtLeast, MoreThan, OneOf, check
from thorndike.types import Metrics


@dataclass(frozen=True)
class Config:
    """Settings of GRPO and RLOO."""

    total_steps: Annotated[int, AtLeast(1)] = 100  # iterations of the run, the measure of all schedules
    episodes: Annotated[int, AtLeast(2)] = 128  # texts of an iteration
    group: Annotated[int, AtLeast(2)] = 8  # G: completions of each prompt
    baseline: Annotated[str, OneOf("group", "leave_one_out")] = "group"  # mean of all completions, or of the others (RLOO)
    scale: Annotated[str, OneOf("group", "none")] = "group"  # divide by the group's deviation, or not (Dr. GRPO); RLOO never does
    max_prompt_length: Annotated[int, AtLeast(1)] = 64  # tokens of a prompt
    max_new_tokens: Annotated[int, AtLeast(1)] = 64  # tokens of a completion
    temperature: Annotated[float, MoreThan(0)] = 1.0  # of sampling, and of all log-probabilities
    learning_rate: Annotated[float | str, AtLeast(0)] = "linear(1e-6, 0)"  # Adam's step size, or a schedule
    n_epochs: Annotated[int, AtLeast(1)] = 1  # mu: passes over an iteration's texts
    batch_size: Annotated[int, AtLeast(1)] = 64  # texts of a minibatch
    gradient_accumulation: Annotated[int, AtLeast(1)] = 1  # parts of a minibatch, one in memory at a time
    clip_range: Annotated[float, AtLeast(0)] = 0.2  # epsilon of the surrogate
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # a longer gradient is made this long
    kl_coefficient: Annotated[float, AtLeast(0)] = 0.04  # beta, of the penalty on leaving the reference; 0: none
    kl_in: Annotated[str, OneOf("loss", "reward")] = "loss"  # where the penalty is; RLOO's is in the reward
    kl_estimator: Annotated[str, OneOf("k2", "k3")] = "k2"  # of the penalty in the loss
    target_kl: Annotated[float | None, MoreThan(0)] = None  # nats a text that beta is steered to; None: beta stays
    kl_horizon: Annotated[float, MoreThan(0)] = 400.0  # episodes over which beta follows
    missing_eos_penalty: Annotated[float | None, AtLeast(0)] = None  # taken off the score of a text that did not end
    ignore_eos: bool = False  # stop tokens are never chosen: every text goes on to max_new_tokens
    remat: bool = False  # compute activations again in the backward pass: less memory, a third more time

    def __post_init__(self) -> None:
        check(self)
        if self.ignore_eos and self.missing_eos_penalty is not None:
            raise UserError(
                "grpo: with ignore_eos no text ends, and missing_eos_penalty would charge all of them: leave one of the two out"
            )
        if self.episodes % self.group:
            raise UserError(f"grpo: {self.episodes} episodes do not divide into groups of {self.group}")
        if self.episodes % self.batch_size or self.batch_size % self.gradient_accumulation:
            raise UserError(
                f"grpo: {self.episodes} episodes do not divide into minibatches of batch_size {self.batch_size}, or those not into "
                f"{self.gradient_accumulation} parts"
            )

    @property
    def penalty_in_reward(self) -> bool:
        """Whether the penalty is part of the reward."""
        return self.kl_in == "reward" or self.baseline == "leave_one_out"


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: PyTree
    """The policy's parameters, or an adapter's matrices."""
    opt_state: PyTree
    kl_coefficient: Float[Array, ""]
    step: Int[Array, ""]


class Batch(NamedTuple):
    """What the loss needs of an iteration's texts."""

    rollout: Rollout
    reference_log_probs: Float[Array, "B N"]
    advantage: Float[Array, " B"]


def text_advantages(score: Float[Array, " B"], found: Distance, coefficient: Float[Array, ""], config: Config) -> Float[Array, " B"]:
    """One advantage a text; the completions of a prompt stand side by side."""
    log_ratio = jnp.sum(found.log_probs - found.reference_log_probs, axis=1)
    reward = (score - coefficient * log_ratio if config.penalty_in_reward else score).reshape(-1, config.group)
    if config.baseline == "leave_one_out":
        return leave_one_out_advantages(reward).reshape(-1)
    return group_advantages(reward, "none" if config.scale == "none" else "group").reshape(-1)


def grpo_loss(
    params: Params, batch: Batch, model_config: ModelConfig, config: Config, coefficient: Float[Array, ""]
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of one minibatch."""
    valid = batch.rollout.valid
    advantage = jnp.broadcast_to(batch.advantage[:, None], valid.shape)
    terms = policy_terms(params, model_config, batch.rollout, advantage, config.clip_range, config.temperature, config.remat)
    penalty = jnp.zeros(())
    if not config.penalty_in_reward:
        log_ratio = jnp.where(valid, terms.log_probs - batch.reference_log_probs, 0.0)
        estimate = kl_estimate(log_ratio, "k3" if config.kl_estimator == "k3" else "k2")
        penalty = coefficient * weighted_mean(estimate, valid.astype(jnp.float32))
    loss = terms.surrogate + penalty
    return loss, terms.metrics | {"train/loss": loss, "train/policy_gradient_loss": terms.surrogate, "train/kl_penalty": penalty}


def grpo(config: Config, model_config: ModelConfig, reference: Params, lora: LoraConfig | None = None) -> PolicyLearner:
    """GRPO, or with ``baseline="leave_one_out"`` RLOO, that begins at ``reference``."""
    trained = what_is_trained(model_config, lora)
    frozen = trained.frozen(reference)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    rate = schedule(config.learning_rate)

    def init(key: Key[Array, ""]) -> State:
        learnt = trained.begin(reference, key)
        return State(learnt, optimizer.init(learnt), jnp.float32(config.kl_coefficient), jnp.int32(0))

    @partial(jax.jit, donate_argnums=0)
    def update(
        state: State, frozen: Params, rollout: Rollout, found: Distance, score: Float[Array, " B"], key: Key[Array, ""]
    ) -> tuple[State, Metrics]:
        batch = Batch(rollout, found.reference_log_probs, text_advantages(score, found, state.kl_coefficient, config))

        def loss(learnt: PyTree, part: Batch) -> tuple[Float[Array, ""], Metrics]:
            return grpo_loss(trained.params(learnt, frozen), part, model_config, config, state.kl_coefficient)

        step_size = rate(state.step / config.total_steps)
        learnt, opt_state, metrics = descend_epochs(
            loss, state.learnt, state.opt_state, batch, key, n_epochs=config.n_epochs, batch_size=config.batch_size,
            parts=config.gradient_accumulation, optimizer=optimizer, rate=step_size,
        )  # fmt: skip
        coefficient, kl = state.kl_coefficient, jnp.mean(jnp.sum(found.exact_kl, axis=1))
        if config.target_kl is not None:
            coefficient = adapted_coefficient(coefficient, kl, config.target_kl, float(config.episodes), config.kl_horizon)
        metrics |= {
            "objective/kl_coefficient": state.kl_coefficient,
            "objective/teaching_share": jnp.mean(jnp.std(score.reshape(-1, config.group), axis=1) > 1e-6),
            "train/learning_rate": step_size,
        }
        return State(learnt, opt_state, coefficient, state.step + 1), metrics

    return PolicyLearner(
        init=init,
        params=lambda state: trained.params(state.learnt, frozen),
        update=lambda state, rollout, found, score, key: update(state, frozen, rollout, found, score, key),
        adapter=lambda state: None if lora is None else state.learnt,
        samples=config.group,
    )
