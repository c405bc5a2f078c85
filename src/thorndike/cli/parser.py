"""Argument parsing that answers a mistake in one line, and takes the flags other libraries' users know."""

import argparse
import math
import re
from collections.abc import Sequence
from typing import NoReturn

from thorndike.errors import UserError
from thorndike.suggestions import nearest


class Parser(argparse.ArgumentParser):
    """`argparse`, but a mistake raises UserError, `_` may stand for `-` in a flag, and an unknown flag gets a suggestion."""

    def __init__(self, verb: str, summary: str, examples: str = "") -> None:
        """`summary`: one line; `examples`: indented lines shown under the options."""
        super().__init__(
            prog=f"thorndike {verb}",
            description=summary,
            epilog=f"examples:\n{examples}" if examples else None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self.add_argument("--json", action="store_true", help="print one JSON object on stdout, and nothing else there")

    def error(self, message: str) -> NoReturn:
        """Raise UserError instead of printing the usage and leaving."""
        raise UserError(f"{message} (see: {self.prog} --help)")

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """The options in `words`, flags and positional arguments in any order."""
        spelled = [_dashed(word) for word in words]
        options, unknown = self.parse_known_intermixed_args(spelled)
        if unknown:
            self._reject(unknown[0])
        return options

    def _reject(self, word: str) -> NoReturn:
        if not word.startswith("-"):
            self.error(f"did not expect '{word}'")
        flag = word.partition("=")[0]
        close = nearest(flag, [known for known in self._option_string_actions if known.startswith("--")])
        self.error(f"unknown flag {flag}" + (f"; did you mean {close}?" if close else ""))


_MOST = 2**53
"""Beyond it a float cannot tell a whole number from the next."""


def positive_whole(text: str) -> int:
    """A whole number of at least 1: ``8``, ``100_000``, ``1e6``, ``100k``, ``1M``."""
    number = _whole(text)
    if number is None or not 1 <= number <= _MOST:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, such as 8, 100k or 1e6; got '{text}'")
    return number


def seed_number(text: str) -> int:
    """A whole number from 0 to 2^32 - 1."""
    number = _whole(text)
    if number is None or number < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0; got '{text}'")
    if number >= 2**32:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 2^32 - 1; got '{text}'")
    return number


def at_least_zero(text: str) -> float:
    """A finite number of at least 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number of at least 0; got '{text}'")
    return number


def _whole(text: str) -> int | None:
    match = re.fullmatch(r"([-+]?[\d_.]+(?:[eE]\+?\d+)?)([kKmMgG]?)", text.strip())
    if match is None:
        return None
    try:
        number = float(match[1]) * {"": 1, "k": 1e3, "m": 1e6, "g": 1e9}[match[2].lower()]
    except ValueError:
        return None
    return int(number) if number.is_integer() else None


def _dashed(word: str) -> str:
    """``--total_timesteps=5`` as ``--total-timesteps=5``; what is no long flag stays as it is."""
    if not word.startswith("--"):
        return word
    flag, equals, value = word.partition("=")
    return flag.replace("_", "-") + equals + value
