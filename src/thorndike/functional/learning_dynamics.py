"""How a network fares while it learns: units that no longer do anything, directions its features use, gradients by module.

Pure measurements of what a learner has at hand; nothing here takes part in learning.
"""

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PyTree

from thorndike.types import Metrics

SATURATED = 0.99
"""|h| of a tanh unit beyond which its gradient is below a fiftieth of that at 0."""
ADAM_DECAY = 0.999
"""The decay of Adam's mean square, which all learners here leave at its default."""


def dead(outputs: Float[Array, "N *places units"], activation: str) -> Bool[Array, " units"]:
    """Units that tell no row of a batch from another: a tanh beyond ``SATURATED`` in every row, any other unit never above 0.

    For ReLU it is the 0-dormant unit of Sokar et al. 2023 (arXiv:2302.12902, definition 3.1). A channel of a convolution is one unit.
    """
    rows = outputs.reshape(-1, outputs.shape[-1])
    return jnp.all(jnp.abs(rows) > SATURATED, axis=0) if activation == "tanh" else jnp.all(rows <= 0.0, axis=0)


def effective_rank(features: Float[Array, "N units"]) -> Float[Array, ""]:
    """Along how many directions features vary: the participation ratio ``(sum l)^2 / sum l^2`` of their covariance's eigenvalues ``l``.

    Between 1 and the number of units; 0 where nothing varies. The sums are the trace of the covariance and of its square, so it takes a
    matrix product and no decomposition, which the ranks by singular values need (Roy and Vetterli 2007; Kumar et al. 2021,
    arXiv:2010.14498). Gao et al. 2017, "A theory of multineuronal dimensionality, dynamics and measurement".
    """
    centred = features - jnp.mean(features, axis=0, keepdims=True)
    # Scaled before it is squared twice: features of 1e-10 or 1e10 have a rank too.
    largest = jnp.max(jnp.abs(centred))
    scaled = centred / jnp.where(largest > 0.0, largest, 1.0)
    # The smaller of the two products has the same trace and square.
    wide = features.shape[1] > features.shape[0]
    gram = scaled @ scaled.T if wide else scaled.T @ scaled
    return jnp.square(jnp.trace(gram)) / jnp.maximum(jnp.sum(jnp.square(gram)), 1e-30)


def unit_metrics(layers: PyTree, name: str | None = None) -> Metrics:
    """``train/dead_units/<module>`` (a share) and ``train/effective_rank/<module>`` (of its last hidden layer).

    ``layers`` is a tree of hidden layers' outputs ``[N, ..., units]`` whose paths end in the activation's name and the layer's number: see
    ``networks/hidden_layers.py``. A module is the first name of a path; with ``name`` all of it is one module, of that name.
    """
    modules: dict[str, list[tuple[int, int, str, Array]]] = {}
    for path, outputs in jax.tree.leaves_with_path(layers):
        words = [str(key.key) if isinstance(key, jax.tree_util.DictKey) else str(key.idx) for key in path]
        modules.setdefault(words[0] if name is None else name, []).append((-len(words), int(words[-1]), words[-2], outputs))
    metrics = {}
    for module, found in modules.items():
        units = jnp.concatenate([dead(outputs, activation) for _, _, activation, outputs in found])
        metrics[f"train/dead_units/{module}"] = jnp.mean(units.astype(jnp.float32))
        # The last layer: that of the highest number among those that lie least deep.
        last = max(found, key=lambda layer: layer[:2])[3]
        metrics[f"train/effective_rank/{module}"] = effective_rank(last.reshape(-1, last.shape[-1]))
    return metrics


def mean_square_gradient(opt_state: PyTree) -> PyTree:
    """The running mean of the squared gradient that Adam, RAdam and RMSProp divide by, shaped as the parameters.

    Adam's is freed of its bias towards its start at 0; RMSProp, which counts no steps, forgets that start in a few hundred of them.
    """
    squares, count = (optax.tree_utils.tree_get(opt_state, field) for field in ("nu", "count"))
    if count is None:
        return squares
    unbiased = jnp.maximum(1.0 - ADAM_DECAY ** count.astype(jnp.float32), 1.0 - ADAM_DECAY)
    return jax.tree.map(lambda square: square / unbiased, squares)


def gradient_norms(squares: PyTree, name: str | None = None) -> Metrics:
    """``train/grad_norm/<module>``: the root of the mean squared norm, from the mean ``squares`` of each parameter's gradient.

    The modules are the tree's first names, after the numbers of networks that lie side by side; ``name`` comes before them.
    """
    sums: dict[str, Array] = {}
    for path, square in jax.tree.leaves_with_path(squares):
        module = _module_of(path) if name is None else f"{name}/{_module_of(path)}"
        sums[module] = sums.get(module, jnp.zeros(())) + jnp.sum(square)
    return {f"train/grad_norm/{module}": jnp.sqrt(total) for module, total in sums.items()}


def _module_of(path: tuple[object, ...]) -> str:
    """Numbers up to the first name, and that name; Flax's collection ``params`` is none."""
    words: list[str] = []
    for key in path:
        if isinstance(key, jax.tree_util.SequenceKey):
            words.append(str(key.idx))
            continue
        name = str(key.key) if isinstance(key, jax.tree_util.DictKey) else str(getattr(key, "name", key))
        words.append(name)
        if name != "params":
            break
    return "/".join(word for word in words if word != "params") or "all"
