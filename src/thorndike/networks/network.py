"""What a network is to the rest of the library: two pure functions. A user's own network is any such pair."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from jaxtyping import Array, Key, PyTree

from thorndike.types import EnvSpec, Observation


class Network(NamedTuple):
    """A function of the observation with parameters."""

    init: Callable[[Key[Array, ""], Observation], PyTree]
    """key, an example observation ``[B, ...]`` -> parameters. Consumes the key."""
    apply: Callable[[PyTree, Observation], PyTree]
    """parameters, observation ``[B, ...]`` -> outputs: ``[B, A]`` for Q-values, ``([B, P], [B])`` for a policy and a value."""


NetworkBuilder: TypeAlias = Callable[[EnvSpec, int], Network]
"""spec, number of outputs -> Network: the form in which a user's own network is given."""
