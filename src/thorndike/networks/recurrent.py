"""Networks with memory: a torso, a recurrent cell, a head. The memory starts at zero with every episode.

GRU: Cho et al. 2014 (arXiv:1406.1078), with the reset gate after the recurrent product, as in cuDNN. LSTM: Hochreiter and Schmidhuber
1997, with the forget gate of Gers et al. 2000. In an unrolled sequence only what depends on the memory runs step by step, one matrix
product; torso, head and the cell's product with its input see all steps as one batch (measured, with its gradient: 1.9x to 2.5x).
"""

from collections.abc import Callable, Sequence

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from thorndike.networks.hidden_layers import hidden_layers
from thorndike.networks.network import Network, Recurrence, as_rows
from thorndike.networks.torso import Torso
from thorndike.types import Observation

MEMORIES = ("none", "gru", "lstm")
"""The choices of a ``memory`` setting."""


def orthogonal_gates(key: Key[Array, ""], shape: tuple[int, int], dtype: type = jnp.float32) -> Float[Array, "H G"]:
    """An orthogonal matrix for each gate, side by side: ``[H, gates * H]``. Consumes the key."""
    size, gates = shape[0], shape[1] // shape[0]
    each = jax.vmap(lambda key: nn.initializers.orthogonal()(key, (size, size), dtype))(jax.random.split(key, gates))
    return jnp.moveaxis(each, 0, 1).reshape(shape)


class GRU(nn.Module):
    """A gated recurrent unit in two halves: ``project`` is its product with the input, ``__call__`` the rest."""

    size: int

    def setup(self) -> None:
        """One product with the input, one with the memory."""
        self.input = nn.Dense(3 * self.size, kernel_init=nn.initializers.lecun_normal())
        self.memory = nn.Dense(3 * self.size, kernel_init=orthogonal_gates)

    def project(self, features: Float[Array, "N F"]) -> Float[Array, "N G"]:
        """What the input adds to the gates."""
        return self.input(features)

    def __call__(self, memory: Float[Array, "B H"], projected: Float[Array, "B G"]) -> tuple[Float[Array, "B H"], Float[Array, "B H"]]:
        """One step: memory, output, which are the same."""
        reset_in, update_in, new_in = jnp.split(projected, 3, axis=-1)
        reset_of, update_of, new_of = jnp.split(self.memory(memory), 3, axis=-1)
        update = nn.sigmoid(update_in + update_of)
        new = jnp.tanh(new_in + nn.sigmoid(reset_in + reset_of) * new_of)
        memory = new + update * (memory - new)
        return memory, memory


class LSTM(nn.Module):
    """A long short-term memory in the same two halves; its memory is the pair of cell and output."""

    size: int

    def setup(self) -> None:
        """One product with the input, one with the last output."""
        self.input = nn.Dense(4 * self.size, kernel_init=nn.initializers.lecun_normal())
        self.memory = nn.Dense(4 * self.size, kernel_init=orthogonal_gates)

    def project(self, features: Float[Array, "N F"]) -> Float[Array, "N G"]:
        """What the input adds to the gates."""
        return self.input(features)

    def __call__(self, memory: tuple[Array, Array], projected: Float[Array, "B G"]) -> tuple[tuple[Array, Array], Float[Array, "B H"]]:
        """One step: memory, output."""
        cell, output = memory
        into, forget, new, out = jnp.split(projected + self.memory(output), 4, axis=-1)
        cell = nn.sigmoid(forget) * cell + nn.sigmoid(into) * jnp.tanh(new)
        output = nn.sigmoid(out) * jnp.tanh(cell)
        return (cell, output), output


CELLS: dict[str, Callable[..., nn.Module]] = {"gru": GRU, "lstm": LSTM}


class Remembering(nn.Module):
    """Torso, cell and head as one module with a method each."""

    space: gymnasium.Space
    hidden: Sequence[int]
    activation: str
    kernel_init: Callable[..., Array]
    cell: str
    size: int
    head: nn.Module
    cnn: str = "nature"

    def setup(self) -> None:
        """The parts that are shared by the methods."""
        self.torso = Torso(self.space, self.hidden, self.activation, self.kernel_init, cnn=self.cnn)
        self.recurrent = CELLS[self.cell](self.size)

    def __call__(self, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
        """One step: memory, outputs."""
        memory, output = self.remember(memory, self.encode(obs))
        return memory, self.decode(output)

    def encode(self, obs: Observation) -> Float[Array, "N G"]:
        """Observations to what they add to the cell's gates."""
        return self.recurrent.project(self.torso(obs))

    def remember(self, memory: PyTree, projected: Float[Array, "B G"]) -> tuple[PyTree, Float[Array, "B H"]]:
        """What the cell makes of that and its memory."""
        return self.recurrent(memory, projected)

    def decode(self, output: Float[Array, "N H"]) -> PyTree:
        """The cell's output to the network's."""
        return self.head(output)


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
        projected = call(params, module.encode, as_rows(obs)).reshape((length, batch, -1))

        def one(memory: PyTree, row: tuple[Array, Array]) -> tuple[PyTree, tuple[PyTree, Array]]:
            projected, begins = row
            memory = jax.tree.map(lambda new, old: jnp.where(begins[:, None], new, old), zeros, memory)
            memory, out = call(params, module.remember, memory, projected)
            return memory, (memory, out)

        _, (memories, out) = jax.lax.scan(one, memory, (projected, begins))
        outputs = call(params, module.decode, as_rows(out))
        return memories, jax.tree.map(lambda x: x.reshape((length, batch, *x.shape[1:])), outputs)

    def apply(params: PyTree, obs: Observation) -> PyTree:
        return step(params, fresh(jax.tree.leaves(obs)[0].shape[0]), obs)[1]

    return Network(init, apply, Recurrence(fresh, step, unroll), hidden_layers(module, module.encode))


def side_by_side(first: Network, second: Network) -> Network:
    """Two networks with memory as one: both outputs, a memory each."""
    one, other = first.recurrence, second.recurrence
    if one is None or other is None:
        raise ValueError("side_by_side joins two networks with memory")

    def init(key: Key[Array, ""], obs: Observation) -> PyTree:
        keys = jax.random.split(key)
        return first.init(keys[0], obs), second.init(keys[1], obs)

    def apply(params: PyTree, obs: Observation) -> PyTree:
        return first.apply(params[0], obs), second.apply(params[1], obs)

    def step(params: PyTree, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
        both = one.step(params[0], memory[0], obs), other.step(params[1], memory[1], obs)
        return both[0][:1] + both[1][:1], both[0][1:] + both[1][1:]

    def unroll(params: PyTree, memory: PyTree, obs: Observation, begins: Bool[Array, "T B"]) -> tuple[PyTree, PyTree]:
        both = one.unroll(params[0], memory[0], obs, begins), other.unroll(params[1], memory[1], obs, begins)
        return both[0][:1] + both[1][:1], both[0][1:] + both[1][1:]

    def layers(params: PyTree, obs: Observation) -> PyTree:
        return {str(i): look(params[i], obs) for i, look in enumerate((first.layers, second.layers)) if look is not None}

    return Network(init, apply, Recurrence(lambda batch: (one.fresh(batch), other.fresh(batch)), step, unroll), layers)
