"""Conservative Q-learning (CQL): values of actions that the dataset does not hold are pushed down.

Kumar, Zhou, Tucker, Levine 2020, "Conservative Q-Learning for Offline Reinforcement Learning" (arXiv:2006.04779), in its form CQL(H):
double deep Q-learning where actions are Discrete, soft actor-critic where they are a Box. Deviations:

1. The weight alpha is given, not learnt by a Lagrangian.
2. One learning rate for the policy and the critics; the paper's policy learns more slowly (1e-4).
3. The log-sum over a Box takes uniform actions and the policy's at the same observation; the authors' code adds those of the next one.
4. The target of a Box has no entropy bonus (the authors' code, ``backup_entropy`` off).
5. A step cut by a time limit bootstraps from the observation it was cut at.

Logs ``train/critic_loss``, ``conservative_gap``, ``q_mean``, ``critic_grad_norm``, ``learning_rate``, and of a Box what SAC logs of its
policy. Results and their commands: docs/algorithms/cql.md.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.errors import UserError
from thorndike.functional.critic_losses import lowest, squared_errors
from thorndike.functional.descent import Optimized, descend, follow, optimized
from thorndike.functional.offline_losses import conservative_gap
from thorndike.functional.soft_policy import SoftPolicy, improve_policy, soft_policy, temperature
from thorndike.functional.squashed_gaussian import sample_squashed, squashed_mode
from thorndike.functional.temporal_difference import select
from thorndike.networks.continuous import box_dimensions, critics, look_into_actor_critic, policy_outputs
from thorndike.networks.either_actions import action_values, number_of_actions
from thorndike.networks.heads import Shape
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.off_policy import Method
from thorndike.replay.offline import offline
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Observation


@dataclass(frozen=True)
class Config:
    """Settings of CQL, the paper's for locomotion with a given alpha."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # updates of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    alpha: Annotated[float, AtLeast(0)] = 5.0  # weight of the conservative term; 0 is plain Q-learning
    n_actions: Annotated[int, AtLeast(1)] = 10  # N: of a Box, uniform actions and the policy's in the log-sum, as many of each
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Valued(NamedTuple):
    """All that is learnt where actions are Discrete."""

    critics: Optimized
    """Parameters ``[K, P]``."""
    target_params: Float[Array, "K P"]


class Learnt(NamedTuple):
    """All that is learnt where actions are a Box."""

    policy: SoftPolicy
    critics: Optimized
    """Parameters ``[K, P]``."""
    target_params: Float[Array, "K P"]


class Acting(NamedTuple):
    """What acting and valuing need of a Box."""

    actor: Float[Array, " P"]
    critics: Float[Array, "K P"]


