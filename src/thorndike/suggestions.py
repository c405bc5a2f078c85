"""Did you mean: the nearest known name to one that is not known."""

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name closest to `name` (letter case and `_`/`-` aside), or None if nothing is close."""
    plain = {_plain(candidate): candidate for candidate in known}
    found = get_close_matches(_plain(name), plain, n=1, cutoff=0.6)
    return plain[found[0]] if found else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"``, or where nothing is close the whole list of what is known."""
    choices = sorted(known)
    close = nearest(name, choices)
    if close is not None:
        return f"; did you mean '{close}'?"
    return f"; known: {', '.join(choices)}" if choices else ""


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
