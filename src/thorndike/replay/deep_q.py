"""The part that all deep Q-learners have in common: act, store, and learn the worth of actions from what replay draws.

A learner brings its settings and ``Options``; ``deep_q`` makes an ``Algorithm`` of them.
"""

from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.distributional import ReturnDistribution, expected_value
from thorndike.functional.exploration import boltzmann, epsilon_greedy, epsilon_greedy_probabilities
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.schedules import Rate, schedule
from thorndike.functional.value_loss import Munchausen, Rule
from thorndike.networks.heads import Shape
from thorndike.networks.hidden_layers import look_into
from thorndike.networks.masking import allowed, has_mask
from thorndike.networks.network import NetworkBuilder, apply_step, fresh_memory
from thorndike.networks.value_network import Form, value_network
from thorndike.replay.age import key_to_look_by
from thorndike.replay.frames import once_each, stacks_of
from thorndike.replay.hindsight import Hindsight, replay_for
from thorndike.replay.pace import Pace, pace
from thorndike.replay.replay import Replay, Ring, prioritized_replay, replayed_observations, sequence_replay, uniform_replay
from thorndike.replay.uniform import row_shapes
from thorndike.replay.value_learning import Parts, State, begin, begin_anew, learn, move_target
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Number, Observation, Rollout, Shared


