"""What was found: how bad, what, where, with which numbers, and how to mend it."""

from collections import Counter
from typing import NamedTuple

SEVERITIES = ("error", "warning", "hint")


class Finding(NamedTuple):
    """One thing that is wrong with an environment, or may be."""

    severity: str
    """``error`` (breaks training, repeating or Gymnasium's rules), ``warning`` (works, probably not as meant) or ``hint``."""
    kind: str
    """One word that stays the same, for programs: ``observation_bounds``."""
    message: str
    """One line: what, where, numbers."""
    fix: str
    """One line."""


class CannotGoOn(Exception):
    """What was found makes it pointless to play on; the finding says why."""


class Findings:
    """Collects findings; what is found again is counted, not repeated."""

    def __init__(self) -> None:
        self.counting = True
        """Off where steps are repeated: what comes again there is no news."""
        self._first: dict[tuple[str, str], Finding] = {}
        self._times: Counter[tuple[str, str]] = Counter()

    def error(self, kind: str, message: str, fix: str, where: str = "") -> None:
        """Adds an error; ``where`` tells apart those of one kind that each deserve a line."""
        self._add(Finding("error", kind, _one_line(message), _one_line(fix)), where)

    def warning(self, kind: str, message: str, fix: str, where: str = "") -> None:
        """Adds a warning."""
        self._add(Finding("warning", kind, _one_line(message), _one_line(fix)), where)

    def hint(self, kind: str, message: str, fix: str, where: str = "") -> None:
        """Adds a hint."""
        self._add(Finding("hint", kind, _one_line(message), _one_line(fix)), where)

    def has(self, *kinds: str) -> bool:
        """Whether any of these kinds was found."""
        return any(finding.kind in kinds for finding in self._first.values())

    @property
    def total(self) -> int:
        """How often anything was found."""
        return self._times.total()

    def listed(self) -> list[Finding]:
        """Errors first, then warnings, then hints, each in the order found."""
        counted = [_with_times(finding, self._times[key]) for key, finding in self._first.items()]
        return sorted(counted, key=lambda finding: SEVERITIES.index(finding.severity))

    def _add(self, finding: Finding, where: str) -> None:
        key = finding.kind, where
        if self.counting or key not in self._first:
            self._times[key] += 1
        self._first.setdefault(key, finding)


def _with_times(finding: Finding, times: int) -> Finding:
    return finding if times == 1 else finding._replace(message=f"{finding.message} (seen {times:,} times)")


def _one_line(text: str) -> str:
    return " ".join(text.split())
