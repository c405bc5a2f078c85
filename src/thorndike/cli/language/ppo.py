"""``thorndike language ppo MODEL``: a policy towards a reward, held close to its base."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import run_policy_verb


def run(words: Sequence[str]) -> Answer:
    """Train, and compare with the base."""
    return run_policy_verb("ppo", "PPO on texts, the divergence from the base steered to target_kl nats a text.", words)
