"""Proximal policy optimisation (PPO), with the clipped surrogate.

Schulman et al. 2017, "Proximal Policy Optimization Algorithms" (arXiv:1707.06347); advantages: arXiv:1506.02438. Deviations from it:

1. Advantages are standardised in each minibatch, gradients clipped by their global norm, weights orthogonal, as in OpenAI's PPO2.
2. Policy and value have separate networks (one shared torso on images, and with memory, whose minibatches are whole sequences).
3. A step cut by a time limit bootstraps from the observation it was cut at, not from the next episode's first one.
4. Box actions are chosen in [-1, 1] and mapped to the bounds; what lies outside is clipped by the environment's source, unless
   ``action_distribution`` is ``squashed`` or ``beta``. With ``use_sde`` noise is held (Raffin et al. 2020, arXiv:2005.05719).
5. With ``target_kl`` the remaining minibatches of an iteration are skipped once the KL estimate passes 1.5 times the target.
6. A game of two is played against itself: rewards and values are the mover's, and change their sign where the turn passes.

Logs ``train/loss``, ``policy_gradient_loss``, ``value_loss``, ``entropy_loss``, ``approx_kl``, ``clip_fraction``, ``explained_variance``,
``grad_norm``, ``learning_rate``, ``clip_range``, with ``target_kl`` ``early_stop``. Results: docs/algorithms/ppo.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.functional.action_distributions import BOX_KINDS, ActionDistribution, saturation
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.held_noise import with_held_noise
from thorndike.functional.policy_losses import (
    approximate_kl,
    clip_fraction,
    clipped_surrogate,
    explained_variance,
    standardize,
    value_loss,
    weighted_mean,
)
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.functional.shuffling import minibatch_size, minibatches
from thorndike.games.game import Game
from thorndike.games.turns import game_of_two, turns
from thorndike.networks.cnn import CNNS
from thorndike.networks.heads import Shape, softmax_probabilities, stochastic_policy
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_step, as_rows, begins_episode, fresh_memory, rollout_values
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of PPO. Defaults are Stable-Baselines3's, but for ``n_steps``, which is for eight environments."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(3e-4, 0)
    n_steps: Annotated[int, AtLeast(1)] = 256  # T: steps of each environment in a rollout
    batch_size: Annotated[int, AtLeast(1)] = 64  # M: rows of a minibatch
    n_epochs: Annotated[int, AtLeast(1)] = 10  # K: passes over a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    gae_lambda: Annotated[float, Between(0, 1)] = 0.95  # lambda of the advantage estimate
    clip_range: Annotated[float | str, AtLeast(0)] = 0.2  # epsilon of the surrogate, or a schedule
    clip_range_vf: Annotated[float | None, MoreThan(0)] = None  # the same for the value, off by default
    ent_coef: Annotated[float, AtLeast(0)] = 0.0  # c2: weight of the entropy bonus
    vf_coef: Annotated[float, AtLeast(0)] = 0.5  # c1: weight of the value loss
    max_grad_norm: Annotated[float, MoreThan(0)] = 0.5  # global norm the gradient is clipped to
    target_kl: Annotated[float | None, MoreThan(0)] = None  # stop an iteration's updates beyond 1.5 times this KL
    normalize_advantage: bool = True  # standardise advantages in each minibatch
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
    """Adam's moments, over the parameters as one flat vector."""
    env_steps: Int[Array, ""]


class Minibatch(NamedTuple):
    """What the loss needs: rows of a rollout ``[M, ...]``, or with memory whole sequences ``[T, M, ...]``."""

    obs: Observation
    action: PyTree
    log_prob: Float[Array, "*M"]
    value: Float[Array, "*M"]
    advantage: Float[Array, "*M"]
    target: Float[Array, "*M"]
    weight: Float[Array, "*M"]
    begins: Bool[Array, "*M"]
    """Whether a step is the first of its episode; without memory it is not looked at."""
    memory: PyTree
    """The memory before the first step ``[1, M, ...]``, or ``()``."""


_OF_A_MINIBATCH = ("loss", "policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction", "grad_norm")
MINIBATCH_METRICS = tuple(f"train/{name}" for name in _OF_A_MINIBATCH)


