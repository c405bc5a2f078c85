"""Tokens are drawn as often as softmax says, with and without top-k and top-p; log-probabilities are those of the whole distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.token_sampling import kept_weights, look_up, sample_tokens

SIZE, ROWS, ROUNDS = 70, 4096, 64


def kept_by_loop(probabilities: np.ndarray, top_k: int, top_p: float) -> np.ndarray:
    """The distribution that is left, token by token from the likeliest on."""
    left = np.zeros_like(probabilities)
    order = np.argsort(-probabilities)[: top_k or None]
    total, reached = probabilities[order].sum(), 0.0
    for token in order:
        if reached >= top_p * total:
            break
        left[token] = probabilities[token]
        reached += probabilities[token]
    return left / left.sum()


def logits() -> np.ndarray:
    return np.random.default_rng(0).normal(0, 2.0, SIZE).astype(np.float32)


@pytest.mark.parametrize(("temperature", "top_k", "top_p"), [(1.0, 0, 1.0), (0.7, 0, 1.0), (1.0, 7, 1.0), (1.3, 0, 0.8), (1.0, 20, 0.6)])
def test_frequencies_are_those_of_softmax(temperature: float, top_k: int, top_p: float) -> None:
    row = logits()
    probabilities = np.exp(row / temperature) / np.exp(row / temperature).sum()
    wanted = kept_by_loop(probabilities.astype(np.float64), top_k, top_p)

    def draw(key: jax.Array) -> jax.Array:
        uniform = jax.random.uniform(key, (ROWS,))
        return sample_tokens(jnp.broadcast_to(row, (ROWS, SIZE)), uniform, temperature, top_k, top_p)[0]

    drawn = np.asarray(jax.jit(lambda keys: jax.lax.map(draw, keys))(jax.random.split(jax.random.key(1), ROUNDS))).ravel()
    counts = np.bincount(drawn, minlength=SIZE)
    assert counts[wanted == 0].sum() == 0
    expected = wanted * len(drawn)
    often = expected > 5
    statistic = float(((counts - expected)[often] ** 2 / expected[often]).sum())
    # The 99.9 % quantile of chi-square, by Wilson and Hilferty.
    freedom = often.sum() - 1
    assert statistic < freedom * (1 - 2 / (9 * freedom) + 3.09 * np.sqrt(2 / (9 * freedom))) ** 3


@pytest.mark.parametrize("temperature", [0.0, 0.5, 1.0])
def test_log_probabilities_are_of_the_whole_distribution(temperature: float) -> None:
    rows = np.random.default_rng(1).normal(0, 3.0, (5, 33)).astype(np.float32)
    tokens, found = sample_tokens(jnp.asarray(rows), jnp.full(5, 0.4), temperature, top_k=3)
    scaled = rows / (temperature or 1.0)
    for row in range(5):
        wanted = scaled[row, tokens[row]] - np.log(np.exp(scaled[row].astype(np.float64)).sum())
        assert found[row] == pytest.approx(wanted, abs=1e-5)
    if temperature == 0.0:
        np.testing.assert_array_equal(tokens, rows.argmax(axis=1))


def test_what_top_k_and_top_p_keep_is_what_a_loop_keeps() -> None:
    rng = np.random.default_rng(2)
    for top_k, top_p in [(1, 1.0), (5, 1.0), (0, 0.5), (0, 1e-6), (9, 0.9)]:
        weights = np.exp(rng.normal(0, 2, (8, 41))).astype(np.float32)
        weights /= weights.max(axis=1, keepdims=True)
        kept = np.asarray(kept_weights(jnp.asarray(weights), top_k, top_p))
        for row in range(8):
            wanted = kept_by_loop(weights[row].astype(np.float64) / weights[row].sum(), top_k, top_p)
            np.testing.assert_array_equal(kept[row] > 0, wanted > 0)


def test_the_ends_of_the_distribution_are_reached_and_never_passed() -> None:
    weights = jnp.asarray([[0.0, 1.0, 0.0, 0.0, 3.0, 0.0]])
    for uniform, token in [(0.0, 1), (0.2499, 1), (0.2501, 4), (1.0 - 2**-24, 4)]:
        assert int(look_up(weights, jnp.asarray([uniform]))[0]) == token
    many = jnp.asarray(np.random.default_rng(3).random((64, 5000)).astype(np.float32)).at[:, 4000:].set(0.0)
    assert int(look_up(many, jnp.full(64, 1.0 - 2**-24)).max()) < 4000


def test_a_token_of_probability_one_is_drawn_whatever_the_number() -> None:
    rows = jnp.full((16, 50), -1e9).at[:, 17].set(3.0)
    tokens, log_probs = sample_tokens(rows, jnp.linspace(0.0, 0.999, 16))
    assert set(np.asarray(tokens).tolist()) == {17}
    np.testing.assert_allclose(log_probs, 0.0, atol=1e-6)
