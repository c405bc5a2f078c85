"""``thorndike language grpo MODEL``: several completions a prompt are each other's baseline."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import run_policy_verb


def run(words: Sequence[str]) -> Answer:
    """Train, and compare with the base."""
    return run_policy_verb("grpo", "GRPO: the advantage of a completion is its reward beside the others of its prompt.", words)
