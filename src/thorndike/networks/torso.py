"""The body of a network: from an observation of any space to features, by a multilayer perceptron or, for images, convolutions first."""

from collections.abc import Callable, Sequence

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.errors import UserError
from thorndike.networks.cnn import CNN
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN
from thorndike.networks.masking import observed, without_mask, without_position
from thorndike.types import Observation

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"tanh": nn.tanh, "relu": nn.relu, "gelu": nn.gelu, "silu": nn.silu}

torch_uniform = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")
"""PyTorch's default for dense layers: uniform in +-1/sqrt(fan_in)."""


class MLP(nn.Module):
    """A multilayer perceptron: dense layers, each followed by the activation but the last one, if ``outputs`` is given."""

    hidden: Sequence[int]
    activation: str
    kernel_init: Callable[..., Array]
    outputs: int | None = None
    output_init: Callable[..., Array] | None = None
    layer_norm: bool = False
    """Normalise each hidden layer before its activation (Ba et al. 2016, arXiv:1607.06450)."""

    @nn.compact
    def __call__(self, x: Float[Array, "*B F"]) -> Float[Array, "*B G"]:
        """Features to features, or to ``outputs`` numbers."""
        for width in self.hidden:
            x = dense(width, self.kernel_init)(x)
            x = ACTIVATIONS[self.activation](nn.LayerNorm()(x) if self.layer_norm else x)
            self.sow(SHOWN, self.activation, x)
        if self.outputs is None:
            return x
        return dense(self.outputs, self.output_init or self.kernel_init)(x)


class Torso(nn.Module):
    """Features of an observation: images through a CNN, everything else flattened, then the hidden layers."""

    space: gymnasium.Space
    hidden: Sequence[int]
    activation: str
    kernel_init: Callable[..., Array]
    layer_norm: bool = False
    cnn: str = "nature"
    """Which convolutions: see ``cnn.py``."""

    @nn.compact
    def __call__(self, obs: Observation) -> Float[Array, "B G"]:
        """Observation ``[B, ...]`` to features ``[B, G]``."""
        seen = without_position(self.space)
        space, obs = without_mask(seen), observed(seen, obs)
        # A game's board has the form of an image, but is small, and every square of it counts.
        if not is_image(self.space):
            return MLP(self.hidden, self.activation, self.kernel_init, layer_norm=self.layer_norm)(flatten_observation(space, obs))
        # A trailing axis turns a grey image [B, H, W] into [B, H, W, 1].
        image = obs if obs.ndim == 4 else obs[..., None]
        if is_channels_first(space):
            image = jnp.moveaxis(image, 1, -1)
        scaled = image.astype(jnp.float32) / (255.0 if image.dtype == jnp.uint8 else 1.0)
        if self.cnn == "none":
            return MLP(self.hidden, self.activation, self.kernel_init, layer_norm=self.layer_norm)(scaled.reshape(scaled.shape[0], -1))
        return CNN(self.hidden or (128,), self.kernel_init, self.layer_norm, self.cnn)(scaled)


def example_observation(space: gymnasium.Space) -> Observation:
    """Zeros shaped as a batch of one observation, in the dtypes that reach a network."""
    return jax.tree.map(lambda x: jnp.zeros((1, *np.shape(x)), jax.dtypes.canonicalize_dtype(np.asarray(x).dtype)), space.sample())


def is_image(space: gymnasium.Space) -> bool:
    """Whether observations are images: a Box of uint8 ``[H, W]`` or ``[H, W, C]``, or of floats with a small channel axis."""
    space = without_mask(space)
    if not isinstance(space, gymnasium.spaces.Box):
        return False
    return len(space.shape) == 3 or (len(space.shape) == 2 and space.dtype == np.uint8)


def is_channels_first(space: gymnasium.Space) -> bool:
    """Whether an image is stored as channels, height, width: few in front of a larger picture, as in Gymnasium's stacks of frames."""
    shape = space.shape or ()
    return len(shape) == 3 and shape[0] <= 16 < min(shape[1:])


def flatten_observation(space: gymnasium.Space, obs: Observation) -> Float[Array, "*B F"]:
    """One row of floats per observation: Discrete parts one-hot, Box parts raveled, Dict and Tuple parts side by side.

    Raises ``UserError`` for a space it does not know.
    """
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        leading = obs.shape[: obs.ndim - len(space.shape)]
        return obs.reshape((*leading, -1)).astype(jnp.float32)
    if isinstance(space, spaces.Discrete):
        return jax.nn.one_hot(obs - int(space.start), int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        sizes, starts = space.nvec.ravel().tolist(), space.start.ravel().tolist()
        flat = obs.reshape((*obs.shape[: obs.ndim - space.nvec.ndim], -1))
        parts = [jax.nn.one_hot(flat[..., i] - start, n) for i, (n, start) in enumerate(zip(sizes, starts, strict=True))]
        return jnp.concatenate(parts, axis=-1)
    if isinstance(space, spaces.Dict):
        # Sorted, because a space read back from a policy's file is: the features must not move.
        return jnp.concatenate([flatten_observation(part, obs[name]) for name, part in sorted(space.spaces.items())], axis=-1)
    if isinstance(space, spaces.Tuple):
        return jnp.concatenate([flatten_observation(part, obs[i]) for i, part in enumerate(space.spaces)], axis=-1)
    raise UserError(
        f"observations may be Box, Discrete, MultiDiscrete, MultiBinary, or a Dict or Tuple of these; this environment has {space}"
    )
