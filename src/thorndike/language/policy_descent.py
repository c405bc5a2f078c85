"""Epochs of minibatches over a rollout of texts, one compiled program; the first minibatch proves that acting and learning agree."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.policy_losses import approximate_kl, clip_fraction, clipped_surrogate
from thorndike.functional.shuffling import minibatches
from thorndike.language.decoder import Params, hidden_states, token_log_probs
from thorndike.language.learner import accumulated
from thorndike.language.model_config import ModelConfig
from thorndike.language.rollouts import Rollout, before_tokens
from thorndike.types import Metrics, Number

RATIO_TOLERANCE = {"float32": 1e-3, "bfloat16": 0.25}
"""By how much a probability of the forward pass may differ from that of sampling, before anything was learnt.

Measured on a CPU: at most 9e-6 in 26 iterations of the demo. Accelerators multiply float32 in fewer bits."""


class PolicyTerms(NamedTuple):
    """What a minibatch says of the policy."""

    surrogate: Float[Array, ""]
    log_probs: Float[Array, "M N"]
    hidden: Float[Array, "M N d"]
    """The states that the tokens were chosen from."""
    metrics: Metrics


def policy_terms(
    params: Params,
    config: ModelConfig,
    rollout: Rollout,
    advantage: Float[Array, "M N"],
    clip_range: Number,
    temperature: float,
    remat: bool = False,
) -> PolicyTerms:
    """PPO's clipped surrogate, the mean over all tokens of the minibatch, at the temperature that was sampled at."""
    number = rollout.valid.shape[1]
    hidden = before_tokens(hidden_states(params, config, rollout.tokens, rollout.segments, remat), number)
    log_probs = token_log_probs(params, config, hidden, rollout.tokens[:, -number:], temperature)
    weight = rollout.valid.astype(jnp.float32)
    log_ratio = jnp.where(rollout.valid, log_probs - rollout.log_probs, 0.0)
    metrics = {
        "train/approx_kl": approximate_kl(log_ratio, weight),
        "train/clip_fraction": clip_fraction(log_ratio, clip_range, weight),
        "train/ratio_error": jnp.max(jnp.abs(jnp.expm1(log_ratio))),
    }
    return PolicyTerms(clipped_surrogate(log_ratio, advantage, clip_range, weight), log_probs, hidden, metrics)


def descend_epochs(
    loss: Callable[[PyTree, PyTree], tuple[Float[Array, ""], Metrics]],
    learnt: PyTree,
    opt_state: PyTree,
    batch: PyTree,
    key: Key[Array, ""],
    *,
    n_epochs: int,
    batch_size: int,
    parts: int,
    optimizer: optax.GradientTransformation,
    rate: Float[Array, ""],
) -> tuple[PyTree, PyTree, Metrics]:
    """Steps of ``loss(learnt, minibatch)``, in a new order each epoch. A step that is not finite, and those after it, are not taken.

    Metrics are means over the minibatches; ``train/first_ratio_error`` is the ratio's distance to 1 before the first step. With ``parts`` a
    minibatch is cut into so many, one in memory at a time.
    """
    rows = jax.tree.leaves(batch)[0].shape[0]

    def step(carry: tuple[PyTree, PyTree, Array], chosen: Int[Array, " M"]) -> tuple[tuple[PyTree, PyTree, Array], Metrics]:
        learnt, opt_state, going = carry
        minibatch = jax.tree.map(lambda leaf: leaf[chosen], batch)
        gradient, metrics = accumulated(lambda learnt, part: _share(loss(learnt, part), parts), learnt, minibatch, parts)
        norm = optax.tree.norm(gradient)
        direction, after = optimizer.update(gradient, opt_state, learnt)
        going = going & all_finite(metrics["train/loss"], norm)
        moved = jax.tree.map(lambda leaf, change: leaf - rate * change, learnt, direction)
        learnt, opt_state = accept_if(going, (moved, after), (learnt, opt_state))
        return (learnt, opt_state, going), metrics | {"train/grad_norm": norm}

    order = minibatches(key, rows, n_epochs, batch_size)
    (learnt, opt_state, _), rows_of_metrics = jax.lax.scan(step, (learnt, opt_state, jnp.array(True)), order)
    first = rows_of_metrics["train/ratio_error"][0]
    metrics = {name: jnp.mean(values) for name, values in rows_of_metrics.items() if name != "train/ratio_error"}
    return learnt, opt_state, metrics | {"train/first_ratio_error": first}


def _share(found: tuple[Float[Array, ""], Metrics], parts: int) -> tuple[Float[Array, ""], Metrics]:
    loss, metrics = found
    return loss / parts, {name: value / parts for name, value in metrics.items()}


def check_ratio(metrics: Metrics, dtype: str) -> None:
    """Raises ``RuntimeError`` where reading a text gives other probabilities than writing it did: every gradient would be wrong."""
    error = float(metrics["train/first_ratio_error"])
    if not error <= RATIO_TOLERANCE[dtype]:
        raise RuntimeError(
            f"before the first step the probability ratio is off 1 by {error:.3g}: sampling and learning differ in temperature, padding or "
            "parameters. This is a fault of the program, not of your settings"
        )
