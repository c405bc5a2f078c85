"""From a name and settings to an algorithm."""

import importlib
from collections.abc import Callable, Mapping

from thorndike.algorithms import ALGORITHMS
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean
from thorndike.types import Algorithm, EnvSpec

_WITH_NETWORK = ("ppo", "dqn")


def check_algorithm(algorithm: str) -> None:
    """Raises ``UserError``, with a suggestion, if there is no such algorithm."""
    if algorithm not in ALGORITHMS:
        raise UserError(f"there is no algorithm '{algorithm}'{did_you_mean(algorithm, ALGORITHMS)}")


def config_class(algorithm: str) -> Callable:
    """The ``Config`` of an algorithm."""
    return importlib.import_module(ALGORITHMS[algorithm].module).Config


def build_algorithm(name: str, config: Mapping[str, object], spec: EnvSpec, network: Callable | None) -> Algorithm:
    """The algorithm ``name`` for an environment, from its settings. Raises ``UserError`` if they do not fit."""
    factory = getattr(importlib.import_module(ALGORITHMS[name].module), name)
    settings = config_class(name)(**{key: tuple(value) if isinstance(value, list) else value for key, value in config.items()})
    if network is None:
        return factory(settings, spec)
    if name not in _WITH_NETWORK:
        raise UserError(f"{name} has no network, so it takes none; {' and '.join(_WITH_NETWORK)} do")
    return factory(settings, spec, network)
