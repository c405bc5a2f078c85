"""Learning what actions are worth from replay: the steps that all deep Q-learners share, whatever their returns look like."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.functional.descent import Optimized, descend
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.value_loss import Happened, Rule, Said, value_errors
from thorndike.networks.value_network import Levels, ValueNetwork, read_sequences, read_transitions
from thorndike.replay.off_policy import repeated
from thorndike.replay.prioritized import Draw
from thorndike.replay.replay import Replay
from thorndike.types import Metrics, Number, Rollout


class State(NamedTuple):
    """What learning carries from one iteration to the next. Parameters are flat vectors: see ``ValueNetwork``."""

    params: Float[Array, " P"]
    target_params: Float[Array, " P"]
    opt_state: PyTree
    replay: PyTree
    env_steps: Int[Array, ""]


class Parts(NamedTuple):
    """What a learner is made of."""

    net: ValueNetwork
    rule: Rule
    replay: Replay
    optimizer: optax.GradientTransformation
    gamma: Number


def begin(parts: Parts, key: Key[Array, ""]) -> State:
    """A new network, its copy as the target, an empty memory. Consumes the key."""
    params = parts.net.init(key)
    return State(params, jnp.array(params), parts.optimizer.init(params), parts.replay.init(), jnp.zeros((), jnp.int32))


def minibatch_loss(
    params: Float[Array, " P"], target_params: Float[Array, " P"], draw: Draw, key: Key[Array, ""], parts: Parts
) -> tuple[Float[Array, ""], tuple[Metrics, Float[Array, " M"]]]:
    """The loss of a minibatch; beside it, what is logged and how surprising each transition was. Consumes the key."""
    net, count = parts.net, draw.importance.shape[0]
    key_noise, key_learnt, key_target = jax.random.split(key, 3)
    noise = jax.random.normal(key_noise, (2, net.noise_size))
    weights, target = net.drawn(params, noise[0]), net.drawn(target_params, noise[1])
    fractions = parts.rule.distribution.fractions
    said, happened, valid = _read(parts, weights, target, draw.batch, Levels(fractions(key_learnt, count), fractions(key_target, count)))
    errors, q = value_errors(said, happened, parts.rule)
    loss = weighted_mean(errors.loss * draw.importance, valid)
    return loss, ({"train/loss": loss, "train/q_mean": jnp.mean(q)}, errors.surprise)


def _read(parts: Parts, weights: PyTree, target: PyTree, batch: PyTree, levels: Levels) -> tuple[Said, Happened, Float[Array, " M"]]:
    if not isinstance(batch, Rollout):
        said = read_transitions(parts.net, weights, target, batch.obs, batch.next_obs, levels)
        return said, Happened(batch.action, batch.reward, batch.discount), batch.weight
    step = batch.step
    happened = Happened(batch.action.ravel(), step.reward.ravel(), jnp.where(step.terminated, 0.0, parts.gamma).ravel())
    return read_sequences(parts.net, weights, target, batch, levels), happened, step.valid.ravel().astype(jnp.float32)


def learn(
    parts: Parts, state: State, keys: Key[Array, " keys"], gradient_steps: int, rate: Float[Array, ""], beta: Float[Array, ""]
) -> tuple[State, Metrics]:
    """``gradient_steps`` steps of gradient descent, each on a minibatch of its own. Consumes the keys, two a step."""
    gradient = jax.grad(partial(minibatch_loss, parts=parts), has_aux=True)

    def one(carry: tuple[Optimized, PyTree], i: Int[Array, ""]) -> tuple[tuple[Optimized, PyTree], Metrics]:
        held, replay = carry
        draw = parts.replay.sample(replay, keys[i], beta)
        grads, (metrics, surprise) = gradient(held.params, state.target_params, draw, keys[gradient_steps + i])
        after, metrics["train/grad_norm"] = descend(parts.optimizer, rate, held, grads)
        accepted = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
        return (accept_if(accepted, after, held), parts.replay.learnt(replay, draw, surprise)), metrics

    start = (Optimized(state.params, state.opt_state), state.replay)
    (held, replay), metrics = repeated(one, start, gradient_steps, state.env_steps >= 0)
    return state._replace(params=held.params, opt_state=held.opt_state, replay=replay), metrics


def move_target(state: State, iterations: Int[Array, ""], every: int, tau: Number) -> State:
    """The target network moved by ``tau`` at every ``every``-th iteration."""
    moved = tau * state.params + (1.0 - tau) * state.target_params
    return state._replace(target_params=jnp.where(iterations % every == 0, moved, state.target_params))


def begin_anew(parts: Parts, state: State, due: Bool[Array, ""], key: Key[Array, ""]) -> State:
    """A new network where it is due; what replay holds stays. Nikishin et al. 2022 (arXiv:2205.07802). Consumes the key."""
    params = jax.lax.cond(due, parts.net.init, lambda key: state.params, key)
    target = jnp.where(due, params, state.target_params)
    return state._replace(params=params, target_params=target, opt_state=accept_if(due, parts.optimizer.init(params), state.opt_state))
