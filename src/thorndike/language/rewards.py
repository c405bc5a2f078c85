"""What a text is worth: reward models, Python functions and verifiers behind one signature, alone or summed with weights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float

from thorndike.errors import UserError
from thorndike.language.reward_files import RewardModel
from thorndike.training.json_files import quoted
from thorndike.user_code import one_line, place_in


class Score(Protocol):
    """Anything that scores completions."""

    def __call__(
        self, prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]], /
    ) -> Float[np.ndarray, " B"] | Sequence[float]:
        """Prompts, completions and the tokens of both together -> a number a text, higher is better."""
        ...


def weighted_sum(parts: Sequence[tuple[float, Score]]) -> Score:
    """Several scores as one."""

    def score(prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> Float[np.ndarray, " B"]:
        return sum((weight * checked_scores(part, prompts, completions, ids) for weight, part in parts), np.zeros(len(prompts)))

    return score


def model_score(model: RewardModel, clip: float | None = None) -> Score:
    """A reward model's score; beyond ``clip`` deviations it is cut off, because a model is not to be believed that far out."""

    def score(prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> Float[np.ndarray, " B"]:
        found = model.score(prompts, completions, ids)
        return found if clip is None else np.clip(found, -clip, clip)

    return score


def function_score(function: Score, name: str, file: Path | None) -> Score:
    """A user's function, by the ``name`` that was given; whatever it raises is one line that says where in ``file``, the user's."""

    def score(
        prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]
    ) -> Float[np.ndarray, " B"] | Sequence[float]:
        try:
            return function(prompts, completions, ids)
        except Exception as error:
            raise UserError(f"the reward {name} failed: {type(error).__name__}: {one_line(error)}{place_in(file, error)}") from error

    return score


def checked_scores(
    score: Score, prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]
) -> Float[np.ndarray, " B"]:
    """What a score says. Raises ``UserError`` if that is not one finite number a text."""
    try:
        found = np.asarray(score(prompts, completions, ids), np.float64)
    except (TypeError, ValueError) as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is not None:
            # It went wrong inside the function, which its author is to see.
            raise
        raise UserError("a reward function must return a number a text, as a list or an array") from None
    if found.shape != (len(prompts),):
        raise UserError(f"a reward function must return a number a text: {len(prompts)} here; it returned the shape {found.shape}")
    if not np.isfinite(found).all():
        wrong = int(np.flatnonzero(~np.isfinite(found))[0])
        raise UserError(f"the reward of {quoted(completions[wrong])} is {found[wrong]}: rewards must be finite")
    return found
