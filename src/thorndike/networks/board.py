"""Networks for boards: a residual tower of dense layers or of convolutions, with a policy and a value.

On a CPU dense layers give some ten times the positions a second of a convolution tower of the same use on a small board; ``patches`` first
looks at every square block of the board with the same weights, as a convolution does, which a line of pieces looks alike in everywhere.
``squares`` is for games whose moves are numbered square by square as the board is shown (Go, and chess here): convolutions, told what is
true of the whole board, and every square says by the same weights what its moves are worth.
"""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.networks.convolution import Convolution
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN, hidden_layers
from thorndike.networks.network import Network

TOWERS = ("mlp", "patches", "conv", "squares")

_hidden_init = nn.initializers.he_normal()
_small_init = nn.initializers.variance_scaling(0.01, "fan_in", "normal")


class BoardNetwork(nn.Module):
    """Logits of the moves and the logit of winning, from a board ``[B, H, W, C]``."""

    actions: int
    tower: str
    width: int
    """Units of a dense layer, channels of a convolution."""
    blocks: int
    patch_size: int = 4
    patch_channels: int = 64

    @nn.compact
    def __call__(self, board: Float[Array, "B H W C"]) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        """Board to a policy and a value."""
        if self.tower == "squares":
            return self._by_squares(board)
        x = self._convolutions(board) if self.tower == "conv" else self._dense_layers(board)
        value = self._shown(dense(64, _hidden_init, name="value_hidden")(x))
        return dense(self.actions, _small_init, name="policy")(x), dense(1, _small_init, name="value")(value)[..., 0]

    def _shown(self, x: Float[Array, "*B F"]) -> Float[Array, "*B F"]:
        activated = nn.relu(x)
        self.sow(SHOWN, "relu", activated)
        return activated

    def _dense_layers(self, board: Float[Array, "B H W C"]) -> Float[Array, "B F"]:
        flat = board.reshape((board.shape[0], -1))
        if self.tower == "patches":
            size = min(self.patch_size, *board.shape[1:3])
            seen = self._shown(Convolution(self.patch_channels, size, 1, _hidden_init, name="patches")(board))
            flat = jnp.concatenate([flat, seen.reshape((board.shape[0], -1))], axis=-1)
        x = dense(self.width, _hidden_init, name="first")(flat)
        for block in range(self.blocks):
            inner = self._shown(dense(self.width, _hidden_init, name=f"block_{block}_a")(self._shown(x)))
            x = x + dense(self.width, _small_init, name=f"block_{block}_b")(inner)
        return self._shown(x)

    def _convolutions(self, board: Float[Array, "B H W C"]) -> Float[Array, "B F"]:
        def convolution(name: str, init: Callable[..., Array]) -> Convolution:
            return Convolution(self.width, 3, 1, init, same=True, name=name)

        x = convolution("first", _hidden_init)(board)
        for block in range(self.blocks):
            inner = self._shown(convolution(f"block_{block}_a", _hidden_init)(self._shown(x)))
            x = x + convolution(f"block_{block}_b", _small_init)(inner)
        return self._shown(dense(self.width, _hidden_init, name="last")(self._shown(x).reshape((board.shape[0], -1))))

    def _by_squares(self, board: Float[Array, "B H W C"]) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        """Convolutions, then each square's moves by the same weights; what is left of the moves, and the value, by the whole board."""

        def convolution(name: str, init: Callable[..., Array], channels: int = self.width, size: int = 3) -> Convolution:
            return Convolution(channels, size, 1, init, same=True, name=name)

        x = convolution("first", _hidden_init)(board)
        for block in range(self.blocks):
            inner = convolution(f"block_{block}_a", _hidden_init)(self._shown(x))
            # What is true of the whole board is told to every square, as KataGo does.
            whole = dense(self.width, _small_init, name=f"block_{block}_whole")(self._pooled(inner))
            x = x + convolution(f"block_{block}_b", _small_init)(self._shown(inner + whole[:, None, None]))
        x = self._shown(x)
        value = self._shown(dense(64, _hidden_init, name="value_hidden")(self._pooled(x)))
        a_square, others = divmod(self.actions, board.shape[1] * board.shape[2])
        policy = [convolution("policy", _small_init, a_square, 1)(x).reshape((board.shape[0], -1))] if a_square else []
        policy += [dense(others, _small_init, name="policy_others")(value)] if others else []
        return jnp.concatenate(policy, axis=-1), dense(1, _small_init, name="value")(value)[..., 0]

    def _pooled(self, x: Float[Array, "B H W C"]) -> Float[Array, "B 2*C"]:
        return jnp.concatenate([jnp.mean(x, axis=(1, 2)), jnp.max(x, axis=(1, 2))], axis=-1)


def board_network(actions: int, tower: str, width: int, blocks: int) -> Network:
    """Parameters, boards ``[B, H, W, C]`` -> logits of the moves, logit of winning."""
    module = BoardNetwork(actions, tower, width, blocks)
    return Network(
        init=lambda key, board: module.init(key, board)["params"],
        apply=lambda params, board: module.apply({"params": params}, board),
        layers=hidden_layers(module),
    )


def win_value(logit: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """From the logit of winning, a draw counted as half, to a value in [-1, 1]."""
    return 2.0 * jax.nn.sigmoid(logit) - 1.0
