"""Trust region policy optimisation (TRPO): the largest step of the natural gradient that keeps the KL divergence in bounds.

Schulman, Levine, Moritz, Jordan, Abbeel 2015, "Trust Region Policy Optimization" (arXiv:1502.05477); advantages from Schulman et al. 2016
(arXiv:1506.02438). Deviations from the paper:

1. Advantages are generalised and standardised over a rollout; the value is learnt by minibatches of Adam, as in OpenAI's TRPO and SB3's.
2. The Hessian of the mean KL divergence is multiplied with vectors by differentiating twice, on all rows of the rollout, and damped.
3. Policy and value have separate networks. Where they share a torso (images), only the value's own parameters learn from its loss:
   the rest of the network moves by the trust region alone.
4. A step cut by a time limit bootstraps from the observation it was cut at, not from the next episode's first one.
5. Box actions are chosen in [-1, 1] and mapped to the bounds; what lies outside is clipped by the environment's source.

Logs ``train/policy_objective``, ``kl_divergence_loss``, ``is_line_search_success``, ``step_fraction``, ``value_loss``, ``entropy_loss``,
``explained_variance``, ``grad_norm``, ``learning_rate``. Results and their commands: docs/algorithms/trpo.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.action_distributions import ActionDistribution, action_distribution, saturation
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_divergence import Divergence, policy_divergence
from thorndike.functional.policy_losses import explained_variance, standardize, value_loss, weighted_mean
from thorndike.functional.returns import generalized_advantage
from thorndike.functional.schedules import schedule
from thorndike.functional.shuffling import minibatches
from thorndike.functional.trust_region import backtracking_line_search, conjugate_gradient
from thorndike.networks.heads import Shape, policy_network
from thorndike.networks.hidden_layers import look_into_rollout
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, apply_step, as_rows, begins_episode, flattened, fresh_memory
from thorndike.networks.policy_parameters import reaches_policy
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS, example_observation
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of TRPO. Names and defaults are SB3-contrib's, but for ``n_steps``, which is for eight environments."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # Adam's step size for the value, or a schedule such as linear(1e-3, 0)
    n_steps: Annotated[int, AtLeast(1)] = 256  # steps of each environment in a rollout
    batch_size: Annotated[int, AtLeast(1)] = 128  # rows of a minibatch of the value
    n_critic_updates: Annotated[int, AtLeast(1)] = 10  # passes of the value over a rollout
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    gae_lambda: Annotated[float, Between(0, 1)] = 0.95  # lambda of the advantage estimate
    target_kl: Annotated[float, MoreThan(0)] = 0.01  # delta: bound of the mean KL divergence of an update
    cg_max_steps: Annotated[int, AtLeast(1)] = 15  # steps of the conjugate gradient method
    cg_damping: Annotated[float, AtLeast(0)] = 0.1  # added to the Hessian's diagonal
    line_search_shrinking_factor: Annotated[float, Between(0, 1)] = 0.8  # from one try of the line search to the next
    line_search_max_iter: Annotated[int, AtLeast(1)] = 10  # tries of the line search
    normalize_advantage: bool = True  # standardise the rollout's advantages
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "tanh"  # after each hidden layer
    log_std_init: float = 0.0  # log standard deviation at the start (Box actions)
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    params: PyTree
    opt_state: PyTree
    """Adam's moments of the value, over all parameters as one flat vector; those of the policy stay 0."""
    env_steps: Int[Array, ""]


class Batch(NamedTuple):
    """Rows of a rollout ``[N, ...]``, or with memory whole sequences ``[T, B, ...]``."""

    obs: Observation
    action: PyTree
    log_prob: Float[Array, "*N"]
    parameters: Float[Array, "*N P"]
    """Of the policy before the update."""
    value: Float[Array, "*N"]
    advantage: Float[Array, "*N"]
    target: Float[Array, "*N"]
    weight: Float[Array, "*N"]
    begins: Bool[Array, "*N"]
    """Whether a step is the first of its episode; without memory it is not looked at."""
    memory: PyTree
    """The memory before the first step ``[1, B, ...]``, or ``()``."""


def prepare(rollout: Rollout, params: Float[Array, " P"], network: Network, config: Config) -> Batch:
    """Values, advantages and value targets of a whole rollout: as rows ``[T * B, ...]``, or with memory as it is, ``[T, B, ...]``."""
    step, weight = rollout.step, rollout.step.valid.astype(jnp.float32)
    (parameters, value), (_, next_value) = apply_rollout(network, params, rollout)
    advantage = generalized_advantage(
        step.reward, value, next_value, step.terminated, step.done | ~step.valid, config.gamma, config.gae_lambda
    )
    scaled = standardize(advantage, weight) if config.normalize_advantage else advantage
    memory = jax.tree.map(lambda x: x[None], rollout.memory)
    batch = Batch(
        rollout.obs, rollout.action, rollout.extras["log_prob"], parameters, value, scaled, advantage + value, weight,
        begins_episode(rollout), memory,
    )  # fmt: skip
    return as_rows(batch) if network.recurrence is None else batch


def outputs(params: Float[Array, " P"], batch: Batch, network: Network) -> tuple[Float[Array, "*N P"], Float[Array, "*N"]]:
    """Policy parameters and values of a batch."""
    if network.recurrence is None:
        return network.apply(params, batch.obs)
    return network.recurrence.unroll(params, jax.tree.map(lambda x: x[0], batch.memory), batch.obs, batch.begins)[1]


