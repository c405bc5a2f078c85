"""Soft actor-critic (SAC), with a learnt temperature.

Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications" (arXiv:1812.05905). With ``n_critics=10``, ``n_target_critics=2``,
``policy_objective="mean"`` and 20 gradient steps it is REDQ (see redq.py). Deviations from the paper:

1. The temperature's loss is ``-log alpha (log pi + target entropy)``, as in Stable-Baselines3, not ``-alpha (...)``.
2. A step cut by a time limit bootstraps from the observation it was cut at.
3. Several environments step side by side; ``train_freq`` counts the steps of all of them together.
4. With ``noise_color`` above 0 the exploration noise is correlated over time (Eberhard et al. 2023, pink noise).

Logs ``train/actor_loss``, ``critic_loss``, ``ent_coef``, ``ent_coef_loss``, ``entropy``, ``q_mean``, ``actor_grad_norm``,
``critic_grad_norm``, ``learning_rate``. Results and their commands: docs/algorithms/sac.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from thorndike.errors import UserError
from thorndike.functional.critic_losses import chosen_critics, lowest, squared_errors
from thorndike.functional.descent import Optimized, descend, every, follow, optimized
from thorndike.functional.held_noise import noise_features, state_dependent_sample, with_held_noise
from thorndike.functional.soft_policy import SoftPolicy, Temperature, improve_policy, soft_policy, temperature
from thorndike.functional.squashed_gaussian import sample_squashed, squashed_mode
from thorndike.networks.continuous import (
    StateDependent,
    box_dimensions,
    critics,
    look_into_actor_critic,
    policy_outputs,
    state_dependent,
)
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.hindsight import STRATEGIES
from thorndike.replay.off_policy import Method, Settings, off_policy
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Number, Observation


@dataclass(frozen=True)
class Config:
    """Settings of SAC, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    ent_coef: float | Literal["auto"] = "auto"  # alpha: the temperature, or auto to learn it
    ent_coef_init: Annotated[float, AtLeast(1e-8)] = 1.0  # what a learnt alpha starts at
    target_entropy: float | Literal["auto"] = "auto"  # what a learnt alpha aims at; auto: minus the number of action dimensions
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    n_target_critics: Annotated[int, AtLeast(1)] = 2  # how many of them, drawn at random each update, the target is the minimum of
    policy_delay: Annotated[int, AtLeast(1)] = 1  # updates of the critics for each one of the policy
    policy_objective: Annotated[str, OneOf("min", "mean")] = "min"  # what the policy climbs: the critics' minimum or their mean
    layer_norm: bool = False  # normalise the critics' hidden layers
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    use_sde: bool = False  # gSDE: explore by noise that depends on the state, and is held
    sde_sample_freq: Annotated[int, AtLeast(-1)] = -1  # steps it is held for; -1: train_freq
    log_std_init: float = -3.0  # with use_sde: log standard deviation of a feature's noise at the start
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)
        if self.n_target_critics > self.n_critics:
            raise UserError(f"sac: n_target_critics {self.n_target_critics} is more than the n_critics {self.n_critics}")


class Learnt(NamedTuple):
    """All that is learnt."""

    policy: SoftPolicy
    critics: Optimized
    """Parameters ``[K, P]``."""
    target_params: Float[Array, "K P"]


class Acting(NamedTuple):
    """What acting and valuing need."""

    actor: Float[Array, " P"]
    critics: Float[Array, "K P"]


class Drawn(NamedTuple):
    """The random numbers of one update."""

    noise: Float[Array, "2 M D"]
    """Standard normal: of the next actions, and of the policy's."""
    ranks: Float[Array, " R"]
    """``[K]`` where the target is formed by some critics: those of the highest rank. ``[0]`` else."""


class Parts(NamedTuple):
    """What SAC and its relatives differ in."""

    exploration: StateDependent | None
    heat: Temperature
    ent_coef_init: Number
    tau: Number
    n_critics: int
    n_target_critics: int
    policy_delay: int
    layer_norm: bool
    outputs: int
    """Numbers a critic gives: 1, or that of its quantiles."""
    pessimism: Callable[[Float[Array, "k M outputs"]], Float[Array, "M kept"]]
    """Values of the target's critics -> what is bootstrapped from."""
    errors: Callable[[Float[Array, "K M outputs"], Float[Array, "M kept"], Float[Array, " M"]], Float[Array, ""]]
    """Values of all critics, target, weight -> loss."""
    objective: Callable[[Float[Array, "K M outputs"]], Float[Array, " M"]]
    """Values of all critics -> what the policy climbs, and what a state is said to be worth."""


