"""CrossQ: soft actor-critic without target networks, with batch-renormalised networks and wide critics.

Bhatt, Palenicek, Belousov, Argus, Amiranashvili, Brox, Peters 2024, "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater
Sample Efficiency and Simplicity" (arXiv:1902.05605). Deviations:

1. The temperature's loss is ``-log alpha (log pi + target entropy)``, as in Stable-Baselines3.
2. A step cut by a time limit bootstraps from the observation it was cut at.
3. Several environments step side by side; ``train_freq`` counts the steps of all of them together.
4. Images are taken as rows of numbers: there are no convolutions here.

Logs what SAC logs. Results and their commands: docs/algorithms/crossq.md.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from thorndike.functional.critic_losses import lowest, squared_errors
from thorndike.functional.descent import Optimized, descend, every, optimized
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.soft_policy import SoftPolicy, improve_policy, soft_policy, temperature
from thorndike.functional.squashed_gaussian import sample_squashed, squashed_mode
from thorndike.networks.batch_renorm import RenormalizedNetwork, renormalized_network
from thorndike.networks.continuous import box_dimensions
from thorndike.networks.torso import ACTIVATIONS, example_observation, flatten_observation
from thorndike.replay.hindsight import STRATEGIES
from thorndike.replay.off_policy import Method, off_policy
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Observation


@dataclass(frozen=True)
class Config:
    """Settings of CrossQ, named and preset as in sb3-contrib, but for the critics' width, which is the paper's."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    ent_coef: float | Literal["auto"] = "auto"  # alpha: the temperature, or auto to learn it
    ent_coef_init: Annotated[float, AtLeast(1e-8)] = 1.0  # what a learnt alpha starts at
    target_entropy: float | Literal["auto"] = "auto"  # what a learnt alpha aims at; auto: minus the number of action dimensions
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    policy_delay: Annotated[int, AtLeast(1)] = 3  # updates of the critics for each one of the policy
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    renorm_warmup: Annotated[int, AtLeast(0)] = 100_000  # updates before batch normalisation becomes renormalisation
    net_arch: tuple[int, ...] = (256, 256)  # widths of the policy's hidden layers
    critic_net_arch: tuple[int, ...] = (2048, 2048)  # widths of the critics' hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class Learnt(NamedTuple):
    """All that is learnt."""

    policy: SoftPolicy
    policy_moments: Float[Array, " S"]
    critics: Optimized
    """Parameters ``[K, P]``."""
    critic_moments: Float[Array, "K S"]


class Acting(NamedTuple):
    """What acting and valuing need."""

    actor: Float[Array, " P"]
    actor_moments: Float[Array, " S"]
    critics: Float[Array, "K P"]
    critic_moments: Float[Array, "K S"]


def joint_loss(
    params: Float[Array, "K P"],
    moments: Float[Array, "K S"],
    net: RenormalizedNetwork,
    rows: Float[Array, "M F"],
    next_rows: Float[Array, "M F"],
    batch: Transitions,
    entropy_bonus: Float[Array, " M"],
) -> tuple[Float[Array, ""], tuple[Float[Array, "K S"], Float[Array, ""]]]:
    """Squared errors of all critics, the running moments after them, and the mean Q.

    Present and next values come from one pass, so that both are normalised alike: Bhatt et al. 2024, section 3.2.
    """
    both, later = jax.vmap(net.learning, (0, 0, None))(params, moments, jnp.concatenate([rows, next_rows]))
    values, next_values = jnp.split(both, 2, axis=1)
    target = batch.reward[:, None] + batch.discount[:, None] * (lowest(next_values) - entropy_bonus[:, None])
    return squared_errors(values, jax.lax.stop_gradient(target), batch.weight), (later, jnp.mean(values))


def look_into_both(
    learnt: Learnt, policy: RenormalizedNetwork, net: RenormalizedNetwork, rows: Float[Array, "M F"], action: Float[Array, "M D"]
) -> Metrics:
    """Dead units, effective rank and gradient norms of the policy and of the critics."""
    own, judges = learnt.policy.actor, learnt.critics
    squares, critic_squares = mean_square_gradient(own.opt_state)[None], mean_square_gradient(judges.opt_state)
    metrics = policy.look("actor", own.params[None], learnt.policy_moments[None], squares, rows)
    seen = jnp.concatenate([rows, action], axis=-1)
    return metrics | net.look("critics", judges.params, learnt.critic_moments, critic_squares, seen)