class PolicyStep(NamedTuple):
    """The two functions of a step of the policy, and its settings."""

    distribution: ActionDistribution
    divergence: Divergence
    config: Config

    def surrogate(self, parameters: Float[Array, "*N P"], batch: Batch) -> Float[Array, ""]:
        """What is maximised: paper, eq. 14."""
        ratio = jnp.exp(self.distribution.log_prob(parameters, batch.action) - batch.log_prob)
        return weighted_mean(ratio * batch.advantage, batch.weight)

    def kl(self, parameters: Float[Array, "*N P"], batch: Batch) -> Float[Array, ""]:
        """The mean divergence from the policy before the update."""
        return weighted_mean(self.divergence(batch.parameters, parameters), batch.weight)


def natural_step(
    flat: Float[Array, " P"], batch: Batch, apply: Callable[[Float[Array, " P"]], Float[Array, "*N P"]], step: PolicyStep
) -> tuple[Float[Array, " P"], Metrics]:
    """The parameters after the policy's step, and what is logged of it: paper, appendix C. Without success they stay as they are."""
    config = step.config
    before, gradient = jax.value_and_grad(lambda v: step.surrogate(apply(v), batch))(flat)
    kl_gradient = jax.grad(lambda v: step.kl(apply(v), batch))

    def hessian(x: Float[Array, " P"]) -> Float[Array, " P"]:
        return jax.jvp(kl_gradient, (flat,), (x,))[1] + config.cg_damping * x

    direction = conjugate_gradient(hessian, gradient, config.cg_max_steps)
    curvature = jnp.dot(direction, hessian(direction))
    full = direction * jnp.sqrt(2.0 * config.target_kl / jnp.maximum(curvature, 1e-20))

    def accepts(fraction: Float[Array, ""]) -> Bool[Array, ""]:
        parameters = apply(flat + fraction * full)
        return (step.surrogate(parameters, batch) > before) & (step.kl(parameters, batch) <= config.target_kl)

    found = backtracking_line_search(accepts, config.line_search_shrinking_factor, config.line_search_max_iter)
    after = jnp.where(found.accepted, flat + found.fraction * full, flat)
    parameters = apply(after)
    return after, {
        "train/policy_objective": step.surrogate(parameters, batch),
        "train/kl_divergence_loss": step.kl(parameters, batch),
        "train/is_line_search_success": found.accepted.astype(jnp.float32),
        "train/step_fraction": found.fraction,
        "train/entropy_loss": -weighted_mean(step.distribution.entropy(parameters), batch.weight),
        "train/grad_norm": jnp.linalg.norm(gradient),
    }


def trpo(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """TRPO for an environment. Raises ``UserError`` where a rollout does not divide into minibatches or the space is not supported."""
    distribution, divergence = action_distribution(spec.action_space), policy_divergence(spec.action_space)
    shape = Shape(config.net_arch, config.activation, config.memory, config.memory_size)
    net, example = policy_network(spec, distribution, shape, config.log_std_init, network), example_observation(spec.observation_space)
    flat_net, of_policy = flattened(net, example), reaches_policy(net, example)
    rows, sequences = config.n_steps * spec.num_envs, net.recurrence is not None
    # With memory a minibatch is made of whole sequences, one an environment.
    items, each = (spec.num_envs, config.n_steps) if sequences else (rows, 1)
    per_minibatch = min(max(1, config.batch_size // each), items)
    if items % per_minibatch:
        raise UserError(
            f"trpo: n_steps x environments = {config.n_steps} x {spec.num_envs} = {rows} rows do not divide into minibatches of "
            f"batch_size {config.batch_size}; choose a batch_size that divides {rows}" + (f" and {each} divides" if sequences else "")
        )
    optimizer, learning_rate = optax.scale_by_adam(eps=1e-5), schedule(config.learning_rate)
    policy_step = PolicyStep(distribution, divergence, config)

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

    def learn_value(
        flat: Float[Array, " P"], opt_state: PyTree, batch: Batch, order: Int[Array, "minibatches M"], rate: Float[Array, ""]
    ) -> tuple[Float[Array, " P"], PyTree, Float[Array, ""]]:
        def loss(v: Float[Array, " P"], some: Batch) -> Float[Array, ""]:
            return value_loss(outputs(v, some, flat_net)[1], some.value, some.target, None, some.weight)

        def one(carry: tuple[Array, PyTree], indices: Int[Array, " M"]) -> tuple[tuple[Array, PyTree], Float[Array, ""]]:
            flat, opt_state = carry
            error, grads = jax.value_and_grad(loss)(flat, jax.tree.map(lambda x: x[:, indices] if sequences else x[indices], batch))
            direction, later = optimizer.update(jnp.where(of_policy, 0.0, grads), opt_state)
            accepted = all_finite(error, jnp.linalg.norm(grads))
            return accept_if(accepted, (flat - rate * direction, later), (flat, opt_state)), error

        (flat, opt_state), errors = jax.lax.scan(one, (flat, opt_state), order)
        return flat, opt_state, jnp.mean(errors)

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate = learning_rate(state.env_steps / config.total_steps)
        flat, unravel = ravel_pytree(state.params)
        batch = prepare(rollout, flat, flat_net, config)
        flat, metrics = natural_step(flat, batch, lambda v: outputs(v, batch, flat_net)[0], policy_step)
        order = minibatches(key, items, config.n_critic_updates, per_minibatch)
        flat, opt_state, metrics["train/value_loss"] = learn_value(flat, state.opt_state, batch, order, rate)
        metrics["train/explained_variance"] = explained_variance(batch.value, batch.target, batch.weight > 0)
        metrics |= {"train/learning_rate": rate} | saturation(spec.action_space, rollout.action)
        return State(unravel(flat), opt_state, state.env_steps + rows), metrics

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
        dynamics=lambda state, rollout: look_into_rollout(net, state.params, rollout.obs, state.opt_state),
    )
