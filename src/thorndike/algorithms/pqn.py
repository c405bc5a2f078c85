"""Parallelised Q-network (PQN): Q-learning with a network, without replay and without a target network.

Gallici et al. 2024, "Simplifying Deep Temporal Difference Learning" (arXiv:2407.04811), algorithm 1. Many environments step side by side;
each rollout gives lambda returns of the best action's value (Peng's Q(lambda)), learnt from in a few epochs of minibatches and thrown away.
Layer normalisation is what keeps it from diverging (theorem 2). Deviations from the paper:

1. A step cut by a time limit bootstraps from the observation it was cut at.
2. Rewards are not scaled here; the wrapper ``normalize_reward`` does.
3. Defaults are for 16 environments and small problems.

Logs ``train/loss``, ``train/q_mean``, ``train/grad_norm``, ``train/learning_rate``, ``rollout/exploration_rate``. Results and their
commands: docs/algorithms/pqn.md.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Optimized, descend, optimized
from thorndike.functional.exploration import epsilon_greedy
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.returns import lambda_return
from thorndike.functional.schedules import Rate, schedule
from thorndike.functional.shuffling import minibatch_size, minibatches
from thorndike.functional.temporal_difference import select
from thorndike.networks.cnn import CNNS
from thorndike.networks.heads import Shape, q_network
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.masking import allowed, has_mask
from thorndike.networks.network import Network, NetworkBuilder, as_rows, flattened
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of PQN, named as in Stable-Baselines3's PPO and DQN."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 5e-4  # RAdam's step size, or a schedule such as linear(1e-3, 0)
    n_steps: Annotated[int, AtLeast(1)] = 32  # T: steps of each environment in a rollout
    batch_size: Annotated[int, AtLeast(1)] = 64  # rows of a minibatch
    n_epochs: Annotated[int, AtLeast(1)] = 4  # passes over a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    trace_decay: Annotated[float, Between(0, 1)] = 0.95  # lambda: how far returns trust what followed over the network's values
    exploration_fraction: Annotated[float, MoreThan(0)] = 0.2  # share of the run over which epsilon falls
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # epsilon at the start
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # epsilon at the end
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    layer_norm: bool = True  # normalise each hidden layer
    net_arch: tuple[int, ...] = (128, 128)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: Optimized
    """Parameters as one flat vector, and RAdam's moments."""
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    params: Float[Array, " P"]
    epsilon: Float[Array, ""]


class Minibatch(NamedTuple):
    """Rows of a rollout and what they are to be worth."""

    obs: Observation
    action: Int[Array, " M"]
    target: Float[Array, " M"]
    weight: Float[Array, " M"]
    """0 for a row that is no transition."""


def pqn_loss(params: Float[Array, " P"], batch: Minibatch, network: Network) -> tuple[Float[Array, ""], Metrics]:
    """Half the squared error of the chosen actions' values: paper, algorithm 1."""
    chosen = select(network.apply(params, batch.obs), batch.action)
    loss = 0.5 * weighted_mean(jnp.square(chosen - batch.target), batch.weight)
    return loss, {"train/loss": loss, "train/q_mean": weighted_mean(chosen, batch.weight)}


def prepare(rollout: Rollout, params: Float[Array, " P"], network: Network, config: Config) -> Minibatch:
    """The rows of a rollout with their lambda returns, ``[T * B, ...]``."""
    step = rollout.step
    best = jnp.max(network.apply(params, as_rows(step.next_obs)), axis=-1).reshape(step.reward.shape)
    target = lambda_return(step.reward, best, step.terminated, step.done | ~step.valid, config.gamma, config.trace_decay)
    return as_rows(Minibatch(rollout.obs, rollout.action, target, step.valid.astype(jnp.float32)))


def improve(
    learnt: Optimized,
    batch: Minibatch,
    order: Int[Array, "minibatches M"],
    network: Network,
    optimizer: optax.GradientTransformation,
    rate: Float[Array, ""],
) -> tuple[Optimized, Metrics]:
    """One optimiser step a minibatch."""
    gradient = jax.grad(partial(pqn_loss, network=network), has_aux=True)

    def step(learnt: Optimized, rows: Int[Array, " M"]) -> tuple[Optimized, Metrics]:
        grads, metrics = gradient(learnt.params, jax.tree.map(lambda x: x[rows], batch))
        after, metrics["train/grad_norm"] = descend(optimizer, rate, learnt, grads)
        return accept_if(all_finite(metrics["train/loss"], metrics["train/grad_norm"]), after, learnt), metrics

    learnt, metrics = jax.lax.scan(step, learnt, order)
    return learnt, jax.tree.map(jnp.mean, metrics)


def pqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """PQN for an environment with Discrete actions. Raises ``UserError`` for others, and a rollout that minibatches do not divide."""
    if not isinstance(spec.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"pqn takes Discrete actions; {spec.id} has {spec.action_space}; ppo, a2c and reinforce take the others")
    rows = config.n_steps * spec.num_envs
    per_minibatch = minibatch_size("pqn", config.n_steps, spec.num_envs, config.batch_size)
    example = example_observation(spec.observation_space)
    shape = Shape(config.net_arch, config.activation, layer_norm=config.layer_norm, cnn=config.cnn)
    plain = q_network(spec, int(spec.action_space.n), shape, dueling=False, given=network)
    if plain.recurrence is not None:
        raise UserError("pqn has no memory: give a network without one, or use dqn with memory")
    net = flattened(plain, example)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_radam())
    falling = Rate("linear", config.exploration_initial_eps, config.exploration_final_eps, jnp.minimum(config.exploration_fraction, 1.0))
    learning_rate, exploration = schedule(config.learning_rate), schedule(falling)

    def init(key: Key[Array, ""]) -> State:
        return State(optimized(ravel_pytree(plain.init(key, example))[0], optimizer), jnp.zeros((), jnp.int32))

    def actor(state: State) -> Actor:
        return Actor(state.learnt.params, exploration(state.env_steps / config.total_steps))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Float[Array, " B"]) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        mask = allowed(obs) if has_mask(spec.observation_space) else None
        return memory, epsilon_greedy(net.apply(actor.params, obs), actor.epsilon, noise, random_ties=False, allowed=mask).action, {}

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        return memory, jnp.argmax(net.apply(actor.params, obs), axis=-1).astype(jnp.int32), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate = learning_rate(state.env_steps / config.total_steps)
        batch = prepare(rollout, state.learnt.params, net, config)
        order = minibatches(key, rows, config.n_epochs, per_minibatch)
        learnt, metrics = improve(state.learnt, batch, order, net, optimizer, rate)
        metrics |= {"train/learning_rate": rate, "rollout/exploration_rate": actor(state).epsilon}
        return State(learnt, state.env_steps + rows), metrics

    return Algorithm(
        init=init,
        actor=actor,
        memory=lambda batch: (),
        draw=lambda key, steps: jax.random.uniform(key, (steps, spec.num_envs)),
        act=act,
        greedy=greedy,
        value=lambda actor, obs: jnp.max(net.apply(actor.params, obs), axis=-1),
        update=update,
        observe=lambda state, rollout, key: (state, {}),
        needs=Needs(rollout_length=config.n_steps, on_policy=True),
        dynamics=lambda state, rollout: look_into_rollout(net, state.learnt.params, rollout.obs, state.learnt.opt_state),
    )
