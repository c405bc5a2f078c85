"""Twin delayed deep deterministic policy gradient (TD3).

Fujimoto, van Hoof, Meger 2018, "Addressing Function Approximation Error in Actor-Critic Methods" (arXiv:1802.09477). Deviations:

1. A step cut by a time limit bootstraps from the observation it was cut at.
2. Several environments step side by side; ``train_freq`` counts the steps of all of them together.
3. With ``noise_color`` above 0 the exploration noise is correlated over time (Eberhard et al. 2023, pink noise).

Logs ``train/actor_loss``, ``critic_loss``, ``q_mean``, ``actor_grad_norm``, ``critic_grad_norm``, ``learning_rate``. Results and their
commands: docs/algorithms/td3.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.functional.critic_losses import lowest, squared_errors
from thorndike.functional.descent import Optimized, descend, every, follow, optimized
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.continuous import box_dimensions, critics, look_into_actor_critic, policy_outputs
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.hindsight import STRATEGIES
from thorndike.replay.off_policy import Method, off_policy
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Number, Observation


@dataclass(frozen=True)
class Config:
    """Settings of TD3, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update of the policy
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    policy_delay: Annotated[int, AtLeast(1)] = 2  # d: updates of the critics for each one of the policy
    target_policy_noise: Annotated[float, AtLeast(0)] = 0.2  # sigma~: deviation of the noise on the target's actions, in [-1, 1]
    target_noise_clip: Annotated[float, AtLeast(0)] = 0.5  # c: what that noise is clipped to
    action_noise: Annotated[float, AtLeast(0)] = 0.1  # sigma: deviation of the exploration noise
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Policy(NamedTuple):
    """What is updated once in ``policy_delay``."""

    actor: Optimized
    target_actor: Float[Array, " P"]
    target_critics: Float[Array, "K P"]


class Learnt(NamedTuple):
    """All that is learnt."""

    policy: Policy
    critics: Optimized
    """Parameters ``[K, P]``."""


class Acting(NamedTuple):
    """What acting and valuing need."""

    actor: Float[Array, " P"]
    critics: Float[Array, "K P"]


class Parts(NamedTuple):
    """What TD3 and DDPG differ in."""

    tau: Number
    n_critics: int
    policy_delay: int
    target_policy_noise: Number
    target_noise_clip: Number
    action_noise: Number
    objective: Callable[[Float[Array, " M"], Float[Array, "M D"], Transitions], Float[Array, ""]]
    """Q of the policy's actions, those actions, the minibatch -> what the policy descends."""


class Sizes(Protocol):
    """The settings that the networks and minibatches are made by."""

    @property
    def batch_size(self) -> int:
        """Transitions of a minibatch."""

    @property
    def net_arch(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""

    @property
    def activation(self) -> str:
        """After each hidden layer."""


def climb(q: Float[Array, " M"], action: Float[Array, "M D"], batch: Transitions) -> Float[Array, ""]:
    """TD3's own objective: the first critic's value, with its sign turned."""
    return -weighted_mean(q, batch.weight)


def deterministic_actor_critic(name: str, config: Sizes, parts: Parts, spec: EnvSpec, network: NetworkBuilder | None) -> Method:
    """A learner with a deterministic policy, from its parts. Raises ``UserError`` unless actions are a Box."""
    dimensions = box_dimensions(name, spec)
    outputs, init_policy = policy_outputs(spec, dimensions, config.net_arch, config.activation, network)
    net = critics(spec, dimensions, parts.n_critics, config.net_arch, config.activation)
    optimizer = optax.scale_by_adam()

    def policy(params: Float[Array, " P"], obs: Observation) -> Float[Array, "M D"]:
        return jnp.tanh(outputs.apply(params, obs))

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_critics = jax.random.split(key)
        actor, judges = init_policy(key_policy), net.init(key_critics)
        return Learnt(Policy(optimized(actor, optimizer), jnp.array(actor), jnp.array(judges)), optimized(judges, optimizer))

    def critic_loss(params: Float[Array, "K P"], batch: Transitions, target: Float[Array, "M 1"]) -> tuple[Array, Array]:
        values = net.apply(params, batch.obs, batch.action)
        return squared_errors(values, target, batch.weight), jnp.mean(values)

    def policy_loss(params: Float[Array, " P"], judges: Float[Array, "K P"], batch: Transitions) -> Float[Array, ""]:
        action = policy(params, batch.obs)
        return parts.objective(net.apply(judges[:1], batch.obs, action)[0, :, 0], action, batch)

    def learn(learnt: Learnt, batch: Transitions, noise: Float[Array, "M D"], rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        clip = parts.target_noise_clip
        smoothing = jnp.clip(parts.target_policy_noise * noise, -clip, clip)
        next_action = jnp.clip(policy(learnt.policy.target_actor, batch.next_obs) + smoothing, -1.0, 1.0)
        next_values = lowest(net.apply(learnt.policy.target_critics, batch.next_obs, next_action))
        target = batch.reward[:, None] + batch.discount[:, None] * next_values
        (loss, q_mean), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learnt.critics.params, batch, target)
        judged, norm = descend(optimizer, rate, learnt.critics, gradient)

        def improve(held: Policy) -> tuple[Policy, Metrics]:
            policy_error, slope = jax.value_and_grad(policy_loss)(held.actor.params, judged.params, batch)
            actor, policy_norm = descend(optimizer, rate, held.actor, slope)
            targets = follow(held.target_actor, actor.params, parts.tau), follow(held.target_critics, judged.params, parts.tau)
            return Policy(actor, *targets), {"train/actor_loss": policy_error, "train/actor_grad_norm": policy_norm}

        better, metrics = every(parts.policy_delay, number, improve, learnt.policy)
        metrics |= {"train/critic_loss": loss, "train/q_mean": q_mean, "train/critic_grad_norm": norm}
        return Learnt(better, judged), metrics

    return Method(
        name=name,
        dimensions=dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.policy.actor.params, learnt.critics.params),
        explore=lambda acting, obs, noise: jnp.clip(policy(acting.actor, obs) + parts.action_noise * noise, -1.0, 1.0),
        greedy=lambda acting, obs: policy(acting.actor, obs),
        value=lambda acting, obs: lowest(net.apply(acting.critics, obs, policy(acting.actor, obs)))[:, 0],
        draw=lambda key, updates: jax.random.normal(key, (updates, config.batch_size, dimensions)),
        learn=learn,
        look=lambda learnt, batch: look_into_actor_critic(outputs, learnt.policy.actor, net, learnt.critics, batch.obs, batch.action),
    )


def td3(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """TD3 for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    parts = Parts(
        tau=config.tau,
        n_critics=config.n_critics,
        policy_delay=config.policy_delay,
        target_policy_noise=config.target_policy_noise,
        target_noise_clip=config.target_noise_clip,
        action_noise=config.action_noise,
        objective=climb,
    )
    return off_policy(deterministic_actor_critic("td3", config, parts, spec, network), config, spec)
