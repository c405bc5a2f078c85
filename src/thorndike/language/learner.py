"""What every learner of a language model is: a few pure functions on a state. The batches come from elsewhere.

A step of gradient descent may be taken over several parts of a batch, one after the other (gradient accumulation): the loss is divided by
the weight of the *whole* batch, so that it is the same step whatever the parts are. Where several devices share rows
(training/devices.py), each reads its share of every part, and all have the sum of their gradients.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.schedules import schedule
from thorndike.language.decoder import Params
from thorndike.language.lora import Adapter, LoraConfig, initial_adapter, merged
from thorndike.language.model_config import ModelConfig
from thorndike.training.devices import rows_shared, same_everywhere
from thorndike.types import Metrics


class State(NamedTuple):
    """All that changes while a model learns."""

    trained: PyTree
    """The parameters, or an adapter's matrices."""
    opt_state: PyTree
    step: Int[Array, ""]


class Learner(NamedTuple):
    """A learner of a language model, built by a factory such as ``sft(config, model_config)``."""

    init: Callable[[Params, Key[Array, ""]], State]
    """The parameters to begin with, key -> State. Consumes the key."""
    update: Callable[[State, Params, PyTree], tuple[State, Metrics]]
    """State, the parameters it began with (``()`` unless an adapter is learnt), a batch -> State, metrics: one step."""
    evaluate: Callable[[State, Params, PyTree], Metrics]
    """The same arguments -> how good it is on a batch that it does not learn from."""
    params: Callable[[State, Params], Params]
    """State, the parameters it began with -> the parameters it has now."""
    frozen: Callable[[Params], Params]
    """The part of the parameters that it begins with that ``update`` needs beside the state: all of them for an adapter, else nothing."""


class Trained(NamedTuple):
    """Which numbers are learnt: all parameters, or a LoRA adapter's."""

    begin: Callable[[Params, Key[Array, ""]], PyTree]
    params: Callable[[PyTree, Params], Params]
    frozen: Callable[[Params], Params]


def what_is_trained(model_config: ModelConfig, lora: LoraConfig | None) -> Trained:
    """All parameters, in float32 so that small steps are not lost; with ``lora``, an adapter's matrices only."""
    if lora is None:
        return Trained(
            begin=lambda params, key: jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), params),
            params=lambda trained, frozen: trained,
            frozen=lambda params: (),
        )
    return Trained(
        begin=lambda params, key: initial_adapter(model_config, lora, key).pairs,
        params=lambda trained, frozen: merged(frozen, model_config, Adapter(lora, trained)),
        frozen=lambda params: params,
    )


def adamw(beta1: float, beta2: float, epsilon: float, weight_decay: float, max_grad_norm: float) -> optax.GradientTransformation:
    """Directions of AdamW (Loshchilov and Hutter 2019, arXiv:1711.05101), to be multiplied by ``-rate``; only matrices decay."""
    return optax.chain(
        optax.clip_by_global_norm(max_grad_norm),
        optax.scale_by_adam(beta1, beta2, epsilon),
        optax.add_decayed_weights(weight_decay, mask=lambda params: jax.tree.map(lambda leaf: leaf.ndim > 1, params)),
    )


def rate_at(learning_rate: float | str, warmup_fraction: float, step: Int[Array, ""], total_steps: int) -> Float[Array, ""]:
    """The learning rate of a step: the schedule, rising from 0 over the first part of the run."""
    warmup = jnp.minimum(1.0, (step + 1) / max(1.0, warmup_fraction * total_steps))
    return schedule(learning_rate)(step / total_steps) * warmup


def descend(
    optimizer: optax.GradientTransformation, rate: Float[Array, ""], state: State, gradient: PyTree
) -> tuple[State, Float[Array, ""]]:
    """The state after a step, and the norm of the gradient before it was clipped."""
    norm = optax.tree.norm(gradient)
    direction, opt_state = optimizer.update(gradient, state.opt_state, state.trained)
    trained = jax.tree.map(lambda leaf, change: leaf - rate * change, state.trained, direction)
    return State(trained, opt_state, state.step + 1), norm


def accumulated(
    loss: Callable[[PyTree, PyTree], tuple[Float[Array, ""], Metrics]], trained: PyTree, batch: PyTree, parts: int
) -> tuple[PyTree, Metrics]:
    """The gradient of ``loss(trained, part)`` and its metrics, summed over so many equal parts of a batch's first axis."""
    gradient_of = jax.grad(loss, has_aux=True)
    if parts == 1:
        return same_everywhere(gradient_of(trained, rows_shared(batch)))
    cut = jax.tree.map(lambda leaf: leaf.reshape(parts, -1, *leaf.shape[1:]), batch)

    def add(total: tuple[PyTree, Metrics], part: PyTree) -> tuple[tuple[PyTree, Metrics], None]:
        return jax.tree.map(jnp.add, total, same_everywhere(gradient_of(trained, rows_shared(part)))), None

    shapes = jax.eval_shape(gradient_of, trained, jax.tree.map(lambda leaf: leaf[0], cut))
    nothing = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    return jax.lax.scan(add, nothing, cut)[0]
