"""A misspelt environment, told from the text of installed files: importing Gymnasium to ask it takes longer than all the rest."""

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.algorithms import ALGORITHMS, check_plays
from thorndike.cli.find_run import is_file
from thorndike.environments.host.envpool_ids import pool_ids
from thorndike.environments.native import NATIVE
from thorndike.errors import UserError
from thorndike.games.registry import game_ids, is_game
from thorndike.suggestions import nearest

if TYPE_CHECKING:
    from thorndike.environments.registry import Choice


def check_environment(
    name: str, *, engine: str, env_kwargs: Mapping[str, object], max_episode_steps: int | None, algorithm: str | None = None
) -> None:
    """Raises UserError, with a suggestion, if no engine can run the environment, or the algorithm (if given) does not take its actions.

    JAX is not imported for a name that does not exist.
    """
    # Names such as ALE/Pong-v5 belong to packages that only they lead to.
    asks_a_package = ":" in name or ("/" in name and not name.startswith("probe/"))
    known = None if asks_a_package else _ids_in_the_text()
    if known is not None and name not in known:
        close = nearest(name, known)
        hint = f"did you mean '{close}'?" if close else "give a Gymnasium id, module:Id or path/to/file.py:ClassName"
        raise UserError(f"unknown environment '{name}'; {hint}")
    _check_place(name)
    from thorndike.environments.registry import resolve

    choice = resolve(name, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    if algorithm is not None:
        _check_actions(algorithm, choice)


def _check_place(name: str) -> None:
    """Raises UserError if the file or the package of a user's own environment is not there: seen before Gymnasium is imported."""
    place, colon, _ = name.rpartition(":")
    if place.endswith(".py") and not is_file(Path(place)):
        raise UserError(f"there is no file {place}: give the path of the file that defines the environment's class")
    top = place.partition(".")[0]
    if colon and not place.endswith(".py") and (not top or importlib.util.find_spec(top) is None):
        raise UserError(
            f"cannot import {place or 'nothing'} of {name}: No module named '{top}'; install it, or give path/to/file.py:ClassName"
        )


def _check_actions(algorithm: str, choice: "Choice") -> None:
    """Raises UserError if the algorithm does not take the environment's actions. Asked of Gymnasium's, which needs no JAX."""
    fitting, name = ALGORITHMS[algorithm].actions, choice.id
    if ALGORITHMS[algorithm].only_games or is_game(name):
        check_plays(algorithm, name, is_game(name) and ALGORITHMS[algorithm].plays)
        return
    # All MinAtar games have Discrete actions; to ask their package would import Matplotlib and pandas.
    if not fitting or (name.startswith("MinAtar/") and "Discrete" in fitting and algorithm != "planning"):
        return
    from thorndike.environments.origins import is_known_id, make_single

    if ":" not in name and not is_known_id(name):
        return
    environment = make_single(name, choice.env_kwargs)
    actions, has_table = environment.action_space, hasattr(environment.unwrapped, "P") or name == "Blackjack-v1"
    environment.close()
    kind = type(actions).__name__
    if kind not in fitting:
        others = ", ".join(other for other, entry in ALGORITHMS.items() if not entry.actions or kind in entry.actions)
        raise UserError(f"{algorithm} takes {' and '.join(fitting)} actions, but {name} has {actions}; those that take it: {others}")
    if algorithm == "planning" and not has_table:
        raise UserError(f"{name} cannot be planned on: it lacks a transition table (unwrapped.P); train a learner on it: q_learning")


def _ids_in_the_text() -> frozenset[str] | None:
    """Every plain id there is, or None where the text does not tell. Since version 1 Gymnasium loads no plugins when it starts."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        return None
    package = Path(spec.origin).parent
    own = re.findall(r'^\s*id="([^"]+)"', (package / "envs" / "__init__.py").read_text(encoding="utf-8"), re.MULTILINE)
    return frozenset(own) | set(NATIVE) | set(game_ids()) | pool_ids() if own else None
