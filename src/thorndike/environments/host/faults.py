"""What an environment did wrong, in one line: which environment, when, what, and how to mend it.

Kept free of JAX, so that worker processes start fast.
"""

import signal
import traceback
from pathlib import Path
from typing import NamedTuple

from thorndike.errors import UserError

_LONGEST = 300
"""Characters of an environment's own error message that are repeated."""


class Fault(Exception):
    """What an environment did and how to mend it, in words; the engine that catches it adds which environment it was, and when."""

    def __init__(self, what: str, mend: str, row: int | None = None) -> None:
        super().__init__(what)
        self.what, self.mend, self.row = what, mend, row


class Timeouts(NamedTuple):
    """Seconds a worker process may take to answer."""

    step: float = 60.0
    reset: float = 120.0
    """The reset at the end of an episode has this long as well, on top of the step's own."""
    start: float = 120.0
    """From the start of the process to an environment that is made."""


DEFAULT_TIMEOUTS = Timeouts()
_HINTS = {
    int(signal.SIGKILL): "look for what killed it, often the system when memory runs out",
    int(signal.SIGSEGV): "its native code crashed",
}


def timeouts(env_timeout: float | None) -> Timeouts:
    """The time-outs for steps of at most `env_timeout` seconds: a reset may take twice that, a start no less than by default."""
    if env_timeout is None:
        return DEFAULT_TIMEOUTS
    if not 0 < env_timeout < float("inf"):
        raise UserError(f"env_timeout must be a number of seconds above 0, not {env_timeout}: leave it out for {DEFAULT_TIMEOUTS.step:g}")
    return Timeouts(env_timeout, 2 * env_timeout, max(DEFAULT_TIMEOUTS.start, 2 * env_timeout))


def as_fault(error: BaseException, caller: str, expected: str) -> Fault:
    """Any error of a call into an environment as a Fault.

    `caller` is the file of the call: what is raised there, and no deeper, was raised in taking `expected` apart.
    """
    if isinstance(error, Fault):
        return error
    if isinstance(error, UserError):
        return Fault(str(error), "")
    said = f"{type(error).__name__}: {one_line(error)}"
    place = traceback.extract_tb(error.__traceback__)[-1]
    # Gymnasium's wrappers take the same values apart, and raise in its name.
    in_wrapper = "values to unpack" in said and "gymnasium/wrappers" in place.filename
    if place.filename == caller or in_wrapper:
        return Fault(f"returned something else than {expected} ({said})", "return these")
    return Fault(f"raised {said} ({Path(place.filename).name}:{place.lineno}, in {place.name})", "mend it there")


def hung(seconds: float, row: int | None = None) -> Fault:
    """No answer within the time-out."""
    return Fault(f"gave no answer within {seconds:g} s and was ended", "find what it waits for, or give it longer with env_timeout", row)


def gone(status: int, row: int | None = None) -> Fault:
    """A process that is there no longer; `status` is its exit status, or minus the number of the signal that killed it."""
    if status >= 0:
        return Fault(f"exited with status {status}", "find what ended it in what it printed", row)
    name = signal.Signals(-status).name if -status in signal.valid_signals() else "unknown"
    return Fault(f"was killed by signal {-status} ({name})", _HINTS.get(-status, "look for what killed it"), row)


def named(fault: Fault, id: str, kind: str, count: int, when: str) -> UserError:
    """The error a user reads; `kind` is ``environment`` or ``worker``, of which there are `count`."""
    who = f"{kind} {fault.row} of {count}" if fault.row is not None else f"one of {count} {kind}s"
    return UserError(f"{id}, {who}, {when}: {fault.what}{'; ' if fault.mend else ''}{fault.mend}")


def reset_name(steps: int) -> str:
    """What a reset is called that comes when so many steps have been made."""
    return f"the reset after step {steps}" if steps else "the first reset"


def one_line(error: BaseException) -> str:
    """An error's message without its line breaks, cut where it is very long."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
