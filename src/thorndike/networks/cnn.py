"""Networks for images ``[B, H, W, C]`` (NHWC): convolutions, then dense layers."""

from collections.abc import Callable, Sequence

import flax.linen as nn
from jaxtyping import Array, Float

from thorndike.networks.convolution import Convolution, max_pool
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN

CNNS = ("nature", "impala", "none")
"""The choices of a ``cnn`` setting. ``none``: pixels go straight to the dense layers, where convolutions cost more than they find."""

LARGE_IMAGE = 36
"""Pixels of the shorter side from which Mnih et al.'s three convolutions fit."""


class CNN(nn.Module):
    """Convolutions over an image, then dense layers, with ReLU after each.

    ``nature``: the three layers of Mnih et al. 2015; images under 36 pixels get the 3 x 3 layer with 16 channels of Young and Tian 2019
    (arXiv:1903.03176), who put a dense layer of 128 after it. ``impala``: the residual network of Espeholt et al. 2018
    (arXiv:1802.01561), figure 3, without its LSTM; they put a dense layer of 256 after it.
    """

    hidden: Sequence[int]
    kernel_init: Callable[..., Array]
    layer_norm: bool = False
    kind: str = "nature"

    @nn.compact
    def __call__(self, image: Float[Array, "B H W C"]) -> Float[Array, "B F"]:
        """Images in [0, 1] to features."""
        if self.kind == "impala":
            x = self._residual(image)
        elif min(image.shape[1:3]) < LARGE_IMAGE:
            x = self._activated(self._convolution(0, 16, 3)(image))
        else:
            x = image
            for number, (channels, size, stride) in enumerate(((32, 8, 4), (64, 4, 2), (64, 3, 1))):
                x = self._activated(self._convolution(number, channels, size, stride)(x))
        x = x.reshape((x.shape[0], -1))
        for width in self.hidden:
            x = self._activated(dense(width, self.kernel_init)(x))
        return x

    def _residual(self, x: Float[Array, "B H W C"]) -> Float[Array, "B H2 W2 D"]:
        """Three sections: a convolution, a maximum over 3 x 3, two blocks that add to what they are given."""
        for section, channels in enumerate((16, 32, 32)):
            first = 5 * section
            x = max_pool(self._convolution(first, channels, 3, same=True)(x))
            for block in (first + 1, first + 3):
                inner = self._convolution(block, channels, 3, same=True)(self._activated(x))
                x = x + self._convolution(block + 1, channels, 3, same=True)(self._activated(inner))
        return self._activated(x)

    def _convolution(self, number: int, channels: int, size: int, stride: int = 1, same: bool = False) -> Convolution:
        """A layer whose name keeps its parameters where ``nn.Conv`` would have them."""
        return Convolution(channels, size, stride, self.kernel_init, same, name=f"Conv_{number}")

    def _activated(self, x: Float[Array, "*B F"]) -> Float[Array, "*B F"]:
        x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        self.sow(SHOWN, "relu", x)
        return x
