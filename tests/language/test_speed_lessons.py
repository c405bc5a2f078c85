"""What makes the language learners fast is still so, told from their programs: no `[B, T, V]` array, flat products, one uniform a row.

What each naive form costs is measured by `benchmarks/language_lessons.py`.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from language.make_reference import REFERENCE
from thorndike.language import decoder, generation
from thorndike.language import dpo as direct
from thorndike.language import grpo as groups
from thorndike.language.comparisons import comparison_data, preferred
from thorndike.language.decoder import initial_params
from thorndike.language.model_config import read_model_config
from thorndike.language.rollouts import Rollout, distance
from thorndike.language.sft import Config as SftConfig
from thorndike.language.sft import TextBatch, sft

# No other axis has the vocabulary's size.
CONFIG = replace(read_model_config(REFERENCE / "llama"), vocab_size=101)
PARAMS = initial_params(CONFIG, jax.random.key(0))
V, B, T, N = CONFIG.vocab_size, 6, 12, 5
ROWS = 8
"""Rows of logits that may be in memory at once here."""
TOKENS = jnp.asarray(np.random.default_rng(0).integers(10, 90, (B, T)), jnp.int32)
SEGMENTS = jnp.ones_like(TOKENS)
ROLLOUT = Rollout(TOKENS, SEGMENTS, jnp.zeros((B, N)), jnp.ones((B, N), bool), jnp.zeros(B, bool))


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(decoder, "_CHUNK", ROWS * V)
    # What was traced with larger chunks must not be found again.
    jax.clear_caches()
    yield
    jax.clear_caches()


def equations(jaxpr) -> Iterator:
    """All of a program, what is called and looped over included."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from equations(inner)


def program(function: Callable, *arguments) -> list:
    return list(equations(jax.make_jaxpr(function)(*arguments).jaxpr))


def widest_logits(found: list) -> int:
    """The most rows of an array whose last axis is the vocabulary."""
    shapes = [var.aval.shape for equation in found for var in equation.outvars if getattr(var.aval, "shape", ())]
    return max((int(np.prod(shape[:-1])) for shape in shapes if shape[-1] == V), default=0)


def sft_gradient() -> list:
    learner = sft(SftConfig(total_steps=1), CONFIG)
    state = learner.init(PARAMS, jax.random.key(0))
    return program(lambda s: learner.update(s, (), TextBatch(TOKENS, SEGMENTS, SEGMENTS > 0)), state)


def dpo_gradient() -> list:
    rows = [[int(token) for token in row] for row in TOKENS]
    pairs = comparison_data([preferred(one[:4], one[4:], other[4:]) for one, other in zip(rows[::2], rows[1::2], strict=True)], 0)
    batch = direct.Batch(pairs.rows(np.arange(len(pairs.valid))), jnp.zeros(pairs.valid.shape))
    learner = direct.dpo(direct.Config(total_steps=1, batch_size=B // 2), CONFIG)
    return program(lambda s: learner.update(s, (), batch), learner.init(PARAMS, jax.random.key(0)))


def grpo_gradient() -> list:
    config = groups.Config(episodes=B, group=2, batch_size=B, max_new_tokens=N)
    batch = groups.Batch(ROLLOUT, jnp.zeros((B, N)), jnp.ones(B))
    return program(jax.grad(lambda p: groups.grpo_loss(p, batch, CONFIG, config, jnp.float32(0.1))[0]), PARAMS)


def distances() -> list:
    return program(lambda p: distance(p, PARAMS, CONFIG, ROLLOUT, 1.0), PARAMS)


@pytest.mark.parametrize("build", [sft_gradient, dpo_gradient, grpo_gradient, distances])
def test_no_more_logits_are_alive_than_a_chunk(build, small_chunks):
    assert 0 < widest_logits(build()) <= ROWS


def test_the_naive_form_is_seen():
    naive = program(lambda p: decoder.logits(p, CONFIG, decoder.hidden_states(p, CONFIG, TOKENS, SEGMENTS)), PARAMS)
    assert widest_logits(naive) == B * T


@pytest.mark.parametrize("build", [dpo_gradient, grpo_gradient])
def test_products_with_parameters_are_of_flat_rows_in_both_directions(build):
    weights = {leaf.shape for leaf in jax.tree.leaves(PARAMS) if leaf.ndim == 2}
    weights |= {shape[::-1] for shape in weights}
    products = [equation for equation in build() if equation.primitive.name == "dot_general"]
    with_weights = [e for e in products if any(var.aval.shape in weights for var in (*e.invars, *e.outvars))]
    assert len(with_weights) >= 3 * 4 * CONFIG.num_layers
    assert {var.aval.ndim for equation in with_weights for var in equation.invars} == {2}


def generation_program() -> list:
    def write(params):
        return generation.generate(
            params, CONFIG, TOKENS, SEGMENTS, jax.random.key(0), max_new_tokens=N, stop_tokens=(), pad_id=0
        )  # fmt: skip

    return program(write, PARAMS)


def test_generation_draws_one_number_a_row_and_keeps_one_a_token():
    found = generation_program()
    drawn = [var.aval for e in found if e.primitive.name in ("random_bits", "threefry2x32") for var in e.outvars]
    assert drawn and max(int(np.prod(aval.shape)) for aval in drawn) <= N * B
    assert widest_logits(found) <= B


def test_generation_has_its_layers_unrolled_and_its_cache_written_in_place():
    loops = [equation for equation in generation_program() if equation.primitive.name == "while"]
    [writing] = [loop for loop in loops if len(loop.params["body_jaxpr"].jaxpr.eqns) > 50]
    body = list(equations(writing.params["body_jaxpr"].jaxpr))
    assert not any(equation.primitive.name == "scan" for equation in body)
    slots = (B, T + N, CONFIG.num_kv_heads, CONFIG.head_dim)
    made = [e.primitive.name for e in body if any(getattr(var.aval, "shape", ()) == slots for var in e.outvars)]
    assert made.count("dynamic_update_slice") == 2 * CONFIG.num_layers
    # Anything else of the cache's size would be a copy of it in every step.
    assert set(made) <= {"dynamic_update_slice", "jit"}


def test_rematerialised_layers_give_the_same_gradient():
    def loss(params, remat):
        return jnp.sum(jnp.square(decoder.hidden_states(params, CONFIG, TOKENS, SEGMENTS, remat)))

    kept, again = (jax.grad(loss)(PARAMS, remat) for remat in (False, True))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=2e-4, atol=1e-4), kept, again)
