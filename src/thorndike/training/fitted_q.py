"""Fitted Q evaluation: the values of one policy's actions, learnt from episodes that another made.

Le, Voloshin, Yue 2019, "Batch Policy Learning under Constraints" (arXiv:1903.08738), with a network and a slowly moving target.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Optimized, descend, follow, optimized
from thorndike.networks.either_actions import ActionValues, action_values
from thorndike.networks.heads import Shape
from thorndike.training.datasets import Dataset
from thorndike.training.policy import Policy
from thorndike.training.recording import action_probabilities
from thorndike.training.sources import from_environment
from thorndike.types import Observation

BATCH, TAU, LEARNING_RATE = 256, 0.05, 1e-3
DRAWS = 8
"""Actions of a stochastic Box policy that stand for it in each state."""
_CHUNK = 4_096


class Intended(NamedTuple):
    """What the policy would do in N states: all Discrete actions with their probabilities, or k actions of a Box, each 1 / k."""

    action: Float[Array, "N k D"] | None
    probability: Float[Array, "N k"]


class FittedValues(NamedTuple):
    """Values under the policy, of the dataset's steps."""

    q: np.ndarray
    """Of the action taken: ``[N]``."""
    v: np.ndarray
    """Of the state it was taken in."""
    v_next: np.ndarray
    """Of the true successor."""


def intentions(policy: Policy, obs: Observation, deterministic: bool, seed: int = 0) -> Intended:
    """What the policy would do in each state ``[N, ...]``. Raises ``UserError`` if that depends on more than the state."""
    if jax.tree.leaves(policy.algorithm.memory(1)) or "frame_stack" in policy.wrapper.name:
        raise UserError("this policy remembers earlier observations, so that steps cannot be judged one by one: evaluate it online")
    chances = action_probabilities(policy, deterministic)
    actor, statistics = jax.tree.map(lambda x: x[policy.best], (policy.actors, policy.statistics))

    @jax.jit
    def of(rows: Observation, key: Key[Array, ""]) -> Intended:
        _, seen = policy.wrapper.init(statistics, rows)
        if chances is not None:
            return Intended(None, chances(actor, (), seen))
        count = jax.tree.leaves(rows)[0].shape[0]
        choose, draws = (policy.algorithm.greedy, 1) if deterministic else (policy.algorithm.act, DRAWS)
        drawn = [choose(actor, (), seen, policy.noise(each, count))[1] for each in jax.random.split(key, draws)]
        return Intended(jnp.clip(jnp.stack(drawn, 1), -1.0, 1.0), jnp.full((count, draws), 1.0 / draws))

    total = jax.tree.leaves(obs)[0].shape[0]
    parts = []
    for start in range(0, total, _CHUNK):
        rows = np.minimum(np.arange(start, start + _CHUNK), total - 1)
        part = of(jax.tree.map(lambda x, rows=rows: jnp.asarray(x[rows]), obs), jax.random.fold_in(jax.random.key(seed), start))
        parts.append(jax.tree.map(np.asarray, part))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:total]), *parts)


def agreement(data: Dataset, intended: Intended) -> float:
    """How much of what the policy does the data speak of: its mean probability of the action taken.

    Of a Box: the share of steps at which one of its actions lies within 0.25 of the one taken, in units in which actions span [-1, 1].
    """
    if intended.action is None:
        return float(jnp.take_along_axis(intended.probability, jnp.asarray(data.action)[:, None], 1).mean())
    taken = jnp.asarray(from_environment(data.origin.action_space, data.action))[:, None]
    near = (jnp.abs(intended.action - taken) <= 0.25).all(-1)
    return float((near * intended.probability).sum(1).mean())


def fitted_values(policy: Policy, data: Dataset, gamma: float, deterministic: bool, steps: int, seed: int) -> FittedValues:
    """Learn them in ``steps`` minibatches. A step that terminated has no future; one cut by a limit goes on at its true successor."""
    shape = Shape((256, 256), "relu")
    net = action_values("fitted Q evaluation", policy.spec, 1, shape)
    now, then = intentions(policy, data.obs, deterministic, seed), intentions(policy, data.next_obs, deterministic, seed)
    # Rewards in units in which values are about 1: one learning rate then does for all tasks.
    scale = max(1.0 - gamma, 1e-3) / max(float(np.abs(data.reward).mean()), 1e-8)
    obs, next_obs = (jax.tree.map(jnp.asarray, tree) for tree in (data.obs, data.next_obs))
    action = jnp.asarray(from_environment(data.origin.action_space, data.action))
    reward, discount = jnp.asarray(data.reward * scale), jnp.asarray(np.where(data.terminated, 0.0, gamma).astype(np.float32))
    optimizer, total = optax.scale_by_adam(), len(data.reward)

    def loss_of(params: Float[Array, "1 P"], rows: Int[Array, " M"], target: Float[Array, " M"]) -> Float[Array, ""]:
        taken = net.taken(params, jax.tree.map(lambda x: x[rows], obs), action[rows])[0]
        return 0.5 * jnp.mean(jnp.square(taken - target))

    def step(i: Int[Array, ""], carry: tuple[Optimized, Array]) -> tuple[Optimized, Array]:
        held, target_params = carry
        rows = jax.random.randint(jax.random.fold_in(key_batches, i), (BATCH,), 0, total)
        value = value_of(net, target_params, jax.tree.map(lambda x: x[rows], next_obs), jax.tree.map(lambda x: x[rows], then))
        gradient = jax.grad(loss_of)(held.params, rows, reward[rows] + discount[rows] * value)
        rate = LEARNING_RATE * (1.0 - i / steps)
        after, _ = descend(optimizer, rate, held, gradient)
        return after, follow(target_params, after.params, TAU)

    key_init, key_batches = jax.random.split(jax.random.key(seed))
    first = net.init(key_init)
    held, _ = jax.jit(lambda start: jax.lax.fori_loop(0, steps, step, start))((optimized(first, optimizer), jnp.array(first)))
    taken = jax.jit(net.taken)(held.params, obs, action)[0]
    values = jax.jit(lambda params, rows, meant: value_of(net, params, rows, meant))
    found = taken, values(held.params, obs, now), values(held.params, next_obs, then)
    return FittedValues(*(np.asarray(each, np.float64) / scale for each in found))


def value_of(net: ActionValues, params: Float[Array, "1 P"], obs: Observation, intended: PyTree) -> Float[Array, " N"]:
    """The mean value of what a policy would do."""
    if net.every is not None:
        return jnp.sum(net.every(params, obs)[0] * intended.probability, axis=-1)
    each = jax.vmap(lambda action: net.taken(params, obs, action)[0], in_axes=1, out_axes=1)(intended.action)
    return jnp.sum(each * intended.probability, axis=-1)
