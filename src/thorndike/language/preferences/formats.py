"""A store's content as rows of TRL's formats, and back."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.language.preferences.assignment import Plan, with_raters
from thorndike.language.preferences.comparisons import compared
from thorndike.language.preferences.judgements import Candidate, Content, Judged, NewItem
from thorndike.language.preferences.noise import Method, believe
from thorndike.language.preferences.records import Records, with_explicit_prompt
from thorndike.language.preferences.store import Store
from thorndike.training.json_files import Json

EXPORTS = ("preference", "implicit", "unpaired", "prompt_only", "prompt_completion", "judgements")
TIES = ("drop", "half")


class Imported(NamedTuple):
    """What an import added."""

    items: int
    judgements: int
    left_out: int = 0
    """Rows whose candidates are all the same, as samples of a model may be: there is nothing to compare."""


def import_records(store: Store, project: int, records: Records, rater: str, plan: Plan, *, ask: bool = False) -> Imported:
    """Add what a file holds: all of it, or nothing.

    Preferences become items with a judgement by ``rater``, or with ``ask`` questions to be asked. Completions of the same prompt become
    one item, as do candidates. Raises ``UserError`` for rows in which nothing can be compared.
    """
    if records.format == "preference":
        items = list(with_raters((_pair(with_explicit_prompt(row)) for row in records.rows), plan))
        if ask:
            return Imported(store.add_items(project, items), 0)
        return Imported(*store.add_judged(project, store.rater(rater), [(item, [0, 1]) for item in items]))
    if records.format in ("candidates", "completions"):
        found = [_item(row, records.format, place) for row, place in zip(records.rows, records.places, strict=True)]
    elif records.format in ("prompt_completion", "unpaired_preference"):
        found = list(_together(records))
    else:
        known = records.format.replace("_", " ")
        raise UserError(f"{records.where}: rows of the format {known} hold nothing to compare: generate candidates first")
    items = [item for item in found if len(item.candidates) > 1]
    return Imported(store.add_items(project, with_raters(items, plan)), 0, len(found) - len(items))


def export_rows(store: Store, project: int, what: str = "preference", method: Method = "dawid_skene", ties: str = "drop") -> list[Json]:
    """Rows of one of ``EXPORTS``. ``ties``: left out, or ``half``: two rows, one each way, of half the weight."""
    if what not in EXPORTS:
        raise UserError(f"there is no export called '{what}'; there are {', '.join(EXPORTS)}")
    if ties not in TIES:
        raise UserError(f"ties can be treated as {' or '.join(TIES)}, not '{ties}'")
    prompts, candidates = store.contents(project)
    if what == "prompt_only":
        return [{"prompt": _plain(prompt), "prompt_id": number} for number, prompt in prompts.items()]
    judged = store.judged(project)
    if what == "judgements":
        return [_judgement(each, prompts, candidates) for each in judged]
    pairs = list(_pairs(judged, prompts, candidates, method, ties))
    if what == "preference":
        return pairs
    if what == "implicit":
        return [_implicit(row) for row in pairs]
    if what == "unpaired":
        return list(_unpaired(judged, prompts, candidates, pairs))
    return list(_best(pairs))


def _pair(row: Mapping[str, object]) -> NewItem:
    known = ("prompt", "chosen", "rejected")
    details = {name: value for name, value in row.items() if name not in known}
    chosen, rejected = Candidate(_content(row["chosen"]), details=details), Candidate(_content(row["rejected"]), details=details)
    return NewItem(_content(row["prompt"]), (chosen, rejected))


def _item(row: Mapping[str, object], column: str, place: str) -> NewItem:
    given, models, best, priority = row[column], row.get("models"), row.get("best"), row.get("priority", 0)
    assert isinstance(given, list)
    named = models is None or (isinstance(models, list) and len(models) == len(given) and all(isinstance(each, str) for each in models))
    if not named:
        raise UserError(f"{place}: 'models' must be a list of {len(given)} names, one a candidate")
    if best is not None and not (type(best) is int and 0 <= best < len(given)):
        raise UserError(f"{place}: 'best' must be the place of a candidate, from 0 to {len(given) - 1}")
    if isinstance(priority, bool) or not isinstance(priority, int | float):
        raise UserError(f"{place}: 'priority' must be a number")
    makers = models if isinstance(models, list) else [""] * len(given)
    candidates: list[Candidate] = []
    for each, maker in zip(given, makers, strict=True):
        _add_if_new(candidates, Candidate(_content(each), maker))
    known = None if best is None else candidates.index(Candidate(_content(given[best]), makers[best]))
    return NewItem(_content(row["prompt"]), candidates, priority=float(priority), best=known)


def _together(records: Records) -> Iterator[NewItem]:
    """One item a prompt."""
    found: dict[str, tuple[Content, list[Candidate], list[str]]] = {}
    for row, place in zip(records.rows, records.places, strict=True):
        _, candidates, places = found.setdefault(repr(row["prompt"]), (_content(row["prompt"]), [], []))
        details = {name: value for name, value in row.items() if name not in ("prompt", "completion")}
        _add_if_new(candidates, Candidate(_content(row["completion"]), str(row.get("model", "")), details))
        places.append(place)
    for prompt, candidates, places in found.values():
        if len(places) < 2:
            raise UserError(f"{places[0]}: its prompt has one completion, but at least 2 can be compared")
        yield NewItem(prompt, candidates)


def _add_if_new(candidates: list[Candidate], made: Candidate) -> None:
    """A candidate that the same maker made twice is shown once."""
    if all((each.content, each.made_by) != (made.content, made.made_by) for each in candidates):
        candidates.append(made)


def _content(value: object) -> Content:
    if isinstance(value, dict):
        return value
    return {"text": value} if isinstance(value, str) else {"messages": value}


def _plain(content: Content) -> object:
    """As TRL has it: text or messages; what is neither stays an object."""
    return content["text"] if content.keys() == {"text"} else content["messages"] if content.keys() == {"messages"} else dict(content)


def _answer(prompt: Content, candidate: Content) -> object:
    """A candidate in the form of its prompt: an answer to messages is a message."""
    plain = _plain(candidate)
    return [{"role": "assistant", "content": plain}] if "messages" in prompt and isinstance(plain, str) else plain


def _pairs(
    judged: Sequence[Judged], prompts: Mapping[int, Content], candidates: Mapping[int, Candidate], method: Method, ties: str
) -> Iterator[Json]:
    comparisons = compared(judged)
    believed = believe(comparisons, method).first_is_better
    votes: dict[int, list[tuple[str, float, float]]] = defaultdict(list)
    for pair, rater, value, strength in zip(
        comparisons.pair.tolist(), comparisons.rater.tolist(), comparisons.value.tolist(), comparisons.strength.tolist(), strict=True
    ):
        votes[pair].append((comparisons.raters[rater], value, strength))
    for number, pair in enumerate(comparisons.pairs):
        cast, first = votes[number], float(believed[number])
        is_tie = abs(first - 0.5) < 1e-9 or sum(value == 0.5 for _, value, _ in cast) * 2 > len(cast)
        if is_tie and ties == "drop":
            continue
        for chosen_first in (True, False) if is_tie else (first > 0.5,):
            chosen, rejected = (pair.first, pair.second) if chosen_first else (pair.second, pair.first)
            won = 1.0 if chosen_first else 0.0
            yield {
                "prompt": _plain(prompts[pair.prompt]),
                "chosen": _answer(prompts[pair.prompt], candidates[chosen].content),
                "rejected": _answer(prompts[pair.prompt], candidates[rejected].content),
                "weight": 0.5 if is_tie else 1.0,
                "p_chosen": 0.5 if is_tie else max(first, 1 - first),
                "n_labels": len(cast),
                "n_agree": sum(value == won for _, value, _ in cast),
                "tie": is_tie,
                "margin": sum((2 * value - 1) * (1 if chosen_first else -1) * strength for _, value, strength in cast) / len(cast),
                "pair_id": f"{pair.item}:{pair.first}:{pair.second}",
                "prompt_id": pair.prompt,
                "raters": sorted(name for name, _, _ in cast),
            }


def _implicit(row: Json) -> Json:
    prompt, chosen, rejected = row["prompt"], row["chosen"], row["rejected"]
    rest = {name: value for name, value in row.items() if name not in ("prompt", "chosen", "rejected")}
    if isinstance(prompt, str) and isinstance(chosen, str) and isinstance(rejected, str):
        return {"chosen": prompt + chosen, "rejected": prompt + rejected, **rest}
    if isinstance(prompt, list) and isinstance(chosen, list) and isinstance(rejected, list):
        return {"chosen": prompt + chosen, "rejected": prompt + rejected, **rest}
    raise UserError("clips have no prompt that could stand at their beginning: export them as 'preference'")


def _unpaired(
    judged: Sequence[Judged], prompts: Mapping[int, Content], candidates: Mapping[int, Candidate], pairs: Sequence[Json]
) -> Iterator[Json]:
    """Good: who was preferred; bad: who was not, and those of which a rater said that both are bad."""
    for row in pairs:
        if not row["tie"]:
            about = {"weight": row["p_chosen"], "pair_id": row["pair_id"], "prompt_id": row["prompt_id"]}
            yield {"prompt": row["prompt"], "completion": row["chosen"], "label": True, **about}
            yield {"prompt": row["prompt"], "completion": row["rejected"], "label": False, **about}
    for each in judged:
        if each.verdict == "both_bad" and not each.repeated:
            for number in each.candidates:
                answer = _answer(prompts[each.prompt], candidates[number].content)
                yield {
                    "prompt": _plain(prompts[each.prompt]),
                    "completion": answer,
                    "label": False,
                    "weight": 1.0,
                    "prompt_id": each.prompt,
                }


def _best(pairs: Sequence[Json]) -> Iterator[Json]:
    """Of every prompt, the completion that won most: what to fine-tune on."""
    won: dict[object, dict[str, tuple[float, Json]]] = defaultdict(dict)
    for row in pairs:
        for side, score in (("chosen", row["p_chosen"]), ("rejected", 0.0)):
            assert isinstance(score, float)
            before, _ = won[row["prompt_id"]].get(repr(row[side]), (0.0, row))
            won[row["prompt_id"]][repr(row[side])] = before + score, {"prompt": row["prompt"], "completion": row[side]}
    for number, completions in won.items():
        _, best = max(completions.values(), key=lambda scored: scored[0])
        yield {**best, "prompt_id": number}


def _judgement(each: Judged, prompts: Mapping[int, Content], candidates: Mapping[int, Candidate]) -> Json:
    made = [candidates[number] for number in each.candidates]
    return {
        "prompt": _plain(prompts[each.prompt]),
        "candidates": [_plain(one.content) for one in made],
        "models": [one.made_by for one in made],
        "verdict": each.verdict,
        "ranks": None if each.ranks is None else list(each.ranks),
        "shown": list(each.shown),
        "rater": each.rater,
        "strength": each.strength,
        "reason": each.reason,
        "milliseconds": each.milliseconds,
        "repeated": each.repeated,
        "best": each.best,
        "item_id": each.item,
        "prompt_id": each.prompt,
    }
