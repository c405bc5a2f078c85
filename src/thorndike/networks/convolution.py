"""A convolution that is quick where XLA's own is not: in compiled loops on a CPU.

There it is one matrix product over patches, in both directions. A kernel that its stride divides (8 by 4, 4 by 2) first turns blocks of
pixels into channels, so that few and large pieces are moved. On an accelerator it is XLA's. Parameters are those of ``nn.Conv``.

Mnih et al.'s network with a batch of 256 in such a loop, with its gradient: 257 ms of one core; XLA's convolutions take 4,256 ms, theirs
forward with patches backward 354 ms. Forward alone they are about equal: 158, 132 and 128 ms (``benchmarks/convolutions.py``).
"""

from collections.abc import Callable
from functools import reduce

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

ROWS_AT_ONCE = 512
"""Images whose patches are in memory at once."""


class Convolution(nn.Module):
    """A square convolution; without padding, or with as much as keeps an image's size at stride 1."""

    channels: int
    size: int
    stride: int
    kernel_init: Callable[..., Array]
    same: bool = False

    @nn.compact
    def __call__(self, image: Float[Array, "B H W C"]) -> Float[Array, "B H2 W2 D"]:
        """Image to ``channels`` numbers at every place."""
        kernel = self.param("kernel", self.kernel_init, (self.size, self.size, image.shape[3], self.channels))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.channels,))
        edge = self.size // 2 if self.same else 0
        padded = jnp.pad(image, ((0, 0), (edge, edge), (edge, edge), (0, 0))) if edge else image
        return convolve(padded, kernel, self.stride) + bias.reshape(1, 1, 1, -1)


def convolve(image: Float[Array, "B H W C"], kernel: Float[Array, "k k C D"], stride: int) -> Float[Array, "B H2 W2 D"]:
    """The convolution without padding."""
    if jax.default_backend() != "cpu":
        return jax.lax.conv_general_dilated(image, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    if image.shape[0] <= ROWS_AT_ONCE:
        return by_patches(image, kernel, stride)
    return jax.lax.map(lambda one: by_patches(one[None], kernel, stride)[0], image, batch_size=ROWS_AT_ONCE)


def by_patches(image: Float[Array, "B H W C"], kernel: Float[Array, "k k C D"], stride: int) -> Float[Array, "B H2 W2 D"]:
    """The same as one matrix product."""
    batch, height, width, depth = image.shape
    size, outputs = kernel.shape[0], kernel.shape[3]
    rows, columns = (height - size) // stride + 1, (width - size) // stride + 1
    if stride > 1 and size % stride == 0:
        blocks = size // stride
        tall, wide = rows + blocks - 1, columns + blocks - 1
        image = image[:, : tall * stride, : wide * stride].reshape(batch, tall, stride, wide, stride, depth)
        image = image.transpose(0, 1, 3, 2, 4, 5).reshape(batch, tall, wide, -1)
        kernel = kernel.reshape(blocks, stride, blocks, stride, depth, outputs).transpose(0, 2, 1, 3, 4, 5)
        size, stride = blocks, 1
    patches = jnp.concatenate(shifted(image, size, stride, rows, columns), axis=-1)
    return (patches.reshape(batch * rows * columns, -1) @ kernel.reshape(-1, outputs)).reshape(batch, rows, columns, outputs)


def max_pool(image: Float[Array, "B H W C"]) -> Float[Array, "B H2 W2 C"]:
    """The largest of 3 x 3 places at every second one, at the edge of those that there are.

    As a chain of maxima: the gradient of XLA's windows is slow on a CPU.
    """
    height, width = image.shape[1:3]
    rows, columns = -(-height // 2), -(-width // 2)
    # As TensorFlow's SAME: an odd number of missing pixels is one more at the end.
    edges = [
        ((missing := max((count - 1) * 2 + 3 - length, 0)) // 2, missing - missing // 2)
        for count, length in ((rows, height), (columns, width))
    ]
    padded = jnp.pad(image, ((0, 0), *edges, (0, 0)), constant_values=-jnp.inf)
    return reduce(jnp.maximum, shifted(padded, 3, 2, rows, columns))


def shifted(image: Float[Array, "B H W C"], size: int, stride: int, rows: int, columns: int) -> list[Float[Array, "B H2 W2 C"]]:
    """What each place of a window sees."""
    reach = [(count - 1) * stride + 1 for count in (rows, columns)]
    return [image[:, i : i + reach[0] : stride, j : j + reach[1] : stride] for i in range(size) for j in range(size)]
