"""Action distributions as pure functions of their parameters, one a kind of action space.

A network gives parameters ``[B, P]``; noise is drawn ahead of time, so that sampling inside a scan draws nothing.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree, Shaped

from thorndike.errors import UserError
from thorndike.functional.held_noise import state_dependent_sample

BOX_KINDS = ("gaussian", "squashed", "beta")
"""The choices of an ``action_distribution`` setting: clipped by the engine, squashed by tanh, or bounded by nature."""
NEAREST_TO_A_BOUND = 1e-6
"""How near to -1 or 1 an action's density is told apart: float32 rounds what is nearer."""
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(24)
_TRIES = 6


class ActionDistribution(NamedTuple):
    """A family of distributions over actions. ``P`` is the number of parameters."""

    network_outputs: int
    """How many of the parameters the network computes from the observation."""
    free_parameters: int
    """How many are learnt but do not depend on the observation (a Gaussian's log standard deviations); appended to the network's."""
    draw: Callable[[Key[Array, ""], tuple[int, ...]], Float[Array, "..."]]
    """key, leading shape -> noise. Consumes the key."""
    sample: Callable[[Float[Array, "*B P"], PyTree], Shaped[Array, "..."]]
    """parameters, noise (``HeldNoise`` where it depends on the state) -> action."""
    mode: Callable[[Float[Array, "*B P"]], Shaped[Array, "..."]]
    """The most probable action."""
    log_prob: Callable[[Float[Array, "*B P"], Shaped[Array, "..."]], Float[Array, "*B"]]
    entropy: Callable[[Float[Array, "*B P"]], Float[Array, "*B"]]
    features: int = 0
    """Above 0: exploration depends on the state by that many features; the network then adds what ``held_noise.py`` says."""


