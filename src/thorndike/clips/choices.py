"""Pairs of clips before raters, and what they chose: the preference store of a folder of clips."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from thorndike.clips.folder import FILMS, Collection, clip_name, collections, read_about
from thorndike.clips.segments import Choices
from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.comparisons import compared
from thorndike.language.preferences.judgements import Candidate, Content, NewItem
from thorndike.language.preferences.noise import believe
from thorndike.language.preferences.raters import Rater, let_them_judge
from thorndike.language.preferences.store import Store

STORE, PROJECT = "choices.db", "default"
EXACT = 1e-6
"""A temperature at which whoever is better by more than nothing is chosen: the paper's simulated rater."""


def ask(where: Path, collection: Collection) -> int:
    """Put a collection's pairs before the raters; how many were not there yet."""
    question, made_by = read_about(where).question, collection.made_by
    shown = [_content(collection, place) for place in range(collection.segments.number)]
    items = [NewItem({"text": question}, [Candidate(shown[each], made_by) for each in pair]) for pair in collection.pairs]
    with Store(where / STORE) as store:
        return store.add_items(store.project(PROJECT), items)


def read_choices(where: Path) -> Choices:
    """All pairs that somebody has judged, each once: where raters disagree, by what Dawid and Skene's model makes of them."""
    sizes = [each.segments.number for each in collections(where)]
    starts = np.cumsum([0, *sizes])
    with Store(where / STORE) as store:
        project = store.project(PROJECT)
        comparisons = compared(store.judged(project))
        candidates = store.contents(project)[1]
    several = len(comparisons.value) > len(comparisons.pairs)
    # One label a pair says nothing of how far its rater can be trusted: what it says counts.
    believed = believe(comparisons, "dawid_skene" if several else "mean").first_is_better
    places = [[_place(candidates[each].content, starts) for each in (pair.first, pair.second)] for pair in comparisons.pairs]
    table = np.array(places, np.int64).reshape(-1, 2)
    return Choices(table[:, 0], table[:, 1], np.asarray(believed, np.float32))


def left_to_judge(where: Path) -> int:
    """Pairs that nobody has judged yet."""
    with Store(where / STORE) as store:
        progress = store.progress(store.project(PROJECT))
    return progress.items - progress.done


def simulate(where: Path, temperature: float, error_rate: float, seed: int) -> int:
    """Let a program judge all that is left, by the clips' own returns; how many judgements that made.

    It chooses by Bradley-Terry: the first with chance ``sigmoid((return of the first - of the second) / temperature)``, at a temperature of
    0 always the better one; and in a share ``error_rate`` of cases at random (Christiano et al. 2017: a tenth).
    """
    found = {
        clip_name(each.number, place): float(worth) for each in collections(where) for place, worth in enumerate(each.segments.returns)
    }

    def utility(prompt: Content, candidate: Content) -> float:
        del prompt
        return found[str(candidate["clip"])]

    rater = Rater("simulated", temperature=max(temperature, EXACT), lapse=error_rate)
    with Store(where / STORE) as store:
        plan = Plan(gold=0.0, repeats=0.0, seed=seed)
        return let_them_judge(store, store.project(PROJECT), [rater], utility, plan=plan, seed=seed)


def _content(collection: Collection, place: int) -> Mapping[str, object]:
    name = clip_name(collection.number, place)
    shown = {"media": f"{FILMS}/{name}.mp4"} if collection.filmed else {"text": f"clip {name}"}
    return {**shown, "clip": name}


def _place(content: Mapping[str, object], starts: Sequence[int] | np.ndarray) -> int:
    collection, _, place = str(content["clip"]).partition("-")
    return int(starts[int(collection)]) + int(place)
