"""What the user must know while work goes on: one line on stderr."""

import sys


def notice(line: str) -> None:
    """Print one line on stderr, where it disturbs neither an answer nor a pipe."""
    print(f"thorndike: {' '.join(line.split())}", file=sys.stderr, flush=True)
