"""REINFORCE: the policy gradient by whole returns, with or without a learnt baseline.

Williams 1992, "Simple Statistical Gradient-Following Algorithms for Connectionist Reinforcement Learning" (Machine Learning 8); with the
value function as the baseline: Sutton and Barto 2018, section 13.4. Deviations from the paper:

1. Several environments play side by side; a gradient step is taken on all rows of a rollout, in place of one an episode.
2. The weight of a step is the discounted return from that step on, not of the whole episode; the factor gamma^t is left out, as is usual.
3. An episode that a rollout or a time limit cuts has no whole return. With the baseline, the value of the observation it was cut at stands
   for the rest. Without, the steps of an episode that the rollout leaves unfinished do not count, so ``n_steps`` must be at least the time
   limit; a time limit itself counts as an end.
4. Returns (less the baseline) are standardised in each rollout; Adam, with gradients clipped by their global norm.

Logs ``train/loss``, ``policy_loss``, ``value_loss``, ``entropy_loss``, ``explained_variance``, ``grad_norm``, ``learning_rate``, ``used``
(the share of rows that count). Results and their commands: docs/algorithms/reinforce.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.action_distributions import BOX_KINDS, ActionDistribution, saturation
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import explained_variance, standardize, weighted_mean
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.networks.cnn import CNNS
from thorndike.networks.heads import Shape, softmax_probabilities, stochastic_policy
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, fresh_memory
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout, Step


@dataclass(frozen=True)
class Config:
    """Settings of REINFORCE."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # alpha: Adam's step size, or a schedule such as linear(1e-3, 0)
    n_steps: Annotated[int, AtLeast(1)] = 500  # T: steps of each environment in a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    baseline: bool = True  # subtract a learnt value function
    ent_coef: Annotated[float, AtLeast(0)] = 0.0  # weight of an entropy bonus
    vf_coef: Annotated[float, AtLeast(0)] = 0.5  # weight of the baseline's loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 0.5  # global norm the gradient is clipped to
    normalize_advantage: bool = True  # standardise the weights of a rollout's steps
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "tanh"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images
    action_distribution: Annotated[str, OneOf(*BOX_KINDS)] = "gaussian"  # of Box actions; gaussian: clipped to the bounds
    log_std_init: float = 0.0  # log standard deviation at the start (Box actions; beta has none)
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    params: PyTree
    opt_state: PyTree
    """Adam's moments, over the parameters as one flat vector."""
    env_steps: Int[Array, ""]


def belongs_to_ended_episode(step: Step) -> Bool[Array, "T B"]:
    """Valid steps whose episode ends within the rollout: those with a whole return."""
    ends_later = jnp.flip(jnp.cumsum(jnp.flip(step.done & step.valid, axis=0), axis=0), axis=0) > 0
    return ends_later & step.valid


def reinforce_loss(
    params: PyTree, rollout: Rollout, network: Network, distribution: ActionDistribution, config: Config
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of a rollout and what is logged of it: Sutton and Barto 2018, eq. 13.11 (13.8 without baseline), its sign turned."""
    step = rollout.step
    (parameters, value), (_, next_value) = apply_rollout(network, params, rollout)
    baseline, rest = jax.lax.stop_gradient((value, next_value)) if config.baseline else (jnp.zeros_like(value), jnp.zeros_like(value))
    # With lambda = 1 the sum telescopes: the return, with ``rest`` for what a cut leaves out, less the baseline.
    advantage = generalized_advantage(step.reward, baseline, rest, step.terminated, step.done | ~step.valid, config.gamma, 1.0)
    used = (step.valid if config.baseline else belongs_to_ended_episode(step)).astype(jnp.float32)
    scaled = standardize(advantage, used) if config.normalize_advantage else advantage
    policy = -weighted_mean(distribution.log_prob(parameters, rollout.action) * scaled, used)
    target = advantage + baseline
    critic = weighted_mean(jnp.square(value - target), used) if config.baseline else jnp.zeros(())
    entropy = weighted_mean(distribution.entropy(parameters), used)
    loss = policy + config.vf_coef * critic - config.ent_coef * entropy
    metrics = {
        "train/loss": loss,
        "train/policy_loss": policy,
        "train/value_loss": critic,
        "train/entropy_loss": -entropy,
        "train/explained_variance": explained_variance(baseline, target, used > 0),
        "train/used": jnp.mean(used),
    }
    return loss, metrics


def reinforce(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """REINFORCE for an environment. Raises ``UserError`` for an action space it does not know, or rollouts too short without a baseline."""
    limit = spec.max_episode_steps
    if not config.baseline and limit is not None and config.n_steps < limit:
        raise UserError(
            f"reinforce without a baseline learns from whole episodes: n_steps {config.n_steps} must be at least the time limit {limit} of "
            f"{spec.id}; set n_steps={limit}, or baseline=true"
        )
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size, cnn=config.cnn)
    distribution, net = stochastic_policy(spec, shape, config.action_distribution, False, config.log_std_init, network)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
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
        flat, unravel = ravel_pytree(state.params)
        grads, metrics = jax.grad(lambda v: reinforce_loss(unravel(v), rollout, net, distribution, config), has_aux=True)(flat)
        direction, opt_state = optimizer.update(grads, state.opt_state)
        metrics |= {"train/grad_norm": jnp.linalg.norm(grads), "train/learning_rate": rate} | saturation(spec.action_space, rollout.action)
        accepted = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
        flat, opt_state = accept_if(accepted, (flat - rate * direction, opt_state), (flat, state.opt_state))
        return State(unravel(flat), opt_state, state.env_steps + config.n_steps * spec.num_envs), metrics

    return Algorithm(
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
