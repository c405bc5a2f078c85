"""Behaviour cloning (BC): the policy that would most probably have made the dataset. The baseline of all learning from data.

Pomerleau 1989, "ALVINN: An Autonomous Land Vehicle in a Neural Network" (NeurIPS 1). It learns from a dataset alone and looks at no reward.
Deviations:

1. Discrete actions are learnt by their log-probability, Box actions by the squared error of a deterministic policy (as the baseline of
   Fujimoto and Gu 2021, arXiv:2106.06860).

Logs ``train/actor_loss``, ``actor_grad_norm``, ``accuracy`` (Discrete), ``learning_rate``. Results and their commands:
docs/algorithms/bc.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.functional.descent import Optimized, descend, optimized
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.either_actions import StochasticPolicy, number_of_actions, stochastic_policy
from thorndike.networks.heads import Shape
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.off_policy import Method
from thorndike.replay.offline import offline
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics


@dataclass(frozen=True)
class Config:
    """Settings of behaviour cloning."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # updates of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Learnt(NamedTuple):
    """All that is learnt."""

    actor: Optimized


def cloning_loss(params: Float[Array, " P"], policy: StochasticPolicy, batch: Transitions, discrete: bool) -> tuple[Array, Metrics]:
    """``-log pi(a|s)`` of Discrete actions, ``|pi(s) - a|^2`` of a Box."""
    chosen = policy.mode(params, batch.obs)
    if discrete:
        right = weighted_mean((chosen == batch.action).astype(jnp.float32), batch.weight)
        return -weighted_mean(policy.log_prob(params, batch.obs, batch.action), batch.weight), {"train/accuracy": right}
    return weighted_mean(jnp.mean(jnp.square(chosen - batch.action), axis=-1), batch.weight), {}


def bc(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """Behaviour cloning of Discrete or Box actions. Raises ``UserError`` for other action spaces."""
    policy = stochastic_policy("bc", spec, Shape(config.net_arch, config.activation), network)
    optimizer, discrete = optax.scale_by_adam(), number_of_actions(spec) is not None

    def learn(learnt: Learnt, batch: Transitions, drawn: Array, rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        (loss, metrics), gradient = jax.value_and_grad(cloning_loss, has_aux=True)(learnt.actor.params, policy, batch, discrete)
        actor, norm = descend(optimizer, rate, learnt.actor, gradient)
        return Learnt(actor), metrics | {"train/actor_loss": loss, "train/actor_grad_norm": norm}

    def init(key: Key[Array, ""]) -> Learnt:
        return Learnt(optimized(policy.init(key), optimizer))

    method = Method(
        name="bc",
        dimensions=policy.dimensions,
        init=init,
        acting=lambda learnt: learnt.actor.params,
        explore=lambda params, obs, noise: policy.sample(params, obs, noise) if discrete else policy.mode(params, obs),
        greedy=policy.mode,
        value=lambda params, obs: jnp.zeros(jax.tree.leaves(obs)[0].shape[:1]),
        draw=lambda key, updates: jnp.zeros((updates, 0)),
        learn=learn,
        look=lambda learnt, batch: policy.look(learnt.actor, batch.obs),
    )
    return offline(method, config, spec, 0.0, policy.probabilities)
