"""A misspelt environment, told from the text of installed files: importing Gymnasium to ask it takes longer than all the rest."""

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path

from thorndike.environments.host.envpool_ids import pool_ids
from thorndike.environments.native import NATIVE
from thorndike.errors import UserError
from thorndike.suggestions import nearest


def check_environment(name: str, *, engine: str, env_kwargs: Mapping[str, object], max_episode_steps: int | None) -> None:
    """Raises UserError, with a suggestion, if no engine can run the environment; JAX is not imported for a name that does not exist."""
    known = _ids_without_plugins()
    if known is not None and ":" not in name and not name.startswith("ALE/") and name not in known:
        close = nearest(name, known)
        hint = f"did you mean '{close}'?" if close else "give a Gymnasium id, module:Id or path/to/file.py:ClassName"
        raise UserError(f"unknown environment '{name}'; {hint}")
    from thorndike.environments.registry import resolve

    resolve(name, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)


def _ids_without_plugins() -> frozenset[str] | None:
    """Every plain id there is, or None where that takes an import: another package may add ids to Gymnasium's when it starts."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        return None
    package = Path(spec.origin).parent
    declared = package.parent.glob("*.dist-info/entry_points.txt")
    if any("[gymnasium.envs]" in path.read_text(encoding="utf-8") for path in declared):
        return None
    own = re.findall(r'^\s*id="([^"]+)"', (package / "envs" / "__init__.py").read_text(encoding="utf-8"), re.MULTILINE)
    return frozenset(own) | set(NATIVE) | pool_ids() if own else None
