"""Advantage-weighted actor-critic (AWAC): learns from a dataset, and goes on online from there.

Nair, Gupta, Dalal, Levine 2020, "AWAC: Accelerating Online Reinforcement Learning with Offline Datasets" (arXiv:2006.09359). On a dataset
it is an offline learner; on an environment it learns from replay, which ``start_from`` fills with the dataset of an offline run, whose
networks it goes on with. Deviations:

1. Weights are ``exp(A / lambda)`` clipped at ``max_weight``, not normalised over the minibatch.
2. The mean of the policy is squashed into the bounds and its draws are clipped to them.
3. A step cut by a time limit bootstraps from the observation it was cut at.

Logs ``train/critic_loss``, ``actor_loss``, ``q_mean``, ``advantage_weight``, ``critic_grad_norm``, ``actor_grad_norm``, ``learning_rate``.
Results and their commands: docs/algorithms/awac.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.functional.critic_losses import lowest, squared_errors
from thorndike.functional.descent import Optimized, descend, follow, optimized
from thorndike.functional.offline_losses import advantage_weights
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.continuous import box_dimensions, critics
from thorndike.networks.either_actions import stochastic_policy
from thorndike.networks.heads import Shape
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.off_policy import Method, off_policy
from thorndike.replay.offline import offline
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Observation


@dataclass(frozen=True)
class Config:
    """Settings of AWAC, the paper's. On a dataset those of replay and stepping have no part."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # updates on a dataset, environment steps online: the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept online, those of the dataset among them
    learning_starts: Annotated[int, AtLeast(0)] = 0  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 1024  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    temperature: Annotated[float, MoreThan(0)] = 0.3  # lambda: small follows the advantage, large clones
    max_weight: Annotated[float, MoreThan(0)] = 100.0  # what exp(A / lambda) is clipped to
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Learnt(NamedTuple):
    """All that is learnt."""

    actor: Optimized
    critics: Optimized
    """Parameters ``[2, P]``."""
    target_params: Float[Array, "K P"]


class Acting(NamedTuple):
    """What acting and valuing need."""

    actor: Float[Array, " P"]
    critics: Float[Array, "K P"]


def awac(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """AWAC for Box actions, on a dataset or an environment. Raises ``UserError`` for other action spaces."""
    dimensions = box_dimensions("awac", spec)
    policy = stochastic_policy("awac", spec, Shape(config.net_arch, config.activation), network)
    net = critics(spec, dimensions, 2, config.net_arch, config.activation)
    optimizer = optax.scale_by_adam()

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_critics = jax.random.split(key)
        judges = net.init(key_critics)
        return Learnt(optimized(policy.init(key_policy), optimizer), optimized(judges, optimizer), jnp.array(judges))

    def value(critic_params: Float[Array, "K P"], obs: Observation, action: Float[Array, "M D"]) -> Float[Array, " M"]:
        return lowest(net.apply(critic_params, obs, action))[:, 0]

    def critic_loss(params: Float[Array, "K P"], batch: Transitions, target: Float[Array, " M"]) -> tuple[Array, Array]:
        values = net.apply(params, batch.obs, batch.action)
        return squared_errors(values, target[:, None], batch.weight), jnp.mean(values)

    def policy_loss(params: Float[Array, " P"], batch: Transitions, weights: Float[Array, " M"]) -> Float[Array, ""]:
        return -weighted_mean(weights * policy.log_prob(params, batch.obs, batch.action), batch.weight)

    def learn(learnt: Learnt, batch: Transitions, noise: Float[Array, "2 M D"], rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        next_action = policy.sample(learnt.actor.params, batch.next_obs, noise[0])
        target = batch.reward + batch.discount * value(learnt.target_params, batch.next_obs, next_action)
        (loss, q_mean), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learnt.critics.params, batch, target)
        judged, norm = descend(optimizer, rate, learnt.critics, gradient)
        drawn = policy.sample(learnt.actor.params, batch.obs, noise[1])
        advantage = value(judged.params, batch.obs, batch.action) - value(judged.params, batch.obs, drawn)
        weights = advantage_weights(advantage, config.temperature, config.max_weight)
        policy_error, climb = jax.value_and_grad(policy_loss)(learnt.actor.params, batch, weights)
        actor, actor_norm = descend(optimizer, rate, learnt.actor, climb)
        metrics = {
            "train/critic_loss": loss,
            "train/actor_loss": policy_error,
            "train/q_mean": q_mean,
            "train/advantage_weight": jnp.mean(weights),
            "train/critic_grad_norm": norm,
            "train/actor_grad_norm": actor_norm,
        }
        return Learnt(actor, judged, follow(learnt.target_params, judged.params, config.tau)), metrics

    method = Method(
        name="awac",
        dimensions=dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.actor.params, learnt.critics.params),
        explore=lambda acting, obs, noise: policy.sample(acting.actor, obs, noise),
        greedy=lambda acting, obs: policy.mode(acting.actor, obs),
        value=lambda acting, obs: value(acting.critics, obs, policy.mode(acting.actor, obs)),
        draw=lambda key, updates: jax.random.normal(key, (updates, 2, config.batch_size, dimensions)),
        learn=learn,
        look=lambda learnt, batch: policy.look(learnt.actor, batch.obs) | net.look(learnt.critics, batch.obs, batch.action),
    )
    return offline(method, config, spec, config.gamma) if spec.engine == "dataset" else off_policy(method, config, spec)
