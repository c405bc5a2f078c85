"""Asynchronous advantage actor-critic (A3C): gradients of old parameters, applied to new ones with shared RMSProp.

Mnih et al. 2016, "Asynchronous Methods for Deep Reinforcement Learning" (arXiv:1602.01783), algorithm S3. Deviations from the paper:

1. The delay is fixed and the same for all: each rollout is played, and its gradient taken, with the parameters of ``policy_lag`` updates
   ago (theta'), then applied to the newest (theta). Updates follow one another and never overwrite each other, so a run can be repeated.
2. Real threads (``--actor-threads``) play the rollouts; one learner computes all gradients, still with the parameters that played.
3. A rollout comes from several environments, of which the paper's threads have one each; its gradient is their mean, clipped by its norm.
4. Policy and value have separate networks (one shared torso on images, and with memory), weights orthogonal, as in OpenAI's A2C.
5. Advantages are generalised (Schulman et al. 2016, arXiv:1506.02438); ``gae_lambda = 1``, the default, is the paper's n-step return.
6. A step cut by a time limit bootstraps from the observation it was cut at, not from the next episode's first one.
7. Box actions are chosen in [-1, 1] and mapped to the bounds; what lies outside is clipped by the environment's source.

Logs ``train/loss``, ``policy_loss``, ``value_loss``, ``entropy_loss``, ``explained_variance``, ``grad_norm``, ``learning_rate``,
``policy_lag`` (updates between the policy that played and the newest). Results and their commands: docs/algorithms/a3c.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.action_distributions import ActionDistribution, action_distribution, saturation
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.parameter_history import ParameterHistory, new_history, newest, of_version, updated
from thorndike.functional.policy_losses import actor_critic_loss, explained_variance, standardize
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.networks.heads import Shape, policy_network
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, flattened, fresh_memory
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of A3C, named as those of A2C; entropy bonus and RMSProp's epsilon are the paper's."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    policy_lag: Annotated[int, Between(0, 1000)] = 3  # updates between the parameters that act (theta') and the newest (theta)
    thread_lag: Annotated[int, Between(0, 1000)] = 0  # with actor threads: further updates these may be behind, their number
    learning_rate: Annotated[float | str, AtLeast(0)] = 7e-4  # RMSProp's step size (eta), or a schedule such as linear(7e-4, 0)
    n_steps: Annotated[int, AtLeast(1)] = 5  # t_max: steps of each environment in a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    gae_lambda: Annotated[float, Between(0, 1)] = 1.0  # lambda of the advantage estimate
    ent_coef: Annotated[float, AtLeast(0)] = 0.01  # beta: weight of the entropy bonus
    vf_coef: Annotated[float, AtLeast(0)] = 0.5  # weight of the value loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 0.5  # global norm the gradient is clipped to
    rms_prop_decay: Annotated[float, Between(0, 1)] = 0.99  # alpha: how long RMSProp, shared by all, remembers
    rms_prop_eps: Annotated[float, MoreThan(0)] = 1e-5  # RMSProp's epsilon
    normalize_advantage: bool = False  # standardise the rollout's advantages
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "tanh"  # after each hidden layer
    log_std_init: float = 0.0  # log standard deviation at the start (Box actions)
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    history: ParameterHistory
    """The newest parameters and those still acted with, as flat vectors."""
    opt_state: PyTree
    """RMSProp's moments, shared by all actors."""
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acts."""

    params: Float[Array, " P"]
    version: Int[Array, ""]
    """The number of updates that made them: each rollout tells it."""


def a3c_loss(
    params: Float[Array, " P"], rollout: Rollout, network: Network, distribution: ActionDistribution, config: Config
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of a rollout at the parameters that played it, and what is logged of it: algorithm S3, with its signs turned."""
    step, weight = rollout.step, rollout.step.valid.astype(jnp.float32)
    (parameters, value), (_, next_value) = apply_rollout(network, params, rollout)
    fixed_value, fixed_next_value = jax.lax.stop_gradient((value, next_value))
    advantage = generalized_advantage(
        step.reward, fixed_value, fixed_next_value, step.terminated, step.done | ~step.valid, config.gamma, config.gae_lambda
    )
    target = advantage + fixed_value
    loss, metrics = actor_critic_loss(
        distribution.log_prob(parameters, rollout.action),
        distribution.entropy(parameters),
        value,
        standardize(advantage, weight) if config.normalize_advantage else advantage,
        target,
        weight,
        config.vf_coef,
        config.ent_coef,
    )
    metrics["train/explained_variance"] = explained_variance(fixed_value, target, step.valid)
    return loss, metrics


def a3c(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """A3C for an environment. Raises ``UserError`` where the action space is not supported."""
    distribution = action_distribution(spec.action_space)
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size)
    net = policy_network(spec, distribution, shape, config.log_std_init, network)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.scale_by_rms(decay=config.rms_prop_decay, eps=config.rms_prop_eps, eps_in_sqrt=False),
    )
    learning_rate, example = schedule(config.learning_rate), example_observation(spec.observation_space)
    flat_net = flattened(net, example)

    def init(key: Key[Array, ""]) -> State:
        flat = ravel_pytree(net.init(key, example))[0]
        kept = config.policy_lag + config.thread_lag + 1
        return State(new_history(flat, kept), optimizer.init(flat), jnp.zeros((), jnp.int32))

    def actor(state: State) -> Actor:
        version = jnp.maximum(state.history.version - config.policy_lag, 0)
        return Actor(of_version(state.history, version), version)

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, value) = apply_step(flat_net, actor.params, memory, obs)
        return memory, distribution.sample(parameters, noise), {"version": jnp.broadcast_to(actor.version, value.shape)}

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(flat_net, actor.params, memory, obs)
        return memory, distribution.mode(parameters), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        del key
        rate = learning_rate(state.env_steps / config.total_steps)
        played = rollout.extras["version"][0, 0]
        flat = newest(state.history)
        grads, metrics = jax.grad(lambda v: a3c_loss(v, rollout, flat_net, distribution, config), has_aux=True)(
            of_version(state.history, played)
        )
        direction, opt_state = optimizer.update(grads, state.opt_state)
        metrics |= {"train/grad_norm": jnp.linalg.norm(grads), "train/learning_rate": rate} | saturation(spec.action_space, rollout.action)
        metrics["train/policy_lag"] = (state.history.version - played).astype(jnp.float32)
        accepted = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
        flat, opt_state = accept_if(accepted, (flat - rate * direction, opt_state), (flat, state.opt_state))
        return State(updated(state.history, flat), opt_state, state.env_steps + config.n_steps * spec.num_envs), metrics

    return Algorithm(
        init=init,
        actor=actor,
        memory=lambda batch: fresh_memory(net, batch),
        draw=lambda key, steps: distribution.draw(key, (steps, spec.num_envs)),
        act=act,
        greedy=greedy,
        value=lambda actor, obs: flat_net.apply(actor.params, obs)[1],
        update=update,
        observe=lambda state, rollout, key: (state, {}),
        needs=Needs(rollout_length=config.n_steps, on_policy=True),
        dynamics=lambda state, rollout: look_into_rollout(flat_net, newest(state.history), rollout.obs, state.opt_state),
    )
