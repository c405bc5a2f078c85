"""Networks with memory: a torso, a recurrent cell, a head. The memory starts at zero with every episode.

GRU: Cho et al. 2014 (arXiv:1406.1078). LSTM: Hochreiter and Schmidhuber 1997. In an unrolled sequence only the cell runs step by step;
torso and head see all steps as one batch.
"""

from collections.abc import Callable, Sequence

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from thorndike.networks.network import Network, Recurrence, as_rows
from thorndike.networks.torso import Torso
from thorndike.types import Observation

CELLS: dict[str, Callable[..., nn.Module]] = {"gru": nn.GRUCell, "lstm": nn.OptimizedLSTMCell}
MEMORIES = ("none", "gru", "lstm")
"""The choices of a ``memory`` setting."""


class Remembering(nn.Module):
    """Torso, cell and head as one module with a method each."""

    space: gymnasium.Space
    hidden: Sequence[int]
    activation: str
    kernel_init: Callable[..., Array]
    cell: str
    size: int
    head: nn.Module

    def setup(self) -> None:
        """The parts that are shared by the methods."""
        self.torso = Torso(self.space, self.hidden, self.activation, self.kernel_init)
        self.recurrent = CELLS[self.cell](self.size)

    def __call__(self, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
        """One step: memory, outputs."""
        memory, features = self.remember(memory, self.encode(obs))
        return memory, self.decode(features)

    def encode(self, obs: Observation) -> Float[Array, "N F"]:
        """Observations to features."""
        return self.torso(obs)

    def remember(self, memory: PyTree, features: Float[Array, "B F"]) -> tuple[PyTree, Float[Array, "B H"]]:
        """Features to what the cell makes of them and its memory."""
        return self.recurrent(memory, features)

    def decode(self, features: Float[Array, "N H"]) -> PyTree:
        """The cell's features to outputs."""
        return self.head(features)


def remembering(module: Remembering) -> Network:
    """The module as a ``Network``."""

    def fresh(batch: int) -> PyTree:
        zeros = jnp.zeros((batch, module.size), jnp.float32)
        return zeros if module.cell == "gru" else (zeros, jnp.zeros_like(zeros))

    def init(key: Key[Array, ""], obs: Observation) -> PyTree:
        return module.init(key, fresh(jax.tree.leaves(obs)[0].shape[0]), obs)["params"]

    def call(params: PyTree, method: Callable, *inputs: PyTree) -> PyTree:
        return module.apply({"params": params}, *inputs, method=method)

    def step(params: PyTree, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
        return call(params, module.__call__, memory, obs)

    def unroll(params: PyTree, memory: PyTree, obs: Observation, begins: Bool[Array, "T B"]) -> tuple[PyTree, PyTree]:
        length, batch = begins.shape
        zeros = fresh(batch)
        features = call(params, module.encode, as_rows(obs)).reshape((length, batch, -1))

        def one(memory: PyTree, row: tuple[Array, Array]) -> tuple[PyTree, tuple[PyTree, Array]]:
            features, begins = row
            memory = jax.tree.map(lambda new, old: jnp.where(begins[:, None], new, old), zeros, memory)
            memory, out = call(params, module.remember, memory, features)
            return memory, (memory, out)

        _, (memories, out) = jax.lax.scan(one, memory, (features, begins))
        outputs = call(params, module.decode, as_rows(out))
        return memories, jax.tree.map(lambda x: x.reshape((length, batch, *x.shape[1:])), outputs)

    def apply(params: PyTree, obs: Observation) -> PyTree:
        return step(params, fresh(jax.tree.leaves(obs)[0].shape[0]), obs)[1]

    return Network(init, apply, Recurrence(fresh, step, unroll))
