"""Deep Q-network (DQN), with double, dueling and n-step targets as parts to switch on.

Mnih et al. 2015, "Human-level control through deep reinforcement learning" (Nature 518); double: van Hasselt et al. 2016
(arXiv:1509.06461); dueling: Wang et al. 2016 (arXiv:1511.06581); n-step: Hessel et al. 2018 (arXiv:1710.02298). Deviations from Mnih:

1. Adam with gradients clipped by their global norm, in place of RMSProp (as in Stable-Baselines3).
2. A step cut by a time limit bootstraps from the observation it was cut at.
3. Several environments step side by side; ``train_freq`` and ``target_update_interval`` count steps of all of them together.
4. ``learning_starts`` and ``target_update_interval`` take effect at the end of the iteration (``train_freq`` steps) they fall in.

Logs ``train/loss``, ``train/q_mean``, ``train/grad_norm``, ``train/learning_rate``, ``rollout/exploration_rate``. Results and their
commands: docs/algorithms/dqn.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.exploration import epsilon_greedy
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.networks.heads import Shape, q_network
from thorndike.networks.masking import allowed, has_mask
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, flattened, fresh_memory
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.replay.uniform import ReplayBuffer, Transitions, add, init_replay, row_shapes, sample, sample_sequences
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of DQN, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 100_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 1_000  # environment steps before the first update
    batch_size: Annotated[int, AtLeast(1)] = 32  # M: transitions of a minibatch
    train_freq: Annotated[int, AtLeast(1)] = 4  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(1)] = 1  # updates in a round
    target_update_interval: Annotated[int, AtLeast(1)] = 10_000  # C: environment steps between updates of the target network
    tau: Annotated[float, Between(0, 1)] = 1.0  # how far the target moves to the network then
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    exploration_fraction: Annotated[float, MoreThan(0)] = 0.1  # share of the run over which epsilon falls
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # epsilon at the start
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # epsilon at the end
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    double: bool = False  # choose the next action by the network, value it by the target
    dueling: bool = False  # separate streams for value and advantages
    n_step: Annotated[int, AtLeast(1)] = 1  # rewards summed before bootstrapping
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width
    sequence_length: Annotated[int, AtLeast(2)] = 16  # with memory: steps of a sampled sequence; a minibatch holds batch_size in all
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next. Parameters are flat vectors: see ``dqn``."""

    params: Float[Array, " P"]
    target_params: Float[Array, " P"]
    opt_state: PyTree
    replay: ReplayBuffer
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    params: Float[Array, " P"]
    epsilon: Float[Array, ""]


def q_loss(
    q: Float[Array, "*M A"],
    next_online: Float[Array, "*M A"] | None,
    next_target: Float[Array, "*M A"],
    batch: Transitions,
) -> tuple[Float[Array, ""], Metrics]:
    """Huber loss of temporal-difference errors: Mnih et al. 2015, eq. 2; given the network's own next values, van Hasselt et al., eq. 4."""
    if next_online is None:
        next_value = jnp.max(next_target, axis=-1)
    else:
        best = jax.nn.one_hot(jnp.argmax(next_online, axis=-1), next_target.shape[-1])
        next_value = jnp.sum(jnp.where(best > 0, next_target, 0.0), axis=-1)
    target = jax.lax.stop_gradient(batch.reward + batch.discount * next_value)
    # A masked sum, because a forbidden action's value is so low that a product with 0 would lose all digits of the others.
    chosen = jnp.sum(jnp.where(jax.nn.one_hot(batch.action, q.shape[-1]) > 0, q, 0.0), axis=-1)
    loss = weighted_mean(optax.losses.huber_loss(chosen, target), batch.weight)
    return loss, {"train/loss": loss, "train/q_mean": jnp.mean(chosen)}


def dqn_loss(params: PyTree, target_params: PyTree, batch: Transitions, network: Network, double: bool) -> tuple[Float[Array, ""], Metrics]:
    """The loss of a minibatch of transitions."""
    next_online = network.apply(params, batch.next_obs) if double else None
    return q_loss(network.apply(params, batch.obs), next_online, network.apply(target_params, batch.next_obs), batch)