def crossq(config: Config, spec: EnvSpec) -> Algorithm:
    """CrossQ for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    dimensions = box_dimensions("crossq", spec)
    example = example_observation(spec.observation_space)
    width = math.prod(np.shape(flatten_observation(spec.observation_space, example)))
    policy = renormalized_network(width, 2 * dimensions, config.net_arch, config.activation, config.renorm_warmup)
    net = renormalized_network(width + dimensions, 1, config.critic_net_arch, config.activation, config.renorm_warmup)
    heat = temperature(config.ent_coef, config.target_entropy, spec.action_space)
    optimizer = optax.scale_by_adam(b1=0.5)

    def flat(obs: Observation) -> Float[Array, "M F"]:
        return flatten_observation(spec.observation_space, obs)

    def judge(critics: Array, moments: Array, obs: Observation, action: Float[Array, "M D"]) -> Float[Array, " M"]:
        rows = jnp.concatenate([flat(obs), action], axis=-1)
        return lowest(jax.vmap(net.acting, (0, 0, None))(critics, moments, rows))[:, 0]

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_critics = jax.random.split(key)
        actor, actor_moments = policy.init(key_policy)
        judges, moments = jax.vmap(net.init)(jax.random.split(key_critics, config.n_critics))
        return Learnt(soft_policy(actor, config.ent_coef_init, optimizer), actor_moments, optimized(judges, optimizer), moments)

    def learn(learnt: Learnt, batch: Transitions, noise: Float[Array, "2 M D"], rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        obs, next_obs = flat(batch.obs), flat(batch.next_obs)
        next_action, next_log_prob = sample_squashed(policy.acting(learnt.policy.actor.params, learnt.policy_moments, next_obs), noise[0])
        rows, next_rows = jnp.concatenate([obs, batch.action], axis=-1), jnp.concatenate([next_obs, next_action], axis=-1)
        bonus = heat.of(learnt.policy) * next_log_prob
        (loss, (moments, q_mean)), gradient = jax.value_and_grad(joint_loss, has_aux=True)(
            learnt.critics.params, learnt.critic_moments, net, rows, next_rows, batch, bonus
        )
        judged, norm = descend(optimizer, rate, learnt.critics, gradient)

        def improve(held: tuple[SoftPolicy, Array]) -> tuple[tuple[SoftPolicy, Array], Metrics]:
            soft, own = held
            # The same pass as in the loss, of which the compiler makes one.
            later = policy.learning(soft.actor.params, own, obs)[1]
            better, metrics = improve_policy(
                soft,
                lambda params, rows: policy.learning(params, own, rows)[0],
                lambda rows, action: judge(judged.params, moments, batch.obs, action),
                obs,
                noise[1],
                batch.weight,
                heat,
                optimizer,
                rate,
            )
            return (better, later), metrics

        (better, own), metrics = every(config.policy_delay, number, improve, (learnt.policy, learnt.policy_moments))
        metrics |= {"train/critic_loss": loss, "train/q_mean": q_mean, "train/critic_grad_norm": norm}
        return Learnt(better, own, judged, moments), metrics

    def outputs(acting: Acting, obs: Observation) -> Float[Array, "M D2"]:
        return policy.acting(acting.actor, acting.actor_moments, flat(obs))

    method = Method(
        name="crossq",
        dimensions=dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.policy.actor.params, learnt.policy_moments, learnt.critics.params, learnt.critic_moments),
        explore=lambda acting, obs, noise: sample_squashed(outputs(acting, obs), noise)[0],
        greedy=lambda acting, obs: squashed_mode(outputs(acting, obs)),
        value=lambda acting, obs: judge(acting.critics, acting.critic_moments, obs, squashed_mode(outputs(acting, obs))),
        draw=lambda key, updates: jax.random.normal(key, (updates, 2, config.batch_size, dimensions)),
        learn=learn,
        look=lambda learnt, batch: look_into_both(learnt, policy, net, flat(batch.obs), batch.action),
    )
    return off_policy(method, config, spec)
