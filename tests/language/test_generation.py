"""Generation: log-probabilities, early end, samples a prompt, streaming, padding."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language.decoder import hidden_states, logits, token_log_probs
from thorndike.language.generation import (
    AS_TRAINED,
    GREEDY,
    Generated,
    Sampling,
    bucket,
    generate,
    generate_texts,
    left_padded,
    stream,
    stream_text,
)
from thorndike.language.model import LanguageModel, load_decoder, never_ending, stop_tokens
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.usefixtures("quick_compile")
CONFIG, PARAMS = load_decoder(REFERENCE / "llama")
PROMPTS = [[5, 6, 7], [9], [20, 21, 22, 23, 24]]
NEW = 12
STOPS = (10, 30, 50)


def run(sampling: Sampling = AS_TRAINED, stops: tuple[int, ...] = (), samples: int = 1, seed: int = 0) -> Generated:
    tokens, segments = left_padded(PROMPTS, 0)
    return generate(
        PARAMS, CONFIG, tokens, segments, jax.random.key(seed), max_new_tokens=NEW, sampling=sampling, stop_tokens=stops, samples=samples
    )


@partial(jax.jit, static_argnames="temperature")
def text_log_probs(texts: jax.Array, temperature: float) -> jax.Array:
    return token_log_probs(PARAMS, CONFIG, hidden_states(PARAMS, CONFIG, texts)[:, :-1], texts[:, 1:], temperature)


def log_probs_by_forward(prompts: list[list[int]], generated: Generated, temperature: float) -> list[np.ndarray]:
    """Of each row's tokens, from a forward pass over the whole text."""
    rows = list(zip(prompts, np.asarray(generated.tokens), np.asarray(generated.lengths), strict=True))
    texts = [[*prompt, *row[:length], *[0] * (NEW + 5 - len(prompt) - length)] for prompt, row, length in rows]
    log_probs = np.asarray(text_log_probs(jnp.asarray(texts), temperature))
    return [found[len(prompt) - 1 : len(prompt) - 1 + length] for found, (prompt, _, length) in zip(log_probs, rows, strict=True)]


@pytest.mark.parametrize("sampling", [Sampling(), Sampling(temperature=0.6, top_k=5, top_p=0.9), GREEDY])
def test_log_probabilities_are_those_of_a_forward_pass(sampling: Sampling) -> None:
    found = run(sampling)
    for row, wanted in enumerate(log_probs_by_forward(PROMPTS, found, sampling.temperature or 1.0)):
        np.testing.assert_allclose(found.log_probs[row], wanted, atol=1e-5)


def test_a_row_ends_with_its_stop_token_and_is_padded_after_it() -> None:
    free = run()
    stop = int(free.tokens[0, 4])
    found = run(stops=(stop, 95))
    for row in range(3):
        wanted = np.asarray(free.tokens[row])
        ends = np.flatnonzero((wanted == stop) | (wanted == 95))
        length = int(ends[0]) + 1 if len(ends) else NEW
        assert int(found.lengths[row]) == length and bool(found.ended[row]) == bool(len(ends))
        np.testing.assert_array_equal(found.tokens[row], np.where(np.arange(NEW) < length, wanted, 0))
        np.testing.assert_array_equal(np.asarray(found.log_probs[row])[length:], 0.0)


def test_the_loop_ends_when_every_row_has() -> None:
    tokens, segments = left_padded([[5]], 0)
    pieces = list(stream(PARAMS, CONFIG, tokens, segments, jax.random.key(0), max_new_tokens=NEW, stop_tokens=range(96), every=2))
    assert len(pieces) == 1 and int(pieces[0].lengths[0]) == 1


def test_samples_of_a_prompt_stand_side_by_side_and_differ() -> None:
    found = run(samples=4)
    assert found.tokens.shape == (12, NEW)
    assert len({tuple(row) for row in np.asarray(found.tokens[:4]).tolist()}) == 4
    repeated = [prompt for prompt in PROMPTS for _ in range(4)]
    for row, wanted in enumerate(log_probs_by_forward(repeated, found, 1.0)):
        np.testing.assert_allclose(found.log_probs[row], wanted, atol=1e-5)
    np.testing.assert_array_equal(run(GREEDY, samples=2).tokens[::2], run(GREEDY).tokens)


