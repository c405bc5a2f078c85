"""Advantage actor-critic (A2C), the synchronous form of A3C: one gradient step a rollout, on all of it.

Mnih et al. 2016, "Asynchronous Methods for Deep Reinforcement Learning" (arXiv:1602.01783). Deviations from the paper:

1. Synchronous: environments step side by side and one learner takes one step, in place of threads that overwrite each other.
2. Policy and value have separate networks (one shared torso on images, and with memory), weights orthogonal, as in OpenAI's A2C.
3. Advantages are generalised (Schulman et al. 2016, arXiv:1506.02438); ``gae_lambda = 1``, the default, is the paper's n-step return.
4. A step cut by a time limit bootstraps from the observation it was cut at, not from the next episode's first one.
5. Box actions are chosen in [-1, 1] and mapped to the bounds; what lies outside is clipped by the environment's source, unless
   ``action_distribution`` is ``squashed`` or ``beta``. With ``use_sde`` noise is held (Raffin et al. 2020, arXiv:2005.05719).

Logs ``train/loss``, ``policy_loss``, ``value_loss``, ``entropy_loss``, ``explained_variance``, ``grad_norm``, ``learning_rate``. Results
and their commands: docs/algorithms/a2c.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.action_distributions import BOX_KINDS, ActionDistribution, saturation
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.held_noise import with_held_noise
from thorndike.functional.policy_losses import actor_critic_loss, explained_variance, standardize
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.networks.cnn import CNNS
from thorndike.networks.heads import Shape, softmax_probabilities, stochastic_policy
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, fresh_memory
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of A2C, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 7e-4  # RMSProp's step size, or a schedule such as linear(7e-4, 0)
    n_steps: Annotated[int, AtLeast(1)] = 5  # t_max: steps of each environment in a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    gae_lambda: Annotated[float, Between(0, 1)] = 1.0  # lambda of the advantage estimate
    ent_coef: Annotated[float, AtLeast(0)] = 0.0  # beta: weight of the entropy bonus
    vf_coef: Annotated[float, AtLeast(0)] = 0.5  # weight of the value loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 0.5  # global norm the gradient is clipped to
    rms_prop_eps: Annotated[float, MoreThan(0)] = 1e-5  # RMSProp's epsilon
    normalize_advantage: bool = False  # standardise the rollout's advantages
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "tanh"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images
    action_distribution: Annotated[str, OneOf(*BOX_KINDS)] = "gaussian"  # of Box actions; gaussian: clipped to the bounds
    log_std_init: float = 0.0  # log standard deviation at the start (Box actions; beta has none)
    use_sde: bool = False  # gSDE: explore by noise that depends on the state, and is held
    sde_sample_freq: Annotated[int, AtLeast(-1)] = -1  # steps it is held for; -1: n_steps
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    params: PyTree
    opt_state: PyTree
    """RMSProp's moments, over the parameters as one flat vector."""
    env_steps: Int[Array, ""]


def a2c_loss(
    params: PyTree, rollout: Rollout, network: Network, distribution: ActionDistribution, config: Config
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of a rollout and what is logged of it: paper, section 4 (advantage actor-critic), with its signs turned."""
    step, weight = rollout.step, rollout.step.valid.astype(jnp.float32)
    (parameters, value), (_, next_value) = apply_rollout(network, params, rollout)
    fixed_value, fixed_next_value = jax.lax.stop_gradient((value, next_value))
    advantage = generalized_advantage(
        step.reward, fixed_value, fixed_next_value, step.terminated, step.done | ~step.valid, config.gamma, config.gae_lambda
    )
    target = advantage + fixed_value
    scaled = standardize(advantage, weight) if config.normalize_advantage else advantage
    loss, metrics = actor_critic_loss(
        distribution.log_prob(parameters, rollout.action),
        distribution.entropy(parameters),
        value,
        scaled,
        target,
        weight,
        config.vf_coef,
        config.ent_coef,
    )
    metrics["train/explained_variance"] = explained_variance(fixed_value, target, step.valid)
    return loss, metrics


def a2c(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """A2C for an environment. Raises ``UserError`` where the action space is not supported."""
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size, cnn=config.cnn)
    distribution, net = stochastic_policy(spec, shape, config.action_distribution, config.use_sde, config.log_std_init, network)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_rms(decay=0.99, eps=config.rms_prop_eps, eps_in_sqrt=False)
    )
    learning_rate, example = schedule(config.learning_rate), example_observation(spec.observation_space)

    def init(key: Key[Array, ""]) -> State:
        params = net.init(key, example)
        return State(params, optimizer.init(ravel_pytree(params)[0]), jnp.zeros((), jnp.int32))

    def act(params: PyTree, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(net, params, memory, obs)
        return memory, distribution.sample(parameters, noise), {}

    def greedy(params: PyTree, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(net, params, memory, obs)
        return memory, distribution.mode(parameters), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        del key
        rate = learning_rate(state.env_steps / config.total_steps)
        # The parameters as one vector: the optimiser is then a handful of kernels instead of a handful a layer.
        flat, unravel = ravel_pytree(state.params)
        grads, metrics = jax.grad(lambda v: a2c_loss(unravel(v), rollout, net, distribution, config), has_aux=True)(flat)
        direction, opt_state = optimizer.update(grads, state.opt_state)
        metrics |= {"train/grad_norm": jnp.linalg.norm(grads), "train/learning_rate": rate} | saturation(spec.action_space, rollout.action)
        accepted = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
        flat, opt_state = accept_if(accepted, (flat - rate * direction, opt_state), (flat, state.opt_state))
        return State(unravel(flat), opt_state, state.env_steps + config.n_steps * spec.num_envs), metrics

    algorithm = Algorithm(
        init=init,
        actor=lambda state: state.params,
        memory=lambda batch: fresh_memory(net, batch),
        draw=lambda key, steps: distribution.draw(key, (steps, spec.num_envs)),
        act=act,
        greedy=greedy,
        value=lambda params, obs: net.apply(params, obs)[1],
        update=update,
        observe=lambda state, rollout, key: (state, {}),
        needs=Needs(rollout_length=config.n_steps, on_policy=True),
        probabilities=softmax_probabilities(net, spec.action_space),
        dynamics=lambda state, rollout: look_into_rollout(net, state.params, rollout.obs, state.opt_state),
    )
    return with_held_noise(algorithm, config.sde_sample_freq) if config.use_sde else algorithm
