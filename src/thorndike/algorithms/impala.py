"""Importance weighted actor-learner architecture (IMPALA): actors some updates behind, a learner that corrects for it by V-trace.

Espeholt et al. 2018, "IMPALA: Scalable Distributed Deep-RL with Importance Weighted Actor-Learner Architectures" (arXiv:1802.01561).
Deviations from the paper:

1. In a compiled loop the delay is fixed: each rollout is played with the parameters of ``policy_lag`` updates ago. Real threads
   (``--actor-threads``) add a delay of their own, by default a fixed one, so that a run can be repeated.
2. One rollout, of several environments, makes one batch; losses are means over it, where the paper sums over time and batch.
3. Policy and value have separate networks (one shared torso on images, and with memory), weights orthogonal.
4. A step cut by a time limit bootstraps from the observation it was cut at, and no correction crosses it.
5. Box actions are chosen in [-1, 1] and mapped to the bounds; what lies outside is clipped by the environment's source.
6. Population based training and the deep residual network are not part of this file.

Logs ``train/loss``, ``policy_loss``, ``value_loss``, ``entropy_loss``, ``explained_variance``, ``approx_kl`` (of the learner's policy from
the one that played), ``clip_fraction`` (rows whose weight passes ``clip_rho``), ``grad_norm``, ``learning_rate``, ``policy_lag`` (updates
between the policy that played and the newest). Results and their commands: docs/algorithms/impala.md.
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
from thorndike.functional.policy_losses import actor_critic_loss, approximate_kl, explained_variance, weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.functional.vtrace import vtrace
from thorndike.networks.heads import Shape, policy_network
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, flattened, fresh_memory
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of IMPALA; what A2C has too is named as there."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    policy_lag: Annotated[int, Between(0, 1000)] = 3  # updates between the policy that acts (mu) and the one that learns (pi)
    learning_rate: Annotated[float | str, AtLeast(0)] = 7e-4  # RMSProp's step size, or a schedule such as linear(7e-4, 0)
    n_steps: Annotated[int, AtLeast(1)] = 20  # n: steps of each environment in a rollout (the unroll length)
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    trace_decay: Annotated[float, Between(0, 1)] = 1.0  # lambda of V-trace (remark 2)
    clip_rho: Annotated[float, MoreThan(0)] = 1.0  # rho bar: bound of the weight of a step's error; sets the fixed point
    clip_c: Annotated[float, MoreThan(0)] = 1.0  # c bar: bound of the weight that carries errors back; sets the speed
    clip_pg_rho: Annotated[float, MoreThan(0)] = 1.0  # the bound in the policy's gradient
    ent_coef: Annotated[float, AtLeast(0)] = 0.01  # weight of the entropy bonus
    vf_coef: Annotated[float, AtLeast(0)] = 0.5  # weight of the value loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 0.5  # global norm the gradient is clipped to
    rms_prop_decay: Annotated[float, Between(0, 1)] = 0.99  # how long RMSProp remembers
    rms_prop_eps: Annotated[float, MoreThan(0)] = 1e-5  # RMSProp's epsilon
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
    """RMSProp's moments."""
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acts."""

    params: Float[Array, " P"]
    version: Int[Array, ""]
    """The number of updates that made them: each rollout tells it."""


def impala_loss(
    params: Float[Array, " P"], rollout: Rollout, network: Network, distribution: ActionDistribution, config: Config
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of a rollout and what is logged of it: paper, section 4.2, with its signs turned."""
    step, weight = rollout.step, rollout.step.valid.astype(jnp.float32)
    (parameters, value), (_, next_value) = apply_rollout(network, params, rollout)
    log_prob = distribution.log_prob(parameters, rollout.action)
    log_ratio, fixed_value, fixed_next_value = jax.lax.stop_gradient((log_prob - rollout.extras["log_prob"], value, next_value))
    found = vtrace(
        log_ratio, step.reward, fixed_value, fixed_next_value, step.terminated, step.truncated, step.valid,
        config.gamma, config.trace_decay, config.clip_rho, config.clip_c, config.clip_pg_rho,
    )  # fmt: skip
    loss, metrics = actor_critic_loss(
        log_prob, distribution.entropy(parameters), value, found.advantage, found.target, weight, config.vf_coef, config.ent_coef
    )
    metrics["train/explained_variance"] = explained_variance(fixed_value, found.target, step.valid)
    metrics["train/approx_kl"] = approximate_kl(log_ratio, weight)
    metrics["train/clip_fraction"] = weighted_mean((jnp.exp(log_ratio) > config.clip_rho).astype(jnp.float32), weight)
    return loss, metrics


def impala(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """IMPALA for an environment. Raises ``UserError`` where the action space is not supported."""
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
        return State(new_history(flat, config.policy_lag + 1), optimizer.init(flat), jnp.zeros((), jnp.int32))

    def actor(state: State) -> Actor:
        version = jnp.maximum(state.history.version - config.policy_lag, 0)
        return Actor(of_version(state.history, version), version)

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, value) = apply_step(flat_net, actor.params, memory, obs)
        action = distribution.sample(parameters, noise)
        version = jnp.broadcast_to(actor.version, value.shape)
        return memory, action, {"log_prob": distribution.log_prob(parameters, action), "version": version}

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(flat_net, actor.params, memory, obs)
        return memory, distribution.mode(parameters), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        del key
        rate = learning_rate(state.env_steps / config.total_steps)
        flat = newest(state.history)
        grads, metrics = jax.grad(lambda v: impala_loss(v, rollout, flat_net, distribution, config), has_aux=True)(flat)
        direction, opt_state = optimizer.update(grads, state.opt_state)
        metrics |= {"train/grad_norm": jnp.linalg.norm(grads), "train/learning_rate": rate} | saturation(spec.action_space, rollout.action)
        metrics["train/policy_lag"] = (state.history.version - rollout.extras["version"][0, 0]).astype(jnp.float32)
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
