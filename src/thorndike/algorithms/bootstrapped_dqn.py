"""Bootstrapped DQN with randomised priors: deep exploration by Thompson sampling from an ensemble of Q-networks.

Osband, Blundell, Pritzel and Van Roy 2016, "Deep Exploration via Bootstrapped DQN" (arXiv:1602.04621); Osband, Aslanides and Cassirer
2018, "Randomized Prior Functions for Deep Reinforcement Learning" (arXiv:1806.03335). Every episode follows one member of the ensemble,
drawn at its first step: what it believes is tried to the end. Members differ by what they were given to learn from (the bootstrap) and by
a fixed random function added to each (its prior), which keeps them apart where nothing has been seen. Deviations:

1. Members share no layers (as in the second paper and in bsuite); the first paper's share a convolutional torso.
2. The greedy policy follows the mean of the members' values; the first paper lets them vote.
3. The Huber loss and Adam with clipped gradients, in place of the first paper's RMSProp. A member's loss is the mean over the transitions
   of a minibatch that are its own, and the gradient is of the sum over members.
4. Several environments step side by side, each with a member of its own.
5. A step cut by a time limit bootstraps from the observation it was cut at.

Logs ``train/loss`` and ``train/q_mean`` (means over members), ``train/q_spread`` (the members' standard deviation: what is not known yet),
``train/grad_norm``, ``train/learning_rate``. Results and their commands: docs/algorithms/bootstrapped_dqn.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Optimized, descend, follow, optimized
from thorndike.functional.distributional import huber
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.networks.ensemble import Ensemble, value_ensemble
from thorndike.networks.heads import Shape
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.age import key_to_look_by, mean_age
from thorndike.replay.off_policy import repeated
from thorndike.replay.pace import pace
from thorndike.replay.uniform import ReplayBuffer, Transitions, add, init_replay, row_shapes, sample
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of bootstrapped DQN, named as in Stable-Baselines3's DQN."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 100_000  # transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 128  # environment steps before the first update
    batch_size: Annotated[int, AtLeast(1)] = 128  # M: transitions of a minibatch, which all members share
    train_freq: Annotated[int, AtLeast(1)] = 4  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    target_update_interval: Annotated[int, AtLeast(1)] = 100  # environment steps between updates of the target networks
    tau: Annotated[float, Between(0, 1)] = 1.0  # how far the targets move to the networks then
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    n_members: Annotated[int, AtLeast(1)] = 10  # K: Q-networks of the ensemble
    prior_scale: Annotated[float, AtLeast(0)] = 3.0  # beta: how much of its prior is added to each; 0: no priors
    mask_probability: Annotated[float, MoreThan(0), Between(0, 1)] = 0.5  # p: the chance that a member learns from a transition
    double: bool = True  # choose the next action by the network, value it by the target
    n_step: Annotated[int, AtLeast(1)] = 1  # rewards summed before bootstrapping
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    adam_eps: Annotated[float, MoreThan(0)] = 1e-8  # Adam's epsilon
    net_arch: tuple[int, ...] = (50, 50)  # widths of the hidden layers of each member
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    held: Optimized
    """The members ``[K, P]`` and their optimiser's state."""
    targets: Float[Array, "K P"]
    priors: Float[Array, "K P"]
    replay: ReplayBuffer
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    params: Float[Array, "K P"]
    priors: Float[Array, "K P"]


class Draws(NamedTuple):
    """The random numbers of one step."""

    member: Int[Array, "*T B"]
    """Who is followed, if an episode begins."""
    mask: Bool[Array, "*T B K"]
    """Who learns from it."""


NOBODY = -1
"""The memory an episode begins with: a member is yet to be drawn."""


def bootstrap_loss(
    params: Float[Array, "K P"],
    targets: Float[Array, "K P"],
    priors: Float[Array, "K P"],
    batch: Transitions,
    ensemble: Ensemble,
    double: bool,
) -> tuple[Float[Array, ""], Metrics]:
    """The sum over members of the mean Huber error of the transitions that are theirs. Osband et al. 2018, algorithm 1, online."""
    q, target_next = ensemble.values(params, priors, batch.obs), ensemble.values(targets, priors, batch.next_obs)
    judge = ensemble.values(params, priors, batch.next_obs) if double else target_next
    actions = q.shape[-1]
    following = jnp.sum(jax.nn.one_hot(jnp.argmax(judge, axis=-1), actions) * target_next, axis=-1)
    chosen = jnp.sum(jax.nn.one_hot(batch.action, actions)[None] * q, axis=-1)
    error = chosen - jax.lax.stop_gradient(batch.reward[None] + batch.discount[None] * following)
    own = batch.weight[None] * batch.mask.T.astype(jnp.float32)
    losses = jax.vmap(weighted_mean)(huber(error, 1.0), own)
    spread = jnp.mean(jnp.std(chosen, axis=0))
    return jnp.sum(losses), {"train/loss": jnp.mean(losses), "train/q_mean": jnp.mean(chosen), "train/q_spread": spread}


