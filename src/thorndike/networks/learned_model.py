"""A model of an environment that is learnt from what it is good for: values, rewards and policies, not observations.

Schrittwieser et al. 2020, MuZero (arXiv:1911.08265): ``represent`` is their h, ``follow`` their g, ``judge`` their f. A state is a row of
numbers, stretched to [0, 1] (appendix G).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from thorndike.functional.unrolled_targets import scaled_gradient
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import SHOWN, hidden_layers
from thorndike.networks.network import Network
from thorndike.networks.torso import Torso
from thorndike.types import Observation

_hidden_init = nn.initializers.he_normal()
_small_init = nn.initializers.variance_scaling(0.01, "fan_in", "normal")


class Judgement(NamedTuple):
    """What the model says of states ``[B]``."""

    policy: Float[Array, "*B actions"]
    """Logits."""
    value: Float[Array, "*B atoms"]
    """Logits of ``Scale``."""
    reward: Float[Array, "*B atoms"]
    """Of the step that led here; means nothing of a state that was observed."""


class ModelShape(NamedTuple):
    """The size of a model."""

    net_arch: Sequence[int]
    """Hidden layers from the observation to a state."""
    cnn: str
    state_size: int
    width: int
    """Of the one hidden layer in each other part."""


class LearnedModel(nn.Module):
    """All three functions, a method each."""

    space: gymnasium.Space
    actions: int
    atoms: int
    shape: ModelShape

    def setup(self) -> None:
        """The layers."""
        shape = self.shape
        self.torso = Torso(self.space, shape.net_arch, "relu", _hidden_init, cnn=shape.cnn)
        self.state = dense(shape.state_size, _hidden_init)
        self.follow_hidden, self.follow_state = dense(shape.width, _hidden_init), dense(shape.state_size, _hidden_init)
        self.hidden = [dense(shape.width, _hidden_init, name=f"{name}_hidden") for name in Judgement._fields]
        self.heads = [
            dense(size, _small_init, name=name)
            for name, size in zip(Judgement._fields, (self.actions, self.atoms, self.atoms), strict=True)
        ]

    def __call__(self, obs: Observation) -> tuple[Float[Array, "B H"], Judgement]:
        """Everything once: observations and what becomes of them by action 0."""
        state = self.follow(self.represent(obs), jnp.zeros(jax.tree.leaves(obs)[0].shape[:1], jnp.int32))
        return state, self.judge(state)

    def represent(self, obs: Observation) -> Float[Array, "B H"]:
        """Observations to states."""
        return stretched(self.state(self.torso(obs)))

    def follow(self, state: Float[Array, "B H"], action: Int[Array, " B"]) -> Float[Array, "B H"]:
        """States and actions to the states that they lead to."""
        moved = jnp.concatenate([state, jax.nn.one_hot(action, self.actions)], axis=-1)
        return stretched(state + self.follow_state(self._shown(self.follow_hidden(moved))))

    def judge(self, state: Float[Array, "*B H"]) -> Judgement:
        """States to what is thought of them."""
        return Judgement(*(head(self._shown(hidden(state))) for hidden, head in zip(self.hidden, self.heads, strict=True)))

    def _shown(self, x: Float[Array, "*B F"]) -> Float[Array, "*B F"]:
        activated = nn.relu(x)
        self.sow(SHOWN, "relu", activated)
        return activated


def stretched(state: Float[Array, "*B H"]) -> Float[Array, "*B H"]:
    """Each state's numbers between 0 and 1, as one-hot actions are."""
    low, high = jnp.min(state, axis=-1, keepdims=True), jnp.max(state, axis=-1, keepdims=True)
    return (state - low) / (high - low + 1e-5)


class Model(NamedTuple):
    """The model as pure functions of parameters."""

    network: Network
    """Observation -> state and judgement after action 0: for parameters, and to look into the layers."""
    represent: Callable[[PyTree, Observation], Float[Array, "B H"]]
    follow: Callable[[PyTree, Float[Array, "B H"], Int[Array, " B"]], Float[Array, "B H"]]
    judge: Callable[[PyTree, Float[Array, "*B H"]], Judgement]


def learned_model(space: gymnasium.Space, actions: int, atoms: int, shape: ModelShape) -> Model:
    """A model of an environment with these observations and so many actions."""
    module = LearnedModel(space, actions, atoms, shape)
    network = Network(
        init=lambda key, obs: module.init(key, obs)["params"],
        apply=lambda params, obs: module.apply({"params": params}, obs),
        layers=hidden_layers(module),
    )

    def part(method: Callable) -> Callable:
        return lambda params, *inputs: module.apply({"params": params}, *inputs, method=method)

    return Model(network, part(LearnedModel.represent), part(LearnedModel.follow), part(LearnedModel.judge))


def unroll(model: Model, params: PyTree, obs: Observation, actions: Int[Array, "K M"]) -> Judgement:
    """What the model says of observations ``[M, ...]`` and of the states after each of K actions: ``[K + 1, M, ...]``.

    Gradients are halved at each step (appendix G of the paper).
    """

    def follow(state: Float[Array, "M H"], action: Int[Array, " M"]) -> tuple[Float[Array, "M H"], Float[Array, "M H"]]:
        after = scaled_gradient(model.follow(params, state, action), 0.5)
        return after, after

    first = model.represent(params, obs)
    _, later = jax.lax.scan(follow, first, actions, unroll=True)
    return model.judge(params, jnp.concatenate([first[None], later]))