def test_the_same_key_gives_the_same_text_and_another_key_another() -> None:
    np.testing.assert_array_equal(run().tokens, run().tokens)
    assert not np.array_equal(run().tokens, run(seed=1).tokens)


def test_what_is_streamed_is_what_is_generated() -> None:
    tokens, segments = left_padded(PROMPTS, 0)
    pieces = list(stream(PARAMS, CONFIG, tokens, segments, jax.random.key(0), max_new_tokens=NEW, stop_tokens=(), every=5))
    assert [int(piece.lengths[0]) for piece in pieces] == [1, 6, 11, 12]
    np.testing.assert_array_equal(pieces[-1].tokens, run().tokens)
    np.testing.assert_array_equal(pieces[1].tokens[:, 6:], 0)


def test_texts_go_in_and_come_out() -> None:
    model = LanguageModel(CONFIG, PARAMS, load_tokenizer(REFERENCE / "tokenizer"))
    # This model knows 96 tokens, of which the tokenizer's first are bytes: enough for short words of its own.
    prompts = [model.tokenizer.decode([40, 41, 42]), model.tokenizer.decode([60]), model.tokenizer.decode([70, 71])]
    found = generate_texts(model, prompts, max_new_tokens=NEW, samples=2, batch_size=2)
    assert [len(each) for each in found] == [2, 2, 2] and all(isinstance(text, str) for each in found for text in each)
    assert stop_tokens(model) == (2,)
    whole = generate_texts(model, prompts[:1], max_new_tokens=NEW, sampling=GREEDY)[0][0]
    streamed = "".join(stream_text(model, model.tokenizer.encode(prompts[0]), max_new_tokens=NEW, sampling=GREEDY))
    assert whole.rstrip("\ufffd") == streamed


def test_a_model_that_never_ends_has_what_is_left_of_its_distribution() -> None:
    model = LanguageModel(replace(CONFIG, eos_token_ids=STOPS), PARAMS, load_tokenizer(REFERENCE / "tokenizer"))
    endless = never_ending(model).config
    tokens, segments = left_padded([[5, 6, 7]] * 64, 0)
    found = generate(PARAMS, endless, tokens, segments, jax.random.key(0), max_new_tokens=NEW, stop_tokens=stop_tokens(model), pad_id=0)
    written = np.asarray(found.tokens)
    assert not np.isin(written, stop_tokens(model)).any() and (np.asarray(found.lengths) == NEW).all() and not found.ended.any()
    texts = jnp.concatenate([tokens[:, -3:], found.tokens], axis=1)
    hidden = hidden_states(PARAMS, CONFIG, texts)[:, 2:-1]
    whole, left = np.exp(np.asarray(logits(PARAMS, CONFIG, hidden), np.float64)), np.asarray(logits(PARAMS, endless, hidden))
    kept = [token for token in range(whole.shape[-1]) if token not in stop_tokens(model)]
    by_reading = np.asarray(token_log_probs(PARAMS, endless, hidden, found.tokens))
    assert (left[..., list(stop_tokens(model))] < -1e29).all()
    for row in range(0, 64, 9):
        for t in range(NEW):
            wanted = np.log(whole[row, t, written[row, t]] / whole[row, t, kept].sum())
            assert float(found.log_probs[row, t]) == pytest.approx(wanted, abs=1e-4)
            assert float(by_reading[row, t]) == pytest.approx(wanted, abs=1e-4)


def test_prompts_are_padded_on_the_left_to_one_of_a_few_lengths() -> None:
    tokens, segments = left_padded(PROMPTS, 3)
    assert tokens.shape == (3, 8)
    np.testing.assert_array_equal(tokens[1], [3] * 7 + [9])
    np.testing.assert_array_equal(segments.sum(axis=1), [3, 1, 5])
    assert [bucket(length) for length in (1, 8, 9, 33, 64, 65, 129)] == [8, 8, 16, 64, 64, 128, 192]
    with pytest.raises(UserError, match="a prompt is empty"):
        left_padded([[1], []], 0)


@pytest.mark.parametrize("wrong", [{"temperature": -1.0}, {"top_p": 1.5}, {"top_k": -1}])
def test_settings_out_of_bounds_are_refused(wrong: dict) -> None:
    with pytest.raises(UserError, match=next(iter(wrong))):
        Sampling(**wrong)