@runtime_checkable
class Settings(Protocol):
    """The settings that every ``Config`` of this family has; ``algorithms/dqn.py`` says what they are."""

    @property
    def total_steps(self) -> int:
        """Environment steps of the run."""

    @property
    def learning_rate(self) -> float | str:
        """Step size, or a schedule."""

    @property
    def buffer_size(self) -> int:
        """Transitions kept."""

    @property
    def learning_starts(self) -> int:
        """Environment steps before the first update."""

    @property
    def batch_size(self) -> int:
        """Transitions of a minibatch."""

    @property
    def train_freq(self) -> int:
        """Environment steps between rounds of updates."""

    @property
    def gradient_steps(self) -> int:
        """Updates in a round; -1: one an environment step."""

    @property
    def target_update_interval(self) -> int:
        """Environment steps between moves of the target."""

    @property
    def tau(self) -> float:
        """How far it moves then."""

    @property
    def gamma(self) -> float:
        """Discount."""

    @property
    def exploration_fraction(self) -> float:
        """Share of the run over which epsilon falls."""

    @property
    def exploration_initial_eps(self) -> float:
        """Epsilon at the start."""

    @property
    def exploration_final_eps(self) -> float:
        """Epsilon at the end."""

    @property
    def max_grad_norm(self) -> float:
        """The norm the gradient is clipped to."""

    @property
    def adam_eps(self) -> float:
        """Adam's epsilon."""

    @property
    def net_arch(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""

    @property
    def activation(self) -> str:
        """After each hidden layer."""

    @property
    def cnn(self) -> str:
        """The convolutions of images."""


class Priorities(NamedTuple):
    """See ``prioritized.py``."""

    alpha: Number
    beta0: Number
    """Beta at the start; it rises to 1 over the run."""


class Memory(NamedTuple):
    """Recurrent memory of the network."""

    kind: str
    size: int
    sequence_length: int
    """Steps of a sampled sequence; a minibatch holds ``batch_size`` in all."""


class Options(NamedTuple):
    """The parts of this family, each of which can be had alone."""

    distribution: ReturnDistribution = expected_value()
    implicit: bool = False
    """Whether the network takes quantile levels: with ``implicit_quantiles``."""
    double: bool = False
    dueling: bool = False
    n_step: int = 1
    priorities: Priorities | None = None
    noisy_sigma: Number | None = None
    munchausen: Munchausen | None = None
    memory: Memory | None = None
    hindsight: Hindsight | None = None
    reset_every: int = 0
    """Environment steps between new beginnings of the network; 0: never."""
    temperature: Number | str | Rate | None = None
    """Of Boltzmann exploration, or its schedule; None explores by epsilon."""


class Actor(NamedTuple):
    """What acting needs."""

    params: Float[Array, " P"]
    epsilon: Float[Array, ""]
    """The chance of a random action, or the temperature of Boltzmann exploration."""


class Noise(NamedTuple):
    """The random numbers of one step."""

    choice: Float[Array, "*T B"]
    layers: Shared | tuple[()]
    """Of noisy layers ``[*T, N]``; nothing without."""


def deep_q(name: str, config: Settings, options: Options, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """The learner ``name`` for an environment with Discrete actions.

    Raises ``UserError`` for other action spaces, and for parts that do not go together.
    """
    parts, plan = build_parts(name, config, options, spec, network), plan_of(name, config, options, spec.num_envs)
    net, per_iteration = parts.net, plan.rollout_length * spec.num_envs
    learning_rate = schedule(config.learning_rate)
    falling = Rate("linear", config.exploration_initial_eps, config.exploration_final_eps, jnp.minimum(config.exploration_fraction, 1.0))
    by_chance = schedule(falling if options.noisy_sigma is None else 0.0)
    exploration = by_chance if options.temperature is None else schedule(options.temperature)
    beta0 = 1.0 if options.priorities is None else options.priorities.beta0

    def actor(state: State) -> Actor:
        return Actor(state.params, exploration(state.env_steps / config.total_steps))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        layers = noise.layers.numbers if isinstance(noise.layers, Shared) else jnp.zeros(0)
        later, outputs = apply_step(net.network, net.drawn(actor.params, layers), memory, obs)
        mask, q = allowed(obs) if has_mask(spec.observation_space) else None, net.q(outputs, obs)
        if options.temperature is None:
            choice = epsilon_greedy(q, actor.epsilon, noise.choice, random_ties=False, allowed=mask)
        else:
            choice = boltzmann(q, actor.epsilon[None], noise.choice)
        return later, choice.action, {"memory": memory}

    def probabilities(actor: Actor, memory: PyTree, obs: Observation) -> Float[Array, "B A"]:
        _, outputs = apply_step(net.network, net.means(actor.params), memory, obs)
        mask = allowed(obs) if has_mask(spec.observation_space) else None
        return epsilon_greedy_probabilities(net.q(outputs, obs), actor.epsilon, mask)

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        memory, outputs = apply_step(net.network, net.means(actor.params), memory, obs)
        return memory, jnp.argmax(net.q(outputs, obs), axis=-1).astype(jnp.int32), {}

    def observe(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        metrics = {f"rollout/{'exploration_rate' if options.temperature is None else 'temperature'}": actor(state).epsilon}
        return state._replace(replay=parts.replay.add(state.replay, rollout), env_steps=state.env_steps + per_iteration), metrics

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        progress, keys = state.env_steps / config.total_steps, jax.random.split(key, 2 * plan.gradient_steps + 1)
        rate, beta = learning_rate(progress), beta0 + (1.0 - beta0) * progress
        state, explored = observe(state, rollout, key)
        state, metrics = learn(parts, state, keys[:-1], plan.gradient_steps, rate, beta)
        iterations = state.env_steps // per_iteration
        state = move_target(state, iterations, max(1, config.target_update_interval // per_iteration), config.tau)
        if options.reset_every:
            passed = state.env_steps // options.reset_every > (state.env_steps - per_iteration) // options.reset_every
            due = passed & (state.env_steps + options.reset_every <= config.total_steps)
            state = begin_anew(parts, state, due, keys[-1])
        return state, metrics | explored | {"train/learning_rate": rate}

    return Algorithm(
        init=partial(begin, parts),
        actor=actor,
        memory=lambda batch: fresh_memory(net.network, batch),
        draw=lambda key, steps: draw_noise(key, steps, spec.num_envs, net.noise_size),
        act=act,
        greedy=greedy,
        value=lambda actor, obs: jnp.max(net.q(net.network.apply(net.means(actor.params), obs), obs), axis=-1),
        update=update,
        observe=observe,
        needs=Needs(rollout_length=plan.rollout_length, on_policy=False, warmup_iterations=plan.warmup_iterations),
        # Noisy layers act by a draw of their weights: nobody can say how often which action comes first.
        probabilities=probabilities if not net.noise_size and options.temperature is None else None,
        dynamics=lambda state, rollout: look_into_replayed(parts, state, config.batch_size),
    )


def draw_noise(key: Key[Array, ""], steps: int, num_envs: int, noise_size: int) -> Noise:
    """The random numbers of ``steps`` steps, ``noise_size`` of each for noisy layers. Consumes the key."""
    if not noise_size:
        return Noise(jax.random.uniform(key, (steps, num_envs)), ())
    key_choice, key_layers = jax.random.split(key)
    layers = Shared(jax.random.normal(key_layers, (steps, noise_size)))
    return Noise(jax.random.uniform(key_choice, (steps, num_envs)), layers)


def look_into_replayed(parts: Parts, state: State, batch_size: int) -> Metrics:
    """Dead units, effective rank and gradient norms, from observations of the replay, and how old what is replayed is."""
    net, seen = parts.net, replayed_observations(parts.replay, state.replay, key_to_look_by(state.env_steps), batch_size)
    networks = look_into(net.network, net.means(state.params), seen, net.means(mean_square_gradient(state.opt_state)))
    return networks if parts.replay.age is None else networks | {"train/replay_age": parts.replay.age(state.replay)}


def plan_of(name: str, config: Settings, options: Options, num_envs: int) -> Pace:
    """How stepping and learning alternate."""
    follow = options.n_step if options.memory is None else options.memory.sequence_length
    return pace(name, config.buffer_size, config.learning_starts, config.train_freq, config.gradient_steps, num_envs, follow)


def build_parts(name: str, config: Settings, options: Options, spec: EnvSpec, network: NetworkBuilder | None) -> Parts:
    """The learner's parts. Raises ``UserError`` for settings or spaces that do not fit."""
    if not isinstance(spec.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"{name} takes Discrete actions; {spec.id} has {spec.action_space}; ppo, a2c and reinforce take the others")
    refuse_what_does_not_go_together(name, options)
    memory = () if options.memory is None else options.memory[:2]
    form = Form(options.dueling, options.noisy_sigma, options.implicit)
    shape = Shape(config.net_arch, config.activation, *memory)._replace(cnn=config.cnn)
    net = value_network(spec, int(spec.action_space.n), shape, form, options.distribution, network)
    if net.network.recurrence is not None and options.memory is None:
        raise UserError(f"{name}: the network given has a memory; say so by the setting memory, which sequences are sampled for")
    ring = Ring(row_shapes(spec, fresh_memory(net.network, 1)), plan_of(name, config, options, spec.num_envs).ring_steps, spec.num_envs)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=config.adam_eps))
    rule = Rule(options.distribution, options.double, options.munchausen)
    stacks = stacks_of(spec)

    def build(ring: Ring) -> Replay:
        return _replay(config, options, ring, spec)

    return Parts(net, rule, build(ring) if stacks is None else once_each(stacks, ring, build), optimizer, config.gamma)


def _replay(config: Settings, options: Options, ring: Ring, spec: EnvSpec) -> Replay:
    if options.hindsight is not None:
        return replay_for(ring, config.batch_size, config.gamma, options.hindsight, spec)
    if options.memory is not None:
        length = options.memory.sequence_length
        return sequence_replay(ring, max(1, config.batch_size // length), length)
    if options.priorities is not None:
        return prioritized_replay(ring, config.batch_size, options.n_step, config.gamma, options.priorities.alpha)
    return uniform_replay(ring, config.batch_size, options.n_step, config.gamma)


def refuse_what_does_not_go_together(name: str, options: Options) -> None:
    """Raises ``UserError`` for parts whose combination has no meaning, rather than leave one of them out."""
    if options.memory is not None and options.n_step > 1:
        raise UserError(f"{name} with memory learns from single steps: set n_step to 1, not {options.n_step}")
    if options.memory is not None and options.priorities is not None:
        raise UserError(f"{name} with memory learns from sequences drawn uniformly: set prioritized to false, or memory to none")
    if options.temperature is not None and options.noisy_sigma is not None:
        raise UserError(f"{name} with noisy layers explores by them alone: set exploration to epsilon, or noisy to false")
    if options.hindsight is not None and (options.n_step > 1 or options.memory is not None or options.priorities is not None):
        raise UserError(
            f"{name} relabels single steps, drawn uniformly: set n_step to 1, prioritized to false and memory to none, or "
            "goal_selection_strategy to none"
        )
    if options.munchausen is not None and (options.n_step > 1 or options.double):
        raise UserError(f"{name} with munchausen has a target of its own, of single steps: set n_step to 1 and double to false")