def cql(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """CQL for Discrete or Box actions. Raises ``UserError`` for other action spaces."""
    count = number_of_actions(spec)
    if count is None:
        return offline(conservative_actor_critic(config, spec, network), config, spec, config.gamma)
    if network is not None:
        raise UserError("cql has no policy network where actions are Discrete: leave network out")
    method = conservative_q(config, spec)
    return offline(method, config, spec, config.gamma, lambda params, obs: jax.nn.one_hot(method.greedy(params, obs), count))


def conservative_q(config: Config, spec: EnvSpec) -> Method:
    """Double Q-learning with the conservative term over all actions."""
    net, optimizer = action_values("cql", spec, config.n_critics, Shape(config.net_arch, config.activation)), optax.scale_by_adam()
    every = net.every
    assert every is not None

    def init(key: Key[Array, ""]) -> Valued:
        params = net.init(key)
        return Valued(optimized(params, optimizer), jnp.array(params))

    def pessimistic(params: Float[Array, "K P"], obs: Observation) -> Float[Array, "M A"]:
        return jnp.min(every(params, obs), axis=0)

    def greedy(params: Float[Array, "K P"], obs: Observation) -> Array:
        return jnp.argmax(pessimistic(params, obs), axis=-1).astype(jnp.int32)

    def loss_of(params: Float[Array, "K P"], batch: Transitions, target: Float[Array, " M"]) -> tuple[Array, Metrics]:
        values = every(params, batch.obs)
        taken = select(values, jnp.broadcast_to(batch.action, values.shape[:2]))
        gap = conservative_gap(values, taken, batch.weight)
        loss = squared_errors(taken[..., None], target[:, None], batch.weight) + config.alpha * gap
        return loss, {"train/critic_loss": loss, "train/conservative_gap": gap, "train/q_mean": jnp.mean(taken)}

    def learn(learnt: Valued, batch: Transitions, drawn: Array, rate: Array, number: Array) -> tuple[Valued, Metrics]:
        chosen = greedy(learnt.critics.params, batch.next_obs)
        target = batch.reward + batch.discount * select(pessimistic(learnt.target_params, batch.next_obs), chosen)
        (_, metrics), gradient = jax.value_and_grad(loss_of, has_aux=True)(learnt.critics.params, batch, target)
        judged, metrics["train/critic_grad_norm"] = descend(optimizer, rate, learnt.critics, gradient)
        return Valued(judged, follow(learnt.target_params, judged.params, config.tau)), metrics

    return Method(
        name="cql",
        dimensions=1,
        init=init,
        acting=lambda learnt: learnt.critics.params,
        explore=lambda params, obs, noise: greedy(params, obs),
        greedy=greedy,
        value=lambda params, obs: jnp.max(pessimistic(params, obs), axis=-1),
        draw=lambda key, updates: jnp.zeros((updates, 0)),
        learn=learn,
        look=lambda learnt, batch: net.look(learnt.critics, batch.obs, batch.action),
    )


def conservative_actor_critic(config: Config, spec: EnvSpec, network: NetworkBuilder | None) -> Method:
    """SAC with the conservative term over sampled actions, each weighted by one over its density."""
    dimensions, count = box_dimensions("cql", spec), config.n_actions
    policy, init_policy = policy_outputs(spec, 2 * dimensions, config.net_arch, config.activation, network)
    net = critics(spec, dimensions, config.n_critics, config.net_arch, config.activation)
    optimizer, heat = optax.scale_by_adam(), temperature("auto", "auto", spec.action_space)

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_critics = jax.random.split(key)
        params = net.init(key_critics)
        return Learnt(soft_policy(init_policy(key_policy), 1.0, optimizer), optimized(params, optimizer), jnp.array(params))

    def candidates(actor: Float[Array, " P"], obs: Observation, noise: Float[Array, "N2 M D"]) -> tuple[Array, Array]:
        """Uniform actions and the policy's, ``[2 N, M, D]``, and the log of their densities."""
        # The distribution function of the normal makes its noise uniform.
        uniform = jax.scipy.special.erf(noise[:count] * 0.5**0.5)
        parameters = policy.apply(actor, obs)
        drawn, density = sample_squashed(jnp.broadcast_to(parameters, (count, *parameters.shape)), noise[count:])
        even = jnp.full(density.shape, -dimensions * math.log(2.0))
        return jnp.concatenate([uniform, drawn]), jnp.concatenate([even, density])

    def loss_of(
        params: Float[Array, "K P"],
        batch: Transitions,
        target: Float[Array, "M 1"],
        others: Float[Array, "N M D"],
        density: Float[Array, "N M"],
    ) -> tuple[Array, Metrics]:
        values = net.apply(params, batch.obs, batch.action)
        sampled = jax.vmap(lambda action: net.apply(params, batch.obs, action)[..., 0], out_axes=-1)(others)
        gap = conservative_gap(sampled - (density.T + math.log(2 * count))[None], values[..., 0], batch.weight)
        loss = squared_errors(values, target, batch.weight) + config.alpha * gap
        return loss, {"train/critic_loss": loss, "train/conservative_gap": gap, "train/q_mean": jnp.mean(values)}

    def learn(learnt: Learnt, batch: Transitions, noise: Float[Array, "N M D"], rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        actor = learnt.policy.actor.params
        next_action, _ = sample_squashed(policy.apply(actor, batch.next_obs), noise[0])
        target = batch.reward[:, None] + batch.discount[:, None] * lowest(net.apply(learnt.target_params, batch.next_obs, next_action))
        others, density = jax.lax.stop_gradient(candidates(actor, batch.obs, noise[2:]))
        (_, metrics), gradient = jax.value_and_grad(loss_of, has_aux=True)(learnt.critics.params, batch, target, others, density)
        judged, metrics["train/critic_grad_norm"] = descend(optimizer, rate, learnt.critics, gradient)

        def q_of(obs: Observation, action: Float[Array, "M D"]) -> Float[Array, " M"]:
            return lowest(net.apply(judged.params, obs, action))[:, 0]

        better, told = improve_policy(learnt.policy, policy.apply, q_of, batch.obs, noise[1], batch.weight, heat, optimizer, rate)
        return Learnt(better, judged, follow(learnt.target_params, judged.params, config.tau)), metrics | told

    def greedy(acting: Acting, obs: Observation) -> Float[Array, "M D"]:
        return squashed_mode(policy.apply(acting.actor, obs))

    return Method(
        name="cql",
        dimensions=dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.policy.actor.params, learnt.critics.params),
        explore=lambda acting, obs, noise: sample_squashed(policy.apply(acting.actor, obs), noise)[0],
        greedy=greedy,
        value=lambda acting, obs: lowest(net.apply(acting.critics, obs, greedy(acting, obs)))[:, 0],
        draw=lambda key, updates: jax.random.normal(key, (updates, 2 + 2 * count, config.batch_size, dimensions)),
        learn=learn,
        look=lambda learnt, batch: look_into_actor_critic(policy, learnt.policy.actor, net, learnt.critics, batch.obs, batch.action),
    )
