"""PPO for text: a policy is moved towards a reward and held close to the model that it began as.

Ziegler et al. 2019 (arXiv:1909.08593); Stiennon et al. 2020 (arXiv:2009.01325); details as Huang et al. 2024 (arXiv:2403.17031) list them.
Deviations:

1. The controller's horizon is short by default (400 episodes, the paper: 10,000): runs here take minutes, and the coefficient must keep up.
2. The controller looks at the *exact* divergence over the vocabulary; the penalty in the reward is k1, as in the paper.
3. The last token ends the episode also where the length limit cut the text: no value is bootstrapped.
4. ``value="shared"``: a head on the policy's trunk, begun at 0; ``"separate"``: a model of its own, begun as the reward model or the base.
5. No dropout.

Logs ``objective/kl`` (nats a text), ``objective/score``, ``objective/rlhf_reward`` (with the penalty), ``objective/kl_coefficient``,
``train/loss``, ``train/policy_gradient_loss``, ``train/value_loss``, ``train/approx_kl``, ``train/clip_fraction``,
``train/explained_variance``, ``train/first_ratio_error``, ``train/grad_norm``, ``train/learning_rate``.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.policy_losses import explained_variance, value_loss
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.functional.token_rewards import adapted_coefficient, penalized_rewards, whitened
from thorndike.language.decoder import Params, hidden_states
from thorndike.language.learner import what_is_trained
from thorndike.language.lora import LoraConfig
from thorndike.language.model_config import ModelConfig
from thorndike.language.policy_descent import descend_epochs, policy_terms
from thorndike.language.policy_learner import PolicyLearner
from thorndike.language.rollouts import Distance, Rollout, before_tokens
from thorndike.language.scalar_head import token_values, with_scalar_head
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Metrics


@dataclass(frozen=True)
class Config:
    """Settings of PPO for text."""

    total_steps: Annotated[int, AtLeast(1)] = 100  # iterations of the run, the measure of all schedules
    episodes: Annotated[int, AtLeast(1)] = 128  # texts of an iteration
    max_prompt_length: Annotated[int, AtLeast(1)] = 64  # tokens of a prompt
    max_new_tokens: Annotated[int, AtLeast(1)] = 64  # tokens of a completion
    temperature: Annotated[float, MoreThan(0)] = 1.0  # of sampling, and of all log-probabilities
    learning_rate: Annotated[float | str, AtLeast(0)] = "linear(1e-5, 0)"  # Adam's step size, or a schedule
    n_epochs: Annotated[int, AtLeast(1)] = 4  # passes over an iteration's texts
    batch_size: Annotated[int, AtLeast(1)] = 64  # texts of a minibatch
    gradient_accumulation: Annotated[int, AtLeast(1)] = 1  # parts of a minibatch, one in memory at a time
    gamma: Annotated[float, Between(0, 1)] = 1.0  # discount
    gae_lambda: Annotated[float, Between(0, 1)] = 0.95  # lambda of the advantage estimate
    clip_range: Annotated[float, AtLeast(0)] = 0.2  # epsilon of the surrogate
    clip_range_vf: Annotated[float | None, MoreThan(0)] = 0.2  # the same for the value
    vf_coef: Annotated[float, AtLeast(0)] = 0.1  # weight of the value loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # a longer gradient is made this long
    kl_coefficient: Annotated[float, AtLeast(0)] = 0.15  # beta, of the penalty on leaving the reference; 0: none
    target_kl: Annotated[float | None, MoreThan(0)] = 6.0  # nats a text that beta is steered to; None: beta stays
    kl_horizon: Annotated[float, MoreThan(0)] = 400.0  # episodes over which beta follows
    missing_eos_penalty: Annotated[float | None, AtLeast(0)] = None  # taken off the score of a text that did not end
    ignore_eos: bool = False  # stop tokens are never chosen: every text goes on to max_new_tokens
    whiten_rewards: bool = False  # scale rewards to deviation 1, their mean kept
    value: Annotated[str, OneOf("separate", "shared")] = "separate"  # a model of its own, or a head on the policy
    remat: bool = False  # compute activations again in the backward pass: less memory, a third more time

    def __post_init__(self) -> None:
        check(self)
        if self.ignore_eos and self.missing_eos_penalty is not None:
            raise UserError("ppo: with ignore_eos no text ends, and missing_eos_penalty would charge all of them: leave one of the two out")
        if self.episodes % self.batch_size or self.batch_size % self.gradient_accumulation:
            raise UserError(
                f"ppo: {self.episodes} episodes do not divide into minibatches of batch_size {self.batch_size}, or those not into "
                f"{self.gradient_accumulation} parts"
            )


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: PyTree
    """``policy`` (parameters, or an adapter's matrices) and ``value`` (a model's parameters, or a head's)."""
    opt_state: PyTree
    kl_coefficient: Float[Array, ""]
    step: Int[Array, ""]


class Batch(NamedTuple):
    """What the loss needs of an iteration's texts."""

    rollout: Rollout
    value: Float[Array, "B N"]
    advantage: Float[Array, "B N"]
    target: Float[Array, "B N"]


def advantages(
    rollout: Rollout, found: Distance, value: Float[Array, "B N"], score: Float[Array, " B"], coefficient: Float[Array, ""], config: Config
) -> Batch:
    """Rewards by token, whitened if asked for, and the advantages and value targets that follow."""
    valid, weight = rollout.valid, rollout.valid.astype(jnp.float32)
    reward = penalized_rewards(score, found.log_probs - found.reference_log_probs, valid, coefficient)
    reward = whitened(reward, weight, shift_mean=False) if config.whiten_rewards else reward
    value = jnp.where(valid, value, 0.0)
    following = jnp.pad(value[:, 1:], ((0, 0), (0, 1)))
    # Beyond a text's end nothing is valid: its last token is where validity stops.
    ends = ~jnp.pad(valid[:, 1:], ((0, 0), (0, 1)))
    rows = (reward.T, value.T, following.T, ends.T, ends.T)
    advantage = jnp.where(valid, generalized_advantage(*rows, config.gamma, config.gae_lambda).T, 0.0)
    return Batch(rollout, value, whitened(advantage, weight), advantage + value)


def ppo_loss(
    params: Params, value: Float[Array, "M N"] | None, head: PyTree, batch: Batch, model_config: ModelConfig, config: Config
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of one minibatch; ``value`` is None where a ``head`` on the policy's trunk gives it."""
    terms = policy_terms(params, model_config, batch.rollout, batch.advantage, config.clip_range, config.temperature, config.remat)
    value = head_values(head, terms.hidden) if value is None else value
    critic = 0.5 * value_loss(value, batch.value, batch.target, config.clip_range_vf, batch.rollout.valid.astype(jnp.float32))
    loss = terms.surrogate + config.vf_coef * critic
    return loss, terms.metrics | {"train/loss": loss, "train/policy_gradient_loss": terms.surrogate, "train/value_loss": critic}


def head_values(head: PyTree, hidden: Float[Array, "B N d"]) -> Float[Array, "B N"]:
    """The value by a linear head on the policy's hidden states."""
    flat = hidden.reshape(-1, hidden.shape[-1]).astype(jnp.float32)
    return (flat @ head["kernel"] + head["bias"][None]).reshape(hidden.shape[:-1])


def ppo(
    config: Config, model_config: ModelConfig, reference: Params, value_params: Params | None = None, lora: LoraConfig | None = None
) -> PolicyLearner:
    """PPO that begins at ``reference``. ``value_params``: a scalar-head model that the separate value model begins as (the reward model).

    Without it the value model begins as the base, with a head of zeros.
    """
    trained = what_is_trained(model_config, lora)
    frozen = trained.frozen(reference)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    rate, shared = schedule(config.learning_rate), config.value == "shared"
    value_config = replace(model_config, num_labels=1)

    def init(key: Key[Array, ""]) -> State:
        key_policy, key_value = jax.random.split(key)
        if shared:
            value: PyTree = {"kernel": jnp.zeros((model_config.hidden_size, 1)), "bias": jnp.zeros(1)}
        else:
            begin = with_scalar_head(reference, model_config, key_value, zero=True)[0] if value_params is None else value_params
            value = jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), begin)
        learnt = {"policy": trained.begin(reference, key_policy), "value": value}
        return State(learnt, optimizer.init(learnt), jnp.float32(config.kl_coefficient), jnp.int32(0))

    def values(learnt: PyTree, rollout: Rollout) -> Float[Array, "B N"]:
        number = rollout.valid.shape[1]
        return token_values(learnt["value"], value_config, rollout.tokens, rollout.segments, config.remat)[:, -number - 1 : -1]

    @partial(jax.jit, donate_argnums=0)
    def update(
        state: State, frozen: Params, rollout: Rollout, found: Distance, score: Float[Array, " B"], key: Key[Array, ""]
    ) -> tuple[State, Metrics]:
        learnt = state.learnt
        if shared:
            hidden = hidden_states(trained.params(learnt["policy"], frozen), model_config, rollout.tokens, rollout.segments)
            before = head_values(learnt["value"], before_tokens(hidden, rollout.valid.shape[1]))
        else:
            before = values(learnt, rollout)
        batch = advantages(rollout, found, before, score, state.kl_coefficient, config)

        def loss(learnt: PyTree, part: Batch) -> tuple[Float[Array, ""], Metrics]:
            params = trained.params(learnt["policy"], frozen)
            return ppo_loss(params, None if shared else values(learnt, part.rollout), learnt["value"], part, model_config, config)

        step_size = rate(state.step / config.total_steps)
        learnt, opt_state, metrics = descend_epochs(
            loss, learnt, state.opt_state, batch, key, n_epochs=config.n_epochs, batch_size=config.batch_size,
            parts=config.gradient_accumulation, optimizer=optimizer, rate=step_size,
        )  # fmt: skip
        kl = jnp.mean(jnp.sum(found.exact_kl, axis=1))
        coefficient = state.kl_coefficient
        if config.target_kl is not None:
            coefficient = adapted_coefficient(coefficient, kl, config.target_kl, float(config.episodes), config.kl_horizon)
        metrics |= {
            "objective/rlhf_reward": jnp.mean(score) - state.kl_coefficient * jnp.mean(jnp.sum(_log_ratio(found), axis=1)),
            "objective/kl_coefficient": state.kl_coefficient,
            "train/explained_variance": explained_variance(batch.value, batch.target, rollout.valid),
            "train/learning_rate": step_size,
        }
        return State(learnt, opt_state, coefficient, state.step + 1), metrics

    return PolicyLearner(
        init=init,
        params=lambda state: trained.params(state.learnt["policy"], frozen),
        update=lambda state, rollout, found, score, key: update(state, frozen, rollout, found, score, key),
        adapter=lambda state: None if lora is None else state.learnt["policy"],
        samples=1,
    )


def _log_ratio(found: Distance) -> Float[Array, "B N"]:
    return found.log_probs - found.reference_log_probs
