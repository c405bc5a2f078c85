"""Texts of any length as rows of one length: packed side by side, each a segment of its own, so that next to nothing is padding."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from thorndike.errors import UserError
from thorndike.language.data import TokenRow
from thorndike.language.sft import TextBatch


class PackedRows(NamedTuple):
    """All rows of a data set."""

    tokens: Int[np.ndarray, "N T"]
    segments: Int[np.ndarray, "N T"]
    learn: Bool[np.ndarray, "N T"]


def packed(texts: Sequence[TokenRow], length: int, pad_id: int) -> PackedRows:
    """Rows ``[N, length]``, as NumPy arrays. A text that is longer goes on in a further row, as a segment of its own.

    Pieces are put, longest first, into the fullest row that still has room. Raises ``UserError`` where nothing is to be learnt.
    """
    pieces = [piece for text in texts for piece in _pieces(text, length)]
    if not pieces:
        raise UserError("there is nothing to learn from: every text is shorter than two tokens, or has no part that is to be learnt")
    rows: list[list[TokenRow]] = []
    with_room: dict[int, list[int]] = {}
    for piece in sorted(pieces, key=lambda piece: -len(piece.tokens)):
        size = len(piece.tokens)
        space = next((space for space in range(size, length + 1) if with_room.get(space)), None)
        if space is None:
            rows.append([])
            number, space = len(rows) - 1, length
        else:
            number = with_room[space].pop()
        rows[number].append(piece)
        with_room.setdefault(space - size, []).append(number)
    return _arrays(rows, length, pad_id)


def concatenated(texts: Sequence[TokenRow], length: int, pad_id: int) -> PackedRows:
    """Rows ``[N, length]`` of all texts one after the other, cut wherever a row ends: for pre-training, where no text needs to be whole."""
    rows: list[list[TokenRow]] = [[]]
    space = length
    for text in texts:
        begin = 0
        while begin < len(text.tokens):
            end = min(len(text.tokens), begin + space)
            rows[-1].append(TokenRow(text.tokens[begin:end], text.learn[begin:end]))
            space -= end - begin
            begin = end
            if space == 0:
                rows.append([])
                space = length
    return _arrays(rows if rows[-1] else rows[:-1], length, pad_id)


def batch_at(rows: PackedRows, batch_size: int, step: int, seed: int) -> TextBatch:
    """The rows of a step: every epoch in an order of its own, which follows from the seed; what is asked for depends on nothing else."""
    total = rows.tokens.shape[0]
    first = step * batch_size
    chosen = [_order(seed, epoch, total)[place] for epoch, place in (divmod(first + number, total) for number in range(batch_size))]
    return TextBatch(*(jnp.asarray(array[np.asarray(chosen)]) for array in rows))


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, total: int) -> np.ndarray:
    return np.random.default_rng([seed, epoch]).permutation(total)


def _pieces(text: TokenRow, length: int) -> Iterator[TokenRow]:
    for begin in range(0, len(text.tokens), length):
        piece = TokenRow(text.tokens[begin : begin + length], text.learn[begin : begin + length])
        if any(piece.learn[1:]):
            yield piece


def _arrays(rows: Sequence[Sequence[TokenRow]], length: int, pad_id: int) -> PackedRows:
    tokens = np.full((len(rows), length), pad_id, np.int32)
    segments, learn = np.zeros((len(rows), length), np.int32), np.zeros((len(rows), length), bool)
    for number, row in enumerate(rows):
        place = 0
        for segment, piece in enumerate(row, 1):
            end = place + len(piece.tokens)
            tokens[number, place:end], segments[number, place:end], learn[number, place:end] = piece.tokens, segment, piece.learn
            place = end
    return PackedRows(tokens, segments, learn)