def bootstrapped_dqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """Bootstrapped DQN for an environment with Discrete actions. Raises ``UserError`` for other action spaces."""
    if not isinstance(spec.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"bootstrapped_dqn takes Discrete actions; {spec.id} has {spec.action_space}; ppo and a2c take the others")
    sizes = config.buffer_size, config.learning_starts, config.train_freq, config.gradient_steps
    plan = pace("bootstrapped_dqn", *sizes, spec.num_envs, config.n_step)
    per_iteration = plan.rollout_length * spec.num_envs
    shape, members = Shape(config.net_arch, config.activation), config.n_members
    ensemble = value_ensemble(spec, int(spec.action_space.n), shape, members, config.prior_scale, network)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=config.adam_eps))
    learning_rate, gradient = schedule(config.learning_rate), jax.grad(bootstrap_loss, has_aux=True)

    def init(key: Key[Array, ""]) -> State:
        key_params, key_priors = jax.random.split(key)
        params = ensemble.init(key_params)
        row = row_shapes(spec, mask=jax.ShapeDtypeStruct((members,), jnp.bool_))
        replay = init_replay(row, plan.ring_steps, spec.num_envs)
        return State(optimized(params, optimizer), jnp.array(params), ensemble.init(key_priors), replay, jnp.zeros((), jnp.int32))

    def draw(key: Key[Array, ""], steps: int) -> Draws:
        (key_member, key_mask), shape = jax.random.split(key), (steps, spec.num_envs)
        mask = jax.random.bernoulli(key_mask, config.mask_probability, (*shape, members))
        return Draws(jax.random.randint(key_member, shape, 0, members, jnp.int32), mask)

    def act(actor: Actor, memory: Int[Array, " B"], obs: Observation, noise: Draws) -> tuple[Int[Array, " B"], Int[Array, " B"], PyTree]:
        member = jnp.where(memory == NOBODY, noise.member, memory)
        q = jnp.sum(jax.nn.one_hot(member, members).T[..., None] * ensemble.values(*actor, obs), axis=0)
        return member, jnp.argmax(q, axis=-1).astype(jnp.int32), {"mask": noise.mask}

    def mean(actor: Actor, obs: Observation) -> Float[Array, "B A"]:
        return jnp.mean(ensemble.values(*actor, obs), axis=0)

    def observe(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        return state._replace(replay=add(state.replay, rollout), env_steps=state.env_steps + per_iteration), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate, (state, _) = learning_rate(state.env_steps / config.total_steps), observe(state, rollout, key)
        keys = jax.random.split(key, plan.gradient_steps + 1)

        def one(held: Optimized, i: Int[Array, ""]) -> tuple[Optimized, Metrics]:
            batch = sample(state.replay, keys[i], config.batch_size, spec.num_envs, config.n_step, config.gamma)
            grads, metrics = gradient(held.params, state.targets, state.priors, batch, ensemble, config.double)
            after, metrics["train/grad_norm"] = descend(optimizer, rate, held, grads)
            return accept_if(all_finite(metrics["train/loss"], metrics["train/grad_norm"]), after, held), metrics

        held, metrics = repeated(one, state.held, plan.gradient_steps, state.env_steps >= 0)
        due = (state.env_steps // per_iteration) % max(1, config.target_update_interval // per_iteration) == 0
        targets = jnp.where(due, follow(state.targets, held.params, config.tau), state.targets)
        return state._replace(held=held, targets=targets), metrics | {"train/learning_rate": rate}

    def dynamics(state: State, rollout: PyTree) -> Metrics:
        del rollout
        key = key_to_look_by(state.env_steps)
        batch = sample(state.replay, key, config.batch_size, spec.num_envs, config.n_step, config.gamma)
        return ensemble.look(state.held, batch.obs) | {"train/replay_age": mean_age(state.replay, spec.num_envs)}

    return Algorithm(
        init=init,
        actor=lambda state: Actor(state.held.params, state.priors),
        memory=lambda batch: jnp.full((batch,), NOBODY, jnp.int32),
        draw=draw,
        act=act,
        greedy=lambda actor, memory, obs, noise: (memory, jnp.argmax(mean(actor, obs), axis=-1).astype(jnp.int32), {}),
        value=lambda actor, obs: jnp.max(mean(actor, obs), axis=-1),
        update=update,
        observe=observe,
        needs=Needs(rollout_length=plan.rollout_length, on_policy=False, warmup_iterations=plan.warmup_iterations),
        dynamics=dynamics,
    )