def action_distribution(space: gymnasium.Space, kind: str = "gaussian", features: int = 0) -> ActionDistribution:
    """The distribution for a space: categorical, several categoricals (MultiBinary: of two), or for a Box the ``kind`` of BOX_KINDS.

    ``features`` above 0 is for state-dependent exploration. Raises ``UserError`` for a space that has none, or a kind it cannot have.
    """
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return _box_distribution(space.shape[0], kind, features)
    if kind != "gaussian" or features:
        asked = "use_sde" if features else f"action_distribution={kind}"
        raise UserError(f"{asked} is for Box actions, one row of floats; this environment has {space}: leave it out")
    if isinstance(space, gymnasium.spaces.Discrete):
        return categorical(int(space.n))
    if isinstance(space, gymnasium.spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return multi_categorical(tuple(int(n) for n in space.nvec))
    if isinstance(space, gymnasium.spaces.MultiBinary) and len(space.shape) == 1:
        return multi_categorical((2,) * space.shape[0])
    raise UserError(
        f"actions may be Discrete, MultiDiscrete or MultiBinary (one row), or Box (one row of floats); this environment has {space}"
    )


def _box_distribution(dimensions: int, kind: str, features: int) -> ActionDistribution:
    if kind == "beta":
        if features:
            raise UserError("use_sde explores with Gaussian noise: set action_distribution to gaussian or squashed, not beta")
        return beta(dimensions)
    base = state_dependent_gaussian(dimensions, features) if features else diagonal_gaussian(dimensions)
    return squashed(base, dimensions) if kind == "squashed" else base


def saturation(space: gymnasium.Space, action: Shaped[Array, "..."]) -> dict[str, Float[Array, ""]]:
    """``rollout/action_saturation``: the share of a Box's action numbers within 1 % of the bounds [-1, 1], or clipped to them.

    Near 1 the policy pushes against its bounds all the time. Nothing for other spaces.
    """
    if not isinstance(space, gymnasium.spaces.Box):
        return {}
    return {"rollout/action_saturation": jnp.mean((jnp.abs(action) > 0.99).astype(jnp.float32))}


def categorical(n: int) -> ActionDistribution:
    """One of ``n`` actions; the parameters are logits, the noise is Gumbel."""

    def log_prob(logits: Float[Array, "*B n"], action: Shaped[Array, "*B"]) -> Float[Array, "*B"]:
        # A one-hot product, because its gradient is a product too: the gradient of a gather is a scatter, slow on a CPU.
        chosen = jax.nn.one_hot(action, n, dtype=logits.dtype)
        return jnp.sum(jax.nn.log_softmax(logits) * chosen, axis=-1)

    def entropy(logits: Float[Array, "*B n"]) -> Float[Array, "*B"]:
        log_probabilities = jax.nn.log_softmax(logits)
        return -jnp.sum(jnp.exp(log_probabilities) * log_probabilities, axis=-1)

    return ActionDistribution(
        network_outputs=n,
        free_parameters=0,
        draw=lambda key, shape: jax.random.gumbel(key, (*shape, n)),
        sample=lambda logits, noise: jnp.argmax(logits + noise, axis=-1).astype(jnp.int32),
        mode=lambda logits: jnp.argmax(logits, axis=-1).astype(jnp.int32),
        log_prob=log_prob,
        entropy=entropy,
    )


def multi_categorical(sizes: tuple[int, ...]) -> ActionDistribution:
    """Independent categoricals of the given sizes; actions are ``int32[*B, K]``."""
    parts = [categorical(n) for n in sizes]
    ends = tuple(int(end) for end in np.cumsum(sizes)[:-1])

    def split(x: Float[Array, "*B P"]) -> list[Float[Array, "*B n"]]:
        return jnp.split(x, ends, axis=-1)

    return ActionDistribution(
        network_outputs=sum(sizes),
        free_parameters=0,
        draw=lambda key, shape: jax.random.gumbel(key, (*shape, sum(sizes))),
        sample=lambda logits, noise: jnp.stack([p.sample(x, g) for p, x, g in zip(parts, split(logits), split(noise), strict=True)], -1),
        mode=lambda logits: jnp.stack([p.mode(x) for p, x in zip(parts, split(logits), strict=True)], -1),
        log_prob=lambda logits, action: sum(
            (p.log_prob(x, action[..., i]) for i, (p, x) in enumerate(zip(parts, split(logits), strict=True))), jnp.zeros(())
        ),
        entropy=lambda logits: sum((p.entropy(x) for p, x in zip(parts, split(logits), strict=True)), jnp.zeros(())),
    )


def diagonal_gaussian(dimensions: int) -> ActionDistribution:
    """Independent Gaussians; parameters are the means and the log standard deviations. Actions are not squashed: the engine clips them."""

    def split(parameters: Float[Array, "*B P"]) -> tuple[Float[Array, "*B D"], Float[Array, "*B D"]]:
        return parameters[..., :dimensions], parameters[..., dimensions:]

    def sample(parameters: Float[Array, "*B P"], noise: Float[Array, "*B D"]) -> Float[Array, "*B D"]:
        mean, log_std = split(parameters)
        return mean + jnp.exp(log_std) * noise

    def log_prob(parameters: Float[Array, "*B P"], action: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        mean, log_std = split(parameters)
        standard = (action - mean) * jnp.exp(-log_std)
        return jnp.sum(-0.5 * jnp.square(standard) - log_std - 0.5 * math.log(2.0 * math.pi), axis=-1)

    return ActionDistribution(
        network_outputs=dimensions,
        free_parameters=dimensions,
        draw=lambda key, shape: jax.random.normal(key, (*shape, dimensions)),
        sample=sample,
        mode=lambda parameters: split(parameters)[0],
        log_prob=log_prob,
        entropy=lambda parameters: jnp.sum(split(parameters)[1] + 0.5 * math.log(2.0 * math.pi * math.e), axis=-1),
    )


def state_dependent_gaussian(dimensions: int, features: int) -> ActionDistribution:
    """A Gaussian whose noise is a held function of the state: see ``held_noise.py``, which says what the parameters are.

    Its density and entropy are those over all noise matrices; a sample takes ``HeldNoise``.
    """
    marginal = diagonal_gaussian(dimensions)
    return ActionDistribution(
        network_outputs=dimensions,
        free_parameters=0,
        draw=lambda key, shape: jax.random.normal(key, (*shape, features, dimensions)),
        sample=lambda parameters, noise: state_dependent_sample(parameters, noise.held),
        mode=lambda parameters: parameters[..., :dimensions],
        log_prob=lambda parameters, action: marginal.log_prob(parameters[..., : 2 * dimensions], action),
        entropy=lambda parameters: marginal.entropy(parameters[..., : 2 * dimensions]),
        features=features,
    )


def squashed(base: ActionDistribution, dimensions: int) -> ActionDistribution:
    """A Gaussian squashed into (-1, 1) by the hyperbolic tangent; parameters as those of ``base``, means and log deviations first.

    Haarnoja et al. 2018 (arXiv:1801.01290), appendix C. The entropy has no closed form: it is that of the Gaussian plus the mean of the
    logarithm of the squashing's slope, by Gauss-Hermite quadrature.
    """

    def before(action: Float[Array, "*B D"]) -> Float[Array, "*B D"]:
        return jnp.arctanh(jnp.clip(action, NEAREST_TO_A_BOUND - 1.0, 1.0 - NEAREST_TO_A_BOUND))

    def log_slope(x: Float[Array, "..."]) -> Float[Array, "..."]:
        return 2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))

    def log_prob(parameters: Float[Array, "*B P"], action: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        x = before(action)
        return base.log_prob(parameters, x) - jnp.sum(log_slope(x), axis=-1)

    def entropy(parameters: Float[Array, "*B P"]) -> Float[Array, "*B"]:
        mean, log_std = parameters[..., :dimensions, None], parameters[..., dimensions : 2 * dimensions, None]
        nodes, weights = (x.astype(np.float32).reshape((1,) * (mean.ndim - 1) + (-1,)) for x in (_NODES, _WEIGHTS / _WEIGHTS.sum()))
        slopes = jnp.sum(log_slope(mean + jnp.exp(log_std) * nodes) * weights, axis=-1)
        return base.entropy(parameters) + jnp.sum(slopes, axis=-1)

    return base._replace(
        sample=lambda parameters, noise: jnp.tanh(base.sample(parameters, noise)),
        mode=lambda parameters: jnp.tanh(base.mode(parameters)),
        log_prob=log_prob,
        entropy=entropy,
    )


def beta(dimensions: int) -> ActionDistribution:
    """Independent Beta distributions stretched over [-1, 1]; nothing falls outside the bounds, so nothing is clipped.

    Chou, Maturana, Scherer 2017, "Improving Stochastic Policy Gradients in Continuous Control with Deep Reinforcement Learning using the
    Beta Distribution" (ICML): ``a`` and ``b`` above 1, so that there is one mode. Deviation: parameters are the mode's logit m and the
    logarithm k of the concentration, ``a = 1 + e^k sigmoid(m)`` and ``b = 1 + e^k sigmoid(-m)``. By ``1 + softplus`` of one number each,
    as in the paper, an ``a`` that falls to 1 has no gradient any more and stays there: a probe environment caught it.
    """

    def shapes(parameters: Float[Array, "*B P"]) -> tuple[Float[Array, "*B D"], Float[Array, "*B D"]]:
        logit, concentration = parameters[..., :dimensions], jnp.exp(jnp.clip(parameters[..., dimensions:], -10.0, 10.0))
        return 1.0 + concentration * jax.nn.sigmoid(logit), 1.0 + concentration * jax.nn.sigmoid(-logit)

    def sample(parameters: Float[Array, "*B P"], noise: Float[Array, "*B D 2 tries 2"]) -> Float[Array, "*B D"]:
        pair = _gamma(jnp.stack(shapes(parameters), axis=-1), noise)
        return 2.0 * pair[..., 0] / (pair[..., 0] + pair[..., 1]) - 1.0

    def log_prob(parameters: Float[Array, "*B P"], action: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        a, b = shapes(parameters)
        x = jnp.clip(0.5 * (action + 1.0), NEAREST_TO_A_BOUND, 1.0 - NEAREST_TO_A_BOUND)
        density = (a - 1.0) * jnp.log(x) + (b - 1.0) * jnp.log1p(-x) - jax.scipy.special.betaln(a, b)
        return jnp.sum(density - math.log(2.0), axis=-1)

    def entropy(parameters: Float[Array, "*B P"]) -> Float[Array, "*B"]:
        a, b = shapes(parameters)
        digamma = jax.scipy.special.digamma
        own = (a - 1.0) * digamma(a) + (b - 1.0) * digamma(b) - (a + b - 2.0) * digamma(a + b)
        return jnp.sum(jax.scipy.special.betaln(a, b) - own + math.log(2.0), axis=-1)

    return ActionDistribution(
        network_outputs=2 * dimensions,
        free_parameters=0,
        draw=lambda key, shape: jax.random.normal(key, (*shape, dimensions, 2, _TRIES, 2)),
        sample=sample,
        mode=lambda parameters: jnp.tanh(0.5 * parameters[..., :dimensions]),
        log_prob=log_prob,
        entropy=entropy,
    )


def _gamma(shape: Float[Array, "*B"], noise: Float[Array, "*B tries 2"]) -> Float[Array, "*B"]:
    """Gamma variates of shapes of at least 1: Marsaglia and Tsang 2000, "A simple method for generating gamma variables".

    A try is refused with a chance below 5 %, so that of six, drawn ahead, all are with one below 2e-8; the first then stands.
    """
    d = shape[..., None] - 1.0 / 3.0
    normal, log_uniform = noise[..., 0], jax.scipy.special.log_ndtr(noise[..., 1])
    base = 1.0 + normal / jnp.sqrt(9.0 * d)
    cubed = jnp.maximum(base, 1e-3) ** 3
    accepted = (base > 0.0) & (log_uniform < 0.5 * jnp.square(normal) + d - d * cubed + d * jnp.log(cubed))
    chosen = jax.nn.one_hot(jnp.argmax(accepted, axis=-1), noise.shape[-2], dtype=cubed.dtype)
    return jnp.sum(d * cubed * chosen, axis=-1)
