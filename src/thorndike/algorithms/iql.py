"""Implicit Q-learning (IQL): learns from a dataset without ever asking what an action outside of it is worth.

Kostrikov, Nair, Levine 2021, "Offline Reinforcement Learning with Implicit Q-Learning" (arXiv:2110.06169). Deviations:

1. The standard deviation of a Box policy depends on the observation, and draws are clipped to the bounds.
2. Discrete actions have a softmax policy and one value an action from each critic.
3. The policy's learning rate does not fall by a cosine unless ``learning_rate`` says so.
4. A step cut by a time limit bootstraps from the observation it was cut at.

Logs ``train/value_loss``, ``critic_loss``, ``actor_loss``, ``q_mean``, ``value_mean``, ``advantage_weight``, ``critic_grad_norm``,
``actor_grad_norm``, ``learning_rate``. Results and their commands: docs/algorithms/iql.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.functional.critic_losses import squared_errors
from thorndike.functional.descent import Optimized, descend, follow, optimized
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.offline_losses import advantage_weights, expectile_loss
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.continuous import policy_outputs
from thorndike.networks.either_actions import action_values, stochastic_policy
from thorndike.networks.heads import Shape
from thorndike.networks.hidden_layers import look_into
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.off_policy import Method
from thorndike.replay.offline import offline
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics


@dataclass(frozen=True)
class Config:
    """Settings of IQL, the paper's for locomotion."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # updates of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    expectile: Annotated[float, Between(0, 1)] = 0.7  # tau of the paper: 0.5 is the dataset's policy, towards 1 its best actions
    temperature: Annotated[float, MoreThan(0)] = 0.33  # 1 / beta: small follows the advantage, large clones
    max_weight: Annotated[float, MoreThan(0)] = 100.0  # what exp(A / temperature) is clipped to
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Learnt(NamedTuple):
    """All that is learnt."""

    actor: Optimized
    value: Optimized
    critics: Optimized
    """Parameters ``[K, P]``."""
    target_params: Float[Array, "K P"]


class Acting(NamedTuple):
    """What acting and valuing need."""

    actor: Float[Array, " P"]
    value: Float[Array, " V"]


def iql(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """IQL for Discrete or Box actions. Raises ``UserError`` for other action spaces."""
    shape = Shape(config.net_arch, config.activation)
    policy, net = stochastic_policy("iql", spec, shape, network), action_values("iql", spec, config.n_critics, shape)
    values, init_value = policy_outputs(spec, 1, config.net_arch, config.activation)
    optimizer = optax.scale_by_adam()

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_value, key_critics = jax.random.split(key, 3)
        judges = net.init(key_critics)
        return Learnt(
            actor=optimized(policy.init(key_policy), optimizer),
            value=optimized(init_value(key_value), optimizer),
            critics=optimized(judges, optimizer),
            target_params=jnp.array(judges),
        )

    def value_loss(params: Float[Array, " V"], batch: Transitions, q: Float[Array, " M"]) -> tuple[Array, Array]:
        value = values.apply(params, batch.obs)[:, 0]
        return expectile_loss(q - value, config.expectile, batch.weight), value

    def critic_loss(params: Float[Array, "K P"], batch: Transitions, target: Float[Array, " M"]) -> tuple[Array, Array]:
        q = net.taken(params, batch.obs, batch.action)
        return squared_errors(q[..., None], target[:, None], batch.weight), jnp.mean(q)

    def policy_loss(params: Float[Array, " P"], batch: Transitions, weights: Float[Array, " M"]) -> Float[Array, ""]:
        return -weighted_mean(weights * policy.log_prob(params, batch.obs, batch.action), batch.weight)

    def learn(learnt: Learnt, batch: Transitions, drawn: Array, rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        q = jnp.min(net.taken(learnt.target_params, batch.obs, batch.action), axis=0)
        (value_error, value), slope = jax.value_and_grad(value_loss, has_aux=True)(learnt.value.params, batch, q)
        valued, _ = descend(optimizer, rate, learnt.value, slope)
        weights = advantage_weights(q - value, config.temperature, config.max_weight)
        policy_error, climb = jax.value_and_grad(policy_loss)(learnt.actor.params, batch, weights)
        actor, actor_norm = descend(optimizer, rate, learnt.actor, climb)
        target = batch.reward + batch.discount * values.apply(valued.params, batch.next_obs)[:, 0]
        (loss, q_mean), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learnt.critics.params, batch, target)
        judged, norm = descend(optimizer, rate, learnt.critics, gradient)
        metrics = {
            "train/value_loss": value_error,
            "train/critic_loss": loss,
            "train/actor_loss": policy_error,
            "train/q_mean": q_mean,
            "train/value_mean": jnp.mean(value),
            "train/advantage_weight": jnp.mean(weights),
            "train/critic_grad_norm": norm,
            "train/actor_grad_norm": actor_norm,
        }
        return Learnt(actor, valued, judged, follow(learnt.target_params, judged.params, config.tau)), metrics

    def look(learnt: Learnt, batch: Transitions) -> Metrics:
        of_value = look_into(values, learnt.value.params, batch.obs, mean_square_gradient(learnt.value.opt_state), "value")
        return policy.look(learnt.actor, batch.obs) | of_value | net.look(learnt.critics, batch.obs, batch.action)

    probabilities = policy.probabilities
    method = Method(
        name="iql",
        dimensions=policy.dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.actor.params, learnt.value.params),
        explore=lambda acting, obs, noise: policy.sample(acting.actor, obs, noise),
        greedy=lambda acting, obs: policy.mode(acting.actor, obs),
        value=lambda acting, obs: values.apply(acting.value, obs)[:, 0],
        draw=lambda key, updates: jnp.zeros((updates, 0)),
        learn=learn,
        look=look,
    )
    told = None if probabilities is None else lambda acting, obs: probabilities(acting.actor, obs)
    return offline(method, config, spec, config.gamma, told)