def sequence_loss(
    params: PyTree, target_params: PyTree, sequences: Rollout, network: Network, double: bool, gamma: float
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of sequences ``[T, M]``, whose memories both networks unroll from the stored one (Hausknecht and Stone 2015, R2D2)."""
    q, next_online = apply_rollout(network, params, sequences)
    _, next_target = apply_rollout(network, target_params, sequences)
    step = sequences.step
    discount, weight = jnp.where(step.terminated, 0.0, gamma), step.valid.astype(jnp.float32)
    batch = Transitions(sequences.obs, sequences.action, step.reward, step.next_obs, discount, weight)
    return q_loss(q, next_online if double else None, next_target, batch)


def sizes(config: Config, num_envs: int) -> tuple[int, int, int]:
    """Steps an environment makes in an iteration, steps the ring holds, and iterations of warm-up."""
    rollout_length = max(1, config.train_freq // num_envs)
    per_iteration = rollout_length * num_envs
    blocks = max(1, config.buffer_size // per_iteration)
    follow = config.sequence_length if config.memory != "none" else config.n_step
    enough_for_a_sample = -(-(follow + 1) // rollout_length)
    warmup = max(enough_for_a_sample, -(-config.learning_starts // per_iteration))
    if blocks < enough_for_a_sample:
        raise UserError(f"dqn: buffer_size {config.buffer_size} holds fewer than the {follow + 1} steps of a sample; make it larger")
    return rollout_length, blocks * rollout_length, warmup


def dqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """DQN for an environment with Discrete actions. Raises ``UserError`` for other action spaces."""
    if not isinstance(spec.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"dqn takes Discrete actions; {spec.id} has {spec.action_space}; ppo, a2c and reinforce take the others")
    actions = int(spec.action_space.n)
    rollout_length, ring_steps, warmup = sizes(config, spec.num_envs)
    per_iteration = rollout_length * spec.num_envs
    target_every = max(1, config.target_update_interval // per_iteration)
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size)
    net = q_network(spec, actions, shape, config.dueling, network)
    if net.recurrence is not None and config.n_step > 1:
        raise UserError(f"dqn with memory learns from single steps: set n_step to 1, not {config.n_step}")
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam())
    learning_rate = schedule(config.learning_rate)
    final, fraction = config.exploration_final_eps, min(config.exploration_fraction, 1.0)
    exploration = schedule(f"linear({config.exploration_initial_eps}, {final}, {fraction})")
    example = example_observation(spec.observation_space)
    # Parameters travel as one flat vector: optimiser, target and gradient are then a few kernels, not a few a layer.
    flat_net = flattened(net, example)
    sequences = max(1, config.batch_size // config.sequence_length)

    def init(key: Key[Array, ""]) -> State:
        params = ravel_pytree(net.init(key, example))[0]
        replay = init_replay(row_shapes(spec, fresh_memory(net, 1)), ring_steps, spec.num_envs)
        return State(params, jnp.array(params), optimizer.init(params), replay, jnp.zeros((), jnp.int32))

    def actor(state: State) -> Actor:
        return Actor(state.params, exploration(state.env_steps / config.total_steps))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Float[Array, " B"]) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        later, q = apply_step(flat_net, actor.params, memory, obs)
        mask = allowed(obs) if has_mask(spec.observation_space) else None
        choice = epsilon_greedy(q, actor.epsilon, noise, random_ties=False, allowed=mask)
        return later, choice.action, {"memory": memory}

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        memory, q = apply_step(flat_net, actor.params, memory, obs)
        return memory, jnp.argmax(q, axis=-1).astype(jnp.int32), {}

    def loss(params: Array, target_params: Array, replay: ReplayBuffer, key: Key[Array, ""]) -> tuple[Array, Metrics]:
        if net.recurrence is None:
            batch = sample(replay, key, config.batch_size, spec.num_envs, config.n_step, config.gamma)
            return dqn_loss(params, target_params, batch, flat_net, config.double)
        rollout = sample_sequences(replay, key, sequences, config.sequence_length, spec.num_envs)
        return sequence_loss(params, target_params, rollout, flat_net, config.double, config.gamma)

    gradient = jax.grad(loss, has_aux=True)

    def observe(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        metrics = {"rollout/exploration_rate": actor(state).epsilon}
        return state._replace(replay=add(state.replay, rollout), env_steps=state.env_steps + per_iteration), metrics

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate = learning_rate(state.env_steps / config.total_steps)
        replay = add(state.replay, rollout)

        def learn(carry: tuple[Array, PyTree], key: Key[Array, ""]) -> tuple[tuple[Array, PyTree], Metrics]:
            params, opt_state = carry
            grads, metrics = gradient(params, state.target_params, replay, key)
            direction, new_opt_state = optimizer.update(grads, opt_state)
            metrics["train/grad_norm"] = jnp.linalg.norm(grads)
            accepted = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
            return accept_if(accepted, (params - rate * direction, new_opt_state), (params, opt_state)), metrics

        keys = jax.random.split(key, config.gradient_steps)
        (params, opt_state), metrics = jax.lax.scan(learn, (state.params, state.opt_state), keys)
        env_steps = state.env_steps + per_iteration
        due = (env_steps // per_iteration) % target_every == 0
        target = jnp.where(due, config.tau * params + (1.0 - config.tau) * state.target_params, state.target_params)
        metrics = jax.tree.map(jnp.mean, metrics) | {"train/learning_rate": rate, "rollout/exploration_rate": actor(state).epsilon}
        return State(params, target, opt_state, replay, env_steps), metrics

    return Algorithm(
        init=init,
        actor=actor,
        memory=lambda batch: fresh_memory(net, batch),
        draw=lambda key, steps: jax.random.uniform(key, (steps, spec.num_envs)),
        act=act,
        greedy=greedy,
        value=lambda actor, obs: jnp.max(flat_net.apply(actor.params, obs), axis=-1),
        update=update,
        observe=observe,
        needs=Needs(rollout_length=rollout_length, on_policy=False, warmup_iterations=warmup),
    )
