"""Networks for boards: a residual tower of dense layers or of convolutions, with a policy and a value.

On a CPU dense layers give some ten times the positions a second of a convolution tower of the same use on a small board; ``patches`` first
looks at every square block of the board with the same weights, as a convolution does, which a line of pieces looks alike in everywhere.
``squares`` is for games whose moves are numbered square by square as the board is shown (Go, and chess here): convolutions, told what is
true of the whole board, and every square says by the same weights what its moves are worth.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.networks.convolution import Convolution
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN, hidden_layers
from thorndike.networks.network import Network

TOWERS = ("mlp", "patches", "conv", "squares")
OWNERSHIP, SCORE = "ownership", "score"
"""The heads that a network may have beside policy and value."""

_hidden_init = nn.initializers.he_normal()
_small_init = nn.initializers.variance_scaling(0.01, "fan_in", "normal")


class BoardHeads(NamedTuple):
    """What a network may say of how a game will end, for the player to move. None where it has no such head."""

    ownership: Float[Array, "B H W"] | None
    """The logit of each square to be the mover's, nobody's counted as half."""
    score: Float[Array, " B"] | None
    """How many squares more, divided by the square root of their number."""


Said: TypeAlias = tuple[Float[Array, "B actions"], Float[Array, " B"]] | tuple[Float[Array, "B actions"], Float[Array, " B"], BoardHeads]


class BoardNetwork(nn.Module):
    """Logits of the moves and the logit of winning, from a board ``[B, H, W, C]``; with ``heads`` of these names, what they say too."""

    actions: int
    tower: str
    width: int
    """Units of a dense layer, channels of a convolution."""
    blocks: int
    heads: tuple[str, ...] = ()
    patch_size: int = 4
    patch_channels: int = 64

    @nn.compact
    def __call__(self, board: Float[Array, "B H W C"]) -> Said:
        """Board to a policy and a value."""
        x = squares = self._convolutions(board) if self.tower in ("conv", "squares") else self._dense_layers(board)
        if self.tower == "conv":
            x = self._shown(dense(self.width, _hidden_init, name="last")(squares.reshape((board.shape[0], -1))))
        elif self.tower == "squares":
            x = self._pooled(squares)
        value = self._shown(dense(64, _hidden_init, name="value_hidden")(x))
        policy = self._by_squares(squares, value) if self.tower == "squares" else dense(self.actions, _small_init, name="policy")(x)
        said = policy, dense(1, _small_init, name="value")(value)[..., 0]
        if not self.heads:
            return said
        score = dense(1, _small_init, name="score")(value)[..., 0] if SCORE in self.heads else None
        return *said, BoardHeads(self._ownership(squares, board.shape[:3]) if OWNERSHIP in self.heads else None, score)

    def _ownership(self, squares: Float[Array, "B *F"], shape: tuple[int, ...]) -> Float[Array, "B H W"]:
        """By the same weights at each square, where the tower still knows them apart."""
        if self.tower in ("conv", "squares"):
            return Convolution(1, 1, 1, _small_init, name=OWNERSHIP)(squares)[..., 0]
        return dense(math.prod(shape[1:]), _small_init, name=OWNERSHIP)(squares).reshape(shape)

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

    def _convolutions(self, board: Float[Array, "B H W C"]) -> Float[Array, "B H W F"]:
        def convolution(name: str, init: Callable[..., Array]) -> Convolution:
            return Convolution(self.width, 3, 1, init, same=True, name=name)

        x = convolution("first", _hidden_init)(board)
        for block in range(self.blocks):
            inner = convolution(f"block_{block}_a", _hidden_init)(self._shown(x))
            if self.tower == "squares":
                # What is true of the whole board is told to every square, as in KataGo.
                inner += dense(self.width, _small_init, name=f"block_{block}_whole")(self._pooled(inner))[:, None, None]
            x = x + convolution(f"block_{block}_b", _small_init)(self._shown(inner))
        return self._shown(x)

    def _by_squares(self, squares: Float[Array, "B H W F"], whole: Float[Array, "B W2"]) -> Float[Array, "B actions"]:
        """Each square's moves by the same weights; those that are left by what is known of the whole board."""
        a_square, others = divmod(self.actions, squares.shape[1] * squares.shape[2])
        policy = [Convolution(a_square, 1, 1, _small_init, name="policy")(squares).reshape((squares.shape[0], -1))] if a_square else []
        policy += [dense(others, _small_init, name="policy_others")(whole)] if others else []
        return jnp.concatenate(policy, axis=-1)

    def _pooled(self, x: Float[Array, "B H W C"]) -> Float[Array, "B 2*C"]:
        return jnp.concatenate([jnp.mean(x, axis=(1, 2)), jnp.max(x, axis=(1, 2))], axis=-1)


def board_network(actions: int, tower: str, width: int, blocks: int, heads: tuple[str, ...] = ()) -> Network:
    """Parameters, boards ``[B, H, W, C]`` -> logits of the moves, logit of winning and, with ``heads``, their ``BoardHeads``."""
    module = BoardNetwork(actions, tower, width, blocks, heads)
    return Network(
        init=lambda key, board: module.init(key, board)["params"],
        apply=lambda params, board: module.apply({"params": params}, board),
        layers=hidden_layers(module),
    )


def win_value(logit: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """From the logit of winning, a draw counted as half, to a value in [-1, 1]."""
    return 2.0 * jax.nn.sigmoid(logit) - 1.0
