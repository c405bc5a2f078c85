"""Rewards for what is new, as wrappers that any learner can take: random network distillation, and counts.

Both add to the reward in ``learn``, once a rollout, after every wrapper has shown the step: they look at what the learner sees. Episode
returns and evaluation are of the environment's own reward. What is learnt here is saved in checkpoints; evaluation neither changes nor
uses it. The bonus of a step is that of its true successor; a row that is no transition gets none and is not learnt from. A replay buffer
keeps each bonus as it was when it came.

The bonus ends with its episode, as the reward does, because a learner has one value for the sum of both. The non-episodic bonus of
Burda et al. needs a second value, which would be another learner.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium import spaces
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.environments.observation_views import as_numbers, joined, numbers_shape, shown_leaves, space_leaves
from thorndike.errors import UserError
from thorndike.functional.descent import Optimized, descend, optimized
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.normalization import Moments, empty_moments, merge_moments, moments_of, normalize, running_returns, scale
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.masking import without_mask
from thorndike.networks.network import Network, flattened
from thorndike.networks.torso import Torso
from thorndike.types import Action, EnvSpec, Observation, Rollout, Step, Wrapper

NAME = "random_network_distillation"
CLIP = 5.0
"""Of normalised observations: Burda et al. 2018, section 2.4."""


class Distilled(NamedTuple):
    """What random network distillation has learnt, a seed."""

    target: Float[Array, " P"]
    """The random network, which never changes."""
    predictor: Optimized
    observations: tuple[Moments, ...]
    """Of every leaf of the observation, those of a Discrete one as one-hot rows: their shapes say what it is made of."""
    returns: Moments
    """Of the discounted sums of raw bonuses."""


def random_network_distillation(
    coefficient: float = 0.5,
    gamma: float = 0.99,
    learning_rate: float = 1e-4,
    features: int = 64,
    net_arch: tuple[int, ...] = (128,),
    n_epochs: int = 1,
    batch_size: int = 256,
) -> Wrapper:
    """The reward plus how badly a network predicts another, random one at the successor: what was seen often is predicted well.

    Burda, Edwards, Storkey and Klimov 2018, "Exploration by Random Network Distillation" (arXiv:1810.12894), algorithm 1. Observations are
    whitened and clipped, bonuses divided by the running deviation of their discounted sums (``gamma``), which go on over episodes.
    Deviations: see docs/exploration.md. Raises UserError for settings out of bounds, and where a wrapper after it changes the observation.
    """
    sizes = {"features": features, "n_epochs": n_epochs, "batch_size": batch_size}
    numbers = {"coefficient": coefficient, "learning_rate": learning_rate, **sizes}
    for name, value in numbers.items():
        if not value > 0:
            raise UserError(f"random_network_distillation needs {name} above 0, not {value}")
    adam, widths = optax.scale_by_adam(), tuple(net_arch)

    def networks(moments: tuple[Moments, ...]) -> tuple[Network, Network, Array]:
        example = joined(tuple(own.mean[None] for own in moments))
        return _features(example, widths, features), _features(example, (*widths, *widths[-1:]), features), example

    def statistics(env_spec: EnvSpec) -> Distilled:
        moments = tuple(empty_moments(numbers_shape(leaf)) for leaf in space_leaves(without_mask(env_spec.observation_space)))
        return drawn(moments, jax.random.key(0))

    def drawn(moments: tuple[Moments, ...], key: Key[Array, ""]) -> Distilled:
        *both, example = networks(moments)
        target, predictor = (ravel_pytree(net.init(k, example))[0] for net, k in zip(both, jax.random.split(key), strict=True))
        return Distilled(target, optimized(predictor, adam), moments, empty_moments(()))

    def learn(statistics: Distilled, memory: Float[Array, " B"], rollout: Rollout) -> tuple[Distilled, Float[Array, " B"], Rollout]:
        valid, reward = rollout.step.valid, rollout.step.reward
        rows = _numbers(rollout.step.next_obs, statistics.observations)
        moments = tuple(merge_moments(own, moments_of(row, valid)) for own, row in zip(statistics.observations, rows, strict=True))
        seen = joined(tuple(_flat_time(normalize(row, own, clip=CLIP)) for row, own in zip(rows, moments, strict=True)))
        target, predictor, example = networks(moments)
        predict, goal = flattened(predictor, example).apply, jnp.asarray(flattened(target, example).apply(statistics.target, seen))
        error = _error(jnp.asarray(predict(statistics.predictor.params, seen)), goal).reshape(valid.shape) * valid
        memory, returns = running_returns(error, jnp.zeros_like(valid), memory, gamma)
        spread = merge_moments(statistics.returns, moments_of(returns, valid))
        bonus = coefficient * scale(error, spread)
        batches = _minibatches((seen, goal, valid.ravel().astype(jnp.float32)), batch_size)
        held = _distil(predict, statistics.predictor, batches, adam, learning_rate, n_epochs)
        return Distilled(statistics.target, held, moments, spread), memory, _rewarded(rollout, reward + bonus)

    settings = {"name": NAME, "gamma": gamma, "net_arch": list(widths), **numbers}
    return Wrapper(NAME, settings, _same_spec, statistics, _zeros, _as_it_is, learn, lambda own, key: drawn(own.observations, key))


def count_bonus(coefficient: float = 0.1, resolution: float = 1.0, table_bits: int = 20) -> Wrapper:
    """The reward plus ``coefficient / sqrt(N)``, where N is how often the successor has been seen, this rollout's visits included.

    Strehl and Littman 2008, "An analysis of model-based interval estimation" (the bonus); Tang et al. 2017 (arXiv:1611.04717), hashed
    counts. A Discrete observation has a count of its own; of any other, numbers are rounded down to multiples of `resolution` and hashed
    into ``2 ** table_bits`` counts. Raises UserError for settings out of bounds.
    """
    if not (coefficient > 0 and resolution > 0 and 1 <= table_bits <= 28):
        given = f"{coefficient}, {resolution}, {table_bits}"
        raise UserError(f"count_bonus needs coefficient and resolution above 0 and table_bits from 1 to 28, not {given}")

    def statistics(env_spec: EnvSpec) -> Int[Array, " table"]:
        space = without_mask(env_spec.observation_space)
        size = int(space.n) if isinstance(space, spaces.Discrete) and space.n <= 2**28 else 2**table_bits
        return jnp.zeros(size, jnp.int32)

    def learn(counts: Int[Array, " table"], memory: PyTree, rollout: Rollout) -> tuple[Int[Array, " table"], PyTree, Rollout]:
        valid, reward = rollout.step.valid, rollout.step.reward
        place = _place(rollout.step.next_obs, counts.shape[0], resolution)
        counts = counts.at[place].add(valid.ravel().astype(jnp.int32), mode="promise_in_bounds")
        visits = counts[place].reshape(valid.shape).astype(jnp.float32)
        bonus = coefficient / jnp.sqrt(jnp.maximum(visits, 1.0))
        return counts, memory, _rewarded(rollout, reward + bonus)

    settings = {"name": "count_bonus", "coefficient": coefficient, "resolution": resolution, "table_bits": table_bits}
    return Wrapper("count_bonus", settings, _same_spec, statistics, _zeros, _as_it_is, learn)


class _Features(nn.Module):
    """Random features of an observation: images through convolutions, everything else through dense layers."""

    space: spaces.Box
    hidden: Sequence[int]
    features: int

    @nn.compact
    def __call__(self, obs: Float[Array, "B ..."]) -> Float[Array, "B F"]:
        init = nn.initializers.orthogonal(2.0**0.5)
        return nn.Dense(self.features, kernel_init=init)(Torso(self.space, self.hidden, "relu", init)(obs))


def _features(example: Array, hidden: tuple[int, ...], features: int) -> Network:
    module = _Features(spaces.Box(-CLIP, CLIP, example.shape[1:], np.float32), hidden, features)
    return Network(lambda key, obs: module.init(key, obs)["params"], lambda params, obs: module.apply({"params": params}, obs))


def _error(predicted: Float[Array, "N F"], goal: Float[Array, "N F"]) -> Float[Array, " N"]:
    return jnp.mean(jnp.square(predicted - goal), axis=-1)


def _distil(
    predict: Callable[[PyTree, Observation], PyTree],
    held: Optimized,
    batches: tuple[Array, ...],
    adam: optax.GradientTransformation,
    rate: float,
    n_epochs: int,
) -> Optimized:
    """The predictor after ``n_epochs`` passes over the minibatches ``[K, M, ...]``."""

    def loss(params: Float[Array, " P"], rows: Array, goal: Array, weight: Array) -> Float[Array, ""]:
        return weighted_mean(_error(jnp.asarray(predict(params, rows)), goal), weight)

    def one(held: Optimized, batch: tuple[Array, ...]) -> tuple[Optimized, None]:
        after, norm = descend(adam, rate, held, jax.grad(loss)(held.params, *batch))
        return accept_if(all_finite(norm), after, held), None

    return jax.lax.fori_loop(0, n_epochs, lambda i, held: jax.lax.scan(one, held, batches)[0], held)


def _minibatches(rows: tuple[Array, ...], size: int) -> tuple[Array, ...]:
    """Rows ``[N, ...]`` as ``[K, M, ...]``, M at least `size` if there are as many; each takes every K-th row. A remainder is left out."""
    count = max(1, rows[0].shape[0] // size)
    each = rows[0].shape[0] // count

    def cut(x: Array) -> Array:
        return x[: each * count].reshape(each, count, *x.shape[1:]).swapaxes(0, 1)

    return tuple(cut(x) for x in rows)


def _numbers(obs: Observation, moments: tuple[Moments, ...]) -> tuple[Float[Array, "T B ..."], ...]:
    """Every leaf as floats of the shape of its moments."""
    try:
        return as_numbers(shown_leaves(obs), [own.mean.shape for own in moments], leading=2)
    except UserError as error:
        raise UserError(f"{NAME} looks at what the learner sees: put it after the wrappers that change the observation") from error


def _flat_time(x: Float[Array, "T B ..."]) -> Float[Array, "N ..."]:
    return x.reshape(-1, *x.shape[2:])


def _place(obs: Observation, size: int, resolution: float) -> Int[Array, " N"]:
    """Which of ``size`` counts each observation has."""
    leaves = [_flat_time(leaf) for leaf in shown_leaves(obs)]
    if len(leaves) == 1 and leaves[0].ndim == 1 and jnp.issubdtype(leaves[0].dtype, jnp.integer):
        return leaves[0].astype(jnp.int32) % size
    whole = [jnp.floor(leaf.reshape(leaf.shape[0], -1).astype(jnp.float32) / resolution).astype(jnp.int32) for leaf in leaves]
    words = jnp.concatenate(whole, axis=-1).astype(jnp.uint32)
    # Multilinear hashing: Dietzfelbinger et al. 1997; the high bits of the sum are the good ones.
    odd = np.random.default_rng(0).integers(0, 2**31, words.shape[-1], np.uint32) * np.uint32(2) + np.uint32(1)
    return (jnp.sum(words * odd[None], axis=-1, dtype=jnp.uint32) >> np.uint32(33 - size.bit_length())).astype(jnp.int32)


def _rewarded(rollout: Rollout, reward: Float[Array, "T B"]) -> Rollout:
    step = rollout.step
    return rollout._replace(step=step._replace(reward=jnp.where(step.valid, reward, step.reward)))


def _same_spec(env_spec: EnvSpec) -> EnvSpec:
    return env_spec


def _zeros(statistics: PyTree, obs: Observation) -> tuple[Float[Array, " B"], Observation]:
    del statistics
    return jnp.zeros(jax.tree.leaves(obs)[0].shape[0], jnp.float32), obs


def _as_it_is(statistics: PyTree, memory: PyTree, obs: Observation, action: Action, step: Step) -> tuple[PyTree, Step]:
    del statistics, obs, action
    return memory, step
