"""The body of a network: from an observation of any space to features, by a multilayer perceptron or, for images, convolutions first."""

from collections.abc import Callable, Sequence

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.errors import UserError
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN
from thorndike.networks.masking import observed, without_mask
from thorndike.types import Observation

LARGE_IMAGE = 36
"""Pixels of the shorter side from which Mnih et al.'s three convolutions fit."""

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


class SmallConvolution(nn.Module):
    """A 3 x 3 convolution without padding, with the parameters of ``nn.Conv``, as one matrix product over patches.

    In a compiled loop on a CPU, XLA's own convolution takes 1.4 s for the gradient of 2,048 MinAtar boards, this 0.06 s, and 2.1 ms and
    0.8 ms for 32 (one core, the dense layer of 128 included).
    """

    channels: int
    kernel_init: Callable[..., Array]

    @nn.compact
    def __call__(self, image: Float[Array, "B H W C"]) -> Float[Array, "B H2 W2 D"]:
        """Image to ``channels`` numbers at every place but the border."""
        size, height, width, depth = 3, image.shape[1] - 2, image.shape[2] - 2, image.shape[3]
        kernel = self.param("kernel", self.kernel_init, (size, size, depth, self.channels))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.channels,))
        shifted = [image[:, i : i + height, j : j + width] for i in range(size) for j in range(size)]
        patches = jnp.concatenate(shifted, axis=-1).reshape(-1, size * size * depth)
        found = patches @ kernel.reshape(size * size * depth, self.channels) + bias[None]
        return found.reshape(image.shape[0], height, width, self.channels)


class CNN(nn.Module):
    """Convolutions over an image ``[B, H, W, C]`` (NHWC), then dense layers, with ReLU after each.

    Large images (36 pixels and more) get the three layers of Mnih et al. 2015, small ones the 3 x 3 layer with 16 channels of Young and
    Tian 2019 (arXiv:1903.03176), who put a dense layer of 128 after it.
    """

    hidden: Sequence[int]
    kernel_init: Callable[..., Array]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, image: Float[Array, "B H W C"]) -> Float[Array, "B F"]:
        """Images in [0, 1] to features."""
        x = image
        if min(image.shape[1:3]) < LARGE_IMAGE:
            # The name keeps the parameters where nn.Conv would have them.
            x = self._activated(SmallConvolution(16, self.kernel_init, name="Conv_0")(x))
        else:
            for channels, size, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
                convolution = nn.Conv(channels, (size, size), (stride, stride), padding="VALID", kernel_init=self.kernel_init)
                x = self._activated(convolution(x))
        x = x.reshape((x.shape[0], -1))
        for width in self.hidden:
            x = self._activated(dense(width, self.kernel_init)(x))
        return x

    def _activated(self, x: Float[Array, "*B F"]) -> Float[Array, "*B F"]:
        x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        self.sow(SHOWN, "relu", x)
        return x


class Torso(nn.Module):
    """Features of an observation: images through a CNN, everything else flattened, then the hidden layers."""

    space: gymnasium.Space
    hidden: Sequence[int]
    activation: str
    kernel_init: Callable[..., Array]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, obs: Observation) -> Float[Array, "B G"]:
        """Observation ``[B, ...]`` to features ``[B, G]``."""
        space, obs = without_mask(self.space), observed(self.space, obs)
        if not is_image(space):
            return MLP(self.hidden, self.activation, self.kernel_init, layer_norm=self.layer_norm)(flatten_observation(space, obs))
        # A trailing axis turns a grey image [B, H, W] into [B, H, W, 1].
        image = obs if obs.ndim == 4 else obs[..., None]
        scaled = image.astype(jnp.float32) / (255.0 if image.dtype == jnp.uint8 else 1.0)
        return CNN(self.hidden or (128,), self.kernel_init, self.layer_norm)(scaled)


def example_observation(space: gymnasium.Space) -> Observation:
    """Zeros shaped as a batch of one observation, in the dtypes that reach a network."""
    return jax.tree.map(lambda x: jnp.zeros((1, *np.shape(x)), jax.dtypes.canonicalize_dtype(np.asarray(x).dtype)), space.sample())


def is_image(space: gymnasium.Space) -> bool:
    """Whether observations are images: a Box of uint8 ``[H, W]`` or ``[H, W, C]``, or of floats with a small channel axis."""
    space = without_mask(space)
    if not isinstance(space, gymnasium.spaces.Box):
        return False
    return len(space.shape) == 3 or (len(space.shape) == 2 and space.dtype == np.uint8)


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
