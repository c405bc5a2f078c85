"""The tasks of ``language_speed.py`` in numbers, and the reward, for every contestant alike; standard library only."""

from collections.abc import Sequence

SIZES = {"1.07 M": (2048, 128, 4, 4, 352), "7.5 M": (4096, 256, 8, 8, 688)}
"""Vocabulary, width, layers, heads, inner width."""
BATCH, PROMPT, NEW = 128, 8, 24
"""Texts of a batch, tokens of a prompt, new tokens of a text."""
PAIRS, BETA = 64, 0.1
"""DPO: comparisons of a gradient step (so 128 texts), how strongly the policy is held."""
GROUP, PENALTY = 8, 0.04
"""GRPO: completions of a prompt, weight of the divergence in the loss. One gradient step a batch."""
EPOCHS, MINIBATCH, KL_COEFFICIENT = 4, 64, 0.05
"""PPO: passes over a batch, texts of a gradient step, weight of the divergence in the reward."""
LEARNING_RATE = 1e-6
WARM_UP = 1
"""Steps before the window: what is compiled, or allocated for the first time, is then over."""
BOS, EOS, PAD = "<s>", "</s>", "<pad>"


def variety(completions: Sequence[str]) -> list[float]:
    """The reward of GRPO: the share of a completion's words that are different ones."""
    return [len(set(text.split())) / max(1, len(text.split())) for text in completions]