def soft_actor_critic(name: str, config: Settings, parts: Parts, spec: EnvSpec, network: NetworkBuilder | None) -> Algorithm:
    """A maximum-entropy learner from its parts. Raises ``UserError`` unless actions are a Box."""
    dimensions = box_dimensions(name, spec)
    smooth = parts.exploration
    outputs = 2 * dimensions if smooth is None else dimensions
    policy, init_policy = policy_outputs(spec, outputs, config.net_arch, config.activation, network, smooth)
    net = critics(spec, dimensions, parts.n_critics, config.net_arch, config.activation, parts.outputs, parts.layer_norm)
    optimizer = optax.scale_by_adam()

    def gaussian(params: Float[Array, " P"], obs: Observation) -> Float[Array, "M D2"]:
        return policy.apply(params, obs)[..., : 2 * dimensions]

    def explore(acting: Acting, obs: Observation, noise: Array) -> Float[Array, "M D"]:
        if smooth is None:
            return sample_squashed(gaussian(acting.actor, obs), noise)[0]
        return jnp.tanh(state_dependent_sample(policy.apply(acting.actor, obs), noise))

    def init(key: Key[Array, ""]) -> Learnt:
        key_policy, key_critics = jax.random.split(key)
        params = net.init(key_critics)
        return Learnt(soft_policy(init_policy(key_policy), parts.ent_coef_init, optimizer), optimized(params, optimizer), jnp.array(params))

    def draw(key: Key[Array, ""], updates: int) -> Drawn:
        key_noise, key_ranks = jax.random.split(key)
        noise = jax.random.normal(key_noise, (updates, 2, config.batch_size, dimensions))
        subset = parts.n_target_critics < parts.n_critics
        ranks = jax.random.uniform(key_ranks, (updates, parts.n_critics)) if subset else jnp.zeros((updates, 0))
        return Drawn(noise, ranks)

    def critic_loss(params: Float[Array, "K P"], batch: Transitions, target: Float[Array, "M kept"]) -> tuple[Array, Array]:
        values = net.apply(params, batch.obs, batch.action)
        return parts.errors(values, target, batch.weight), jnp.mean(values)

    def learn(learnt: Learnt, batch: Transitions, drawn: Drawn, rate: Array, number: Array) -> tuple[Learnt, Metrics]:
        next_action, next_log_prob = sample_squashed(gaussian(learnt.policy.actor.params, batch.next_obs), drawn.noise[0])
        judges = chosen_critics(learnt.target_params, drawn.ranks, parts.n_target_critics)
        next_values = parts.pessimism(net.apply(judges, batch.next_obs, next_action))
        entropy_bonus = parts.heat.of(learnt.policy) * next_log_prob
        target = batch.reward[:, None] + batch.discount[:, None] * (next_values - entropy_bonus[:, None])
        (loss, q_mean), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learnt.critics.params, batch, target)
        judged, norm = descend(optimizer, rate, learnt.critics, gradient)

        def q_of(obs: Observation, action: Float[Array, "M D"]) -> Float[Array, " M"]:
            return parts.objective(net.apply(judged.params, obs, action))

        def improve(held: SoftPolicy) -> tuple[SoftPolicy, Metrics]:
            return improve_policy(held, gaussian, q_of, batch.obs, drawn.noise[1], batch.weight, parts.heat, optimizer, rate)

        better, metrics = every(parts.policy_delay, number, improve, learnt.policy)
        metrics |= {"train/critic_loss": loss, "train/q_mean": q_mean, "train/critic_grad_norm": norm}
        return Learnt(better, judged, follow(learnt.target_params, judged.params, parts.tau)), metrics

    def greedy(acting: Acting, obs: Observation) -> Float[Array, "M D"]:
        return squashed_mode(gaussian(acting.actor, obs))

    method = Method(
        name=name,
        dimensions=dimensions,
        init=init,
        acting=lambda learnt: Acting(learnt.policy.actor.params, learnt.critics.params),
        explore=explore,
        greedy=greedy,
        value=lambda acting, obs: parts.objective(net.apply(acting.critics, obs, greedy(acting, obs))),
        draw=draw,
        learn=learn,
        features=0 if smooth is None else noise_features(config.net_arch[-1]),
        look=lambda learnt, batch: look_into_actor_critic(policy, learnt.policy.actor, net, learnt.critics, batch.obs, batch.action),
    )
    return off_policy(method, config, spec) if smooth is None else with_held_noise(off_policy(method, config, spec), smooth.sample_freq)


def sac(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """SAC for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    over = jnp.min if config.policy_objective == "min" else jnp.mean
    parts = Parts(
        exploration=state_dependent(config.use_sde, config.sde_sample_freq, config.log_std_init, config.noise_color),
        heat=temperature(config.ent_coef, config.target_entropy, spec.action_space),
        ent_coef_init=config.ent_coef_init,
        tau=config.tau,
        n_critics=config.n_critics,
        n_target_critics=config.n_target_critics,
        policy_delay=config.policy_delay,
        layer_norm=config.layer_norm,
        outputs=1,
        pessimism=lowest,
        errors=squared_errors,
        objective=lambda values: over(values[..., 0], axis=0),
    )
    return soft_actor_critic("sac", config, parts, spec, network)