def ppo_loss(
    params: PyTree, batch: Minibatch, network: Network, distribution: ActionDistribution, config: Config, clip_range: Float[Array, ""]
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of one minibatch and what is logged of it: paper, eq. 9, with its signs turned."""
    if network.recurrence is None:
        parameters, value = network.apply(params, batch.obs)
    else:
        _, (parameters, value) = network.recurrence.unroll(params, jax.tree.map(lambda x: x[0], batch.memory), batch.obs, batch.begins)
    log_ratio = distribution.log_prob(parameters, batch.action) - batch.log_prob
    advantage = standardize(batch.advantage, batch.weight) if config.normalize_advantage else batch.advantage
    policy = clipped_surrogate(log_ratio, advantage, clip_range, batch.weight)
    critic = value_loss(value, batch.value, batch.target, config.clip_range_vf, batch.weight)
    entropy = weighted_mean(distribution.entropy(parameters), batch.weight)
    loss = policy + config.vf_coef * critic - config.ent_coef * entropy
    metrics = {
        "train/loss": loss,
        "train/policy_gradient_loss": policy,
        "train/value_loss": critic,
        "train/entropy_loss": -entropy,
        "train/approx_kl": approximate_kl(log_ratio, batch.weight),
        "train/clip_fraction": clip_fraction(log_ratio, clip_range, batch.weight),
    }
    return loss, metrics


def prepare(rollout: Rollout, params: PyTree, network: Network, config: Config, game: Game | None = None) -> Minibatch:
    """Values, advantages and value targets of a whole rollout: as rows ``[T * B, ...]``, or with memory as it is, ``[T, B, ...]``."""
    step = rollout.step
    value, next_value = rollout_values(network, params, rollout)
    rows = step.reward, value, next_value, step.terminated, step.done | ~step.valid
    advantage = generalized_advantage(*rows, config.gamma, config.gae_lambda, turns(game, rollout))
    batch = Minibatch(
        obs=rollout.obs,
        action=rollout.action,
        log_prob=rollout.extras["log_prob"],
        value=value,
        advantage=advantage,
        target=advantage + value,
        weight=step.valid.astype(jnp.float32),
        begins=begins_episode(rollout),
        memory=jax.tree.map(lambda x: x[None], rollout.memory),
    )
    return as_rows(batch) if network.recurrence is None else batch


def improve(
    flat: Float[Array, " P"],
    opt_state: PyTree,
    batch: Minibatch,
    order: Int[Array, "minibatches M"],
    gradient: Callable[[Float[Array, " P"], Minibatch], tuple[tuple[Array, Metrics], Float[Array, " P"]]],
    optimizer: optax.GradientTransformation,
    rate: Float[Array, ""],
    target_kl: float | None,
    sequences: bool,
) -> tuple[Float[Array, " P"], PyTree, Bool[Array, ""], Metrics]:
    """One optimiser step a minibatch: parameters, optimiser, whether the KL stayed in bounds, mean metrics of the minibatches."""

    def step(carry: tuple[Array, PyTree, Array], indices: Int[Array, " M"]) -> tuple[tuple[Array, PyTree, Array], Float[Array, " metrics"]]:
        flat, opt_state, going = carry
        (_, metrics), grads = gradient(flat, jax.tree.map(lambda x: x[:, indices] if sequences else x[indices], batch))
        direction, new_opt_state = optimizer.update(grads, opt_state)
        metrics["train/grad_norm"] = jnp.linalg.norm(grads)
        # One row, because every array a scan emits is a kernel to compile and to run.
        row = jnp.stack([metrics[name] for name in MINIBATCH_METRICS])
        going = going & all_finite(metrics["train/loss"], metrics["train/grad_norm"])
        going = going if target_kl is None else going & (metrics["train/approx_kl"] <= 1.5 * target_kl)
        flat, opt_state = accept_if(going, (flat - rate * direction, new_opt_state), (flat, opt_state))
        return (flat, opt_state, going), row

    (flat, opt_state, going), rows = jax.lax.scan(step, (flat, opt_state, jnp.array(True)), order)
    return flat, opt_state, going, dict(zip(MINIBATCH_METRICS, jnp.mean(rows, axis=0), strict=True))


def ppo(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """PPO for an environment. Raises ``UserError`` where a rollout does not divide into minibatches or the space is not supported."""
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size, cnn=config.cnn)
    distribution, net = stochastic_policy(spec, shape, config.action_distribution, config.use_sde, config.log_std_init, network)
    rows, sequences = config.n_steps * spec.num_envs, net.recurrence is not None
    per_minibatch = minibatch_size("ppo", config.n_steps, spec.num_envs, config.batch_size, sequences)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    learning_rate, clip_range = schedule(config.learning_rate), schedule(config.clip_range)
    example, game = example_observation(spec.observation_space), game_of_two(spec)

    def init(key: Key[Array, ""]) -> State:
        params = net.init(key, example)
        return State(params, optimizer.init(ravel_pytree(params)[0]), jnp.zeros((), jnp.int32))

    def act(params: PyTree, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(net, params, memory, obs)
        action = distribution.sample(parameters, noise)
        return memory, action, {"log_prob": distribution.log_prob(parameters, action)}

    def greedy(params: PyTree, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        memory, (parameters, _) = apply_step(net, params, memory, obs)
        return memory, distribution.mode(parameters), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        progress = state.env_steps / config.total_steps
        rate, clip = learning_rate(progress), clip_range(progress)
        batch = prepare(rollout, state.params, net, config, game)
        # The parameters as one vector: the optimiser is then a handful of kernels instead of a handful a layer (measured: 1.2x).
        flat, unravel = ravel_pytree(state.params)
        gradient = jax.value_and_grad(lambda v, rows: ppo_loss(unravel(v), rows, net, distribution, config, clip), has_aux=True)

        order = minibatches(key, spec.num_envs if sequences else rows, config.n_epochs, per_minibatch)
        flat, opt_state, going, metrics = improve(
            flat, state.opt_state, batch, order, gradient, optimizer, rate, config.target_kl, sequences
        )
        metrics |= saturation(spec.action_space, rollout.action)
        metrics["train/explained_variance"] = explained_variance(batch.value, batch.target, batch.weight > 0)
        metrics["train/learning_rate"], metrics["train/clip_range"] = rate, clip
        if config.target_kl is not None:
            metrics["train/early_stop"] = 1.0 - going.astype(jnp.float32)
        return State(unravel(flat), opt_state, state.env_steps + rows), metrics

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
