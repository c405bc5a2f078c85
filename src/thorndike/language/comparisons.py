"""What reward models and DPO learn from: texts of one prompt, and which of two is the better one, with what probability.

A pair, a ranking of K (all its pairs), ties, several raters' verdicts: all are a ``Comparison``, and it stays one row of a batch, so that
each text is read once however many pairs it is in.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from thorndike.errors import UserError


class Pair(NamedTuple):
    """One text against another of the same comparison."""

    first: int
    second: int
    p_first: float = 1.0
    """The probability that the first is the better one: 0.5 a tie, anything between from raters that may err."""
    weight: float = 1.0


class Comparison(NamedTuple):
    """Texts of one prompt, best first where an order is known."""

    texts: tuple[tuple[int, ...], ...]
    """Tokens of prompt and completion."""
    prompt_length: int
    """Tokens of the prompt, which all of them begin with."""
    pairs: tuple[Pair, ...]


class ComparisonBatch(NamedTuple):
    """Rows of comparisons on the device, padded to one shape. Padding has segment 0, and pairs of padding weigh nothing."""

    tokens: Int[Array, "*R K T"]
    segments: Int[Array, "*R K T"]
    prompt_lengths: Int[Array, "*R"]
    valid: Bool[Array, "*R K"]
    first: Int[Array, "*R M"]
    second: Int[Array, "*R M"]
    p_first: Float[Array, "*R M"]
    weight: Float[Array, "*R M"]


class ComparisonData(NamedTuple):
    """All comparisons there are, on the host; the fields are those of ``ComparisonBatch``."""

    tokens: Int[np.ndarray, "R K T"]
    segments: Int[np.ndarray, "R K T"]
    prompt_lengths: Int[np.ndarray, " R"]
    valid: Bool[np.ndarray, "R K"]
    first: Int[np.ndarray, "R M"]
    second: Int[np.ndarray, "R M"]
    p_first: Float[np.ndarray, "R M"]
    weight: Float[np.ndarray, "R M"]

    def rows(self, numbers: Int[np.ndarray, "*rows"]) -> ComparisonBatch:
        """Some of the rows, on the device."""
        return ComparisonBatch(*(jnp.asarray(part[numbers]) for part in self))


def preferred(
    prompt: Sequence[int], chosen: Sequence[int], rejected: Sequence[int], p_chosen: float = 1.0, weight: float = 1.0
) -> Comparison:
    """A pair of completions."""
    texts = ((*prompt, *chosen), (*prompt, *rejected))
    return Comparison(texts, len(prompt), (Pair(0, 1, p_chosen, weight),))


def ranked(prompt: Sequence[int], completions: Sequence[Sequence[int]]) -> Comparison:
    """A ranking, best first: all its pairs, which weigh as one comparison together (Ouyang et al. 2022, section 3.5)."""
    number = len(completions)
    weight = 2.0 / (number * (number - 1))
    pairs = tuple(Pair(i, j, 1.0, weight) for i in range(number) for j in range(i + 1, number))
    return Comparison(tuple((*prompt, *each) for each in completions), len(prompt), pairs)


def comparison_data(comparisons: Sequence[Comparison], pad_id: int, width: int | None = None) -> ComparisonData:
    """All comparisons as arrays, as wide as the longest text unless ``width`` is given.

    Raises ``UserError`` for an empty text or one longer than ``width``, and for a probability or a weight that is none.
    """
    if not comparisons:
        raise UserError("there is nothing to learn from: no comparison was given")
    texts = max(len(each.texts) for each in comparisons)
    pairs = max(len(each.pairs) for each in comparisons)
    longest = max(len(text) for each in comparisons for text in each.texts)
    size = longest if width is None else width
    if longest > size:
        raise UserError(f"a text of a comparison has {longest} tokens, more than max_length = {size}: raise it, or shorten the texts")
    shape = (len(comparisons), texts, size)
    batch = ComparisonData(
        np.full(shape, pad_id, np.int32), np.zeros(shape, np.int32), np.array([each.prompt_length for each in comparisons], np.int32),
        np.zeros(shape[:2], bool), np.zeros((len(comparisons), pairs), np.int32), np.zeros((len(comparisons), pairs), np.int32),
        np.full((len(comparisons), pairs), 0.5, np.float32), np.zeros((len(comparisons), pairs), np.float32),
    )  # fmt: skip
    for row, comparison in enumerate(comparisons):
        for place, text in enumerate(comparison.texts):
            if len(text) <= comparison.prompt_length:
                raise UserError(f"comparison {row + 1}: completion {place + 1} is empty: leave such comparisons out")
            batch.tokens[row, place, : len(text)] = text
            batch.segments[row, place, : len(text)] = 1
            batch.valid[row, place] = True
        for place, pair in enumerate(comparison.pairs):
            _check(pair, len(comparison.texts), row)
            batch.first[row, place], batch.second[row, place] = pair.first, pair.second
            batch.p_first[row, place], batch.weight[row, place] = pair.p_first, pair.weight
    return batch


def _check(pair: Pair, texts: int, row: int) -> None:
    if not (0 <= pair.first < texts and 0 <= pair.second < texts and pair.first != pair.second):
        raise UserError(f"comparison {row + 1}: a pair names texts {pair.first} and {pair.second}, but there are {texts}")
    if not (0.0 <= pair.p_first <= 1.0 and 0.0 <= pair.weight < float("inf")):
        raise UserError(
            f"comparison {row + 1}: a pair has probability {pair.p_first} and weight {pair.weight}; expected 0 to 1 and at least 0"
        )
