"""Which trials come next: all of a list at once, or round after round from Optuna, which learns from the scores."""

import importlib.util
import math
import warnings
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, TypeAlias

from thorndike.errors import UserError
from thorndike.training.sweep_ranges import Search, Settings, Swept, listed_trials

if TYPE_CHECKING:
    import optuna

Proposals: TypeAlias = Generator[list[Settings], list[float], None]
"""Yields the settings of the next trials; is sent the score of each (NaN: it failed)."""

_ROUNDS = 8
"""Rounds that Optuna learns between, at least: larger ones would be hardly better than random search."""


def check_search(search: Search) -> None:
    """Raises UserError if Optuna is asked for and not installed."""
    if search.kind == "optuna" and importlib.util.find_spec("optuna") is None:
        raise UserError("--search optuna needs Optuna: pip install 'thorndike[sweep]'; or use --search random")


def round_size(search: Search, at_once: int) -> int:
    """Trials of a round of Optuna, ``at_once`` being what fits into one program."""
    return max(1, min(at_once, search.trials // _ROUNDS))


def proposals(swept: Sequence[Swept], search: Search, seed: int, at_once: int) -> Proposals:
    """The trials of a search; given the same scores it proposes the same again."""
    if search.kind == "optuna":
        return _from_optuna(swept, search, seed, round_size(search, at_once))
    return _all_at_once(listed_trials(swept, search, seed))


def _all_at_once(trials: list[Settings]) -> Proposals:
    yield trials


def _from_optuna(swept: Sequence[Swept], search: Search, seed: int, size: int) -> Proposals:
    """Bergstra et al. 2011, "Algorithms for Hyper-Parameter Optimization" (tree-structured Parzen estimator), by Optuna's ask and tell."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():
        # What it warns of is that the option may change; the version is pinned.
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    left = search.trials
    while left > 0:
        asked = [study.ask() for _ in range(min(size, left))]
        scores = yield [{each.name: _suggested(trial, each) for each in swept} for trial in asked]
        for trial, score in zip(asked, scores, strict=True):
            failed = math.isnan(score)
            study.tell(trial, None if failed else score, optuna.trial.TrialState.FAIL if failed else None)
        left -= len(asked)


def _suggested(trial: "optuna.Trial", swept: Swept) -> object:
    if not swept.is_range:
        # By number, because Optuna's categories may not be lists.
        return swept.values[trial.suggest_categorical(swept.name, list(range(len(swept.values))))]
    log = swept.scale == "log"
    if swept.whole:
        return trial.suggest_int(swept.name, int(swept.low), int(swept.high), log=log)
    return trial.suggest_float(swept.name, swept.low, swept.high, log=log)
