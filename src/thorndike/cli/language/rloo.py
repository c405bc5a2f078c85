"""``thorndike language rloo MODEL``: REINFORCE with the other completions of a prompt as the baseline."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import run_policy_verb


def run(words: Sequence[str]) -> Answer:
    """Train, and compare with the base."""
    return run_policy_verb(
        "rloo", "RLOO: a completion's reward less the mean of the others of its prompt; the penalty is in the reward.", words
    )
