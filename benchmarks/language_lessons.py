"""What made language models fast on a CPU, each naive form beside ours: `python benchmarks/language_lessons.py [--repeats 5]`.

CPU-milliseconds at 1.07 M parameters, 128 texts of 32 tokens, one core and one thread, alternating; medians, and ratio naive / ours. Exits
with 1 where a naive form is the faster one: then a lesson is no longer true, or what was learnt from it is lost. Written to
results/language/lessons.json.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from language_models import config_of
from machine import commit, processor
from thorndike import startup
from thorndike.functional.token_sampling import look_up
from thorndike.language import decoder
from thorndike.language.decoder import decode_step, hidden_states, initial_params, logits, prefill, token_log_probs

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "language" / "lessons.json"
PLAIN = "--plain-memory"
SLOWER = 0.95
"""Below this ratio a naive form is said to be the faster one: less is noise."""
BATCH, LENGTH, NEW = 128, 32, 24
CONFIG = config_of("1.07 M")
Form = Callable[[], jax.Array]


class Given(NamedTuple):
    """What all forms compute with."""

    params: decoder.Params
    tokens: jax.Array


def given() -> Given:
    tokens = jax.random.randint(jax.random.key(1), (BATCH, LENGTH), 3, CONFIG.vocab_size)
    return Given(initial_params(CONFIG, jax.random.key(0)), tokens)


def flat_rows(own: Given) -> tuple[Form, Form]:
    """The gradient of two dense layers: of ``[B, T, d]`` as it is, or of ``[B T, d]``."""
    x = jax.random.normal(jax.random.key(2), (BATCH, LENGTH, CONFIG.hidden_size))
    weights = own.params["layers"][0]["up"]["kernel"], own.params["layers"][0]["down"]["kernel"]

    def loss(weights: tuple[jax.Array, jax.Array], rows: jax.Array) -> jax.Array:
        inner = jnp.tanh(rows @ weights[0])[..., : CONFIG.intermediate_size]
        return jnp.sum(jnp.square(inner @ weights[1]))

    gradient = jax.jit(jax.grad(loss, (0, 1)))
    flat = x.reshape(-1, CONFIG.hidden_size)
    return lambda: gradient(weights, x)[1], lambda: gradient(weights, flat)[1]


def chosen_logit(own: Given) -> tuple[Form, Form]:
    """The gradient of log-probabilities: the target picked out of ``[B, T, V]``, or as a product of two rows."""
    hidden = jax.jit(lambda params: hidden_states(params, CONFIG, own.tokens))(own.params)

    def picked(params: decoder.Params, hidden: jax.Array) -> jax.Array:
        every = jax.nn.log_softmax(logits(params, CONFIG, hidden[:, :-1]))
        return jnp.sum(jnp.take_along_axis(every, own.tokens[:, 1:, None], axis=-1))

    def product(params: decoder.Params, hidden: jax.Array) -> jax.Array:
        return jnp.sum(token_log_probs(params, CONFIG, hidden[:, :-1], own.tokens[:, 1:]))

    naive, ours = (jax.jit(jax.grad(form, (0, 1))) for form in (picked, product))
    return lambda: naive(own.params, hidden)[1], lambda: ours(own.params, hidden)[1]


def drawing(own: Given) -> tuple[Form, Form]:
    """A token a row: a random number for each of the vocabulary, or one that is looked up in the cumulative weights."""
    scores = jax.random.normal(jax.random.key(3), (BATCH, CONFIG.vocab_size))
    key = jax.random.key(4)
    naive = jax.jit(jax.random.categorical)

    @jax.jit
    def ours(key: jax.Array, scores: jax.Array) -> jax.Array:
        return look_up(jnp.exp(scores - jnp.max(scores, axis=-1, keepdims=True)), jax.random.uniform(key, (BATCH,)))

    return lambda: naive(key, scores), lambda: ours(key, scores)


def cache_in_place(own: Given) -> tuple[Form, Form]:
    """Decoding steps: layers stacked in a scan whose cache goes in and comes out, or unrolled with the cache in the loop's state."""
    prompt = own.tokens[:, :8]
    _, cache = jax.jit(lambda params: prefill(params, CONFIG, prompt, jnp.ones_like(prompt), NEW))(own.params)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *own.params["layers"])
    caches = jnp.stack(cache.keys), jnp.stack(cache.values)
    visible = jnp.ones((BATCH, 8 + NEW), bool)
    positions = jnp.full(BATCH, 8)

    def one(
        stacked: decoder.Params, step: jax.Array, x: jax.Array, both: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        turn = decoder._turns(CONFIG.rope, positions[:, None] + step, jnp.float32)

        def layer(x: jax.Array, inputs: tuple) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            params, keys, values = inputs
            after = []

            def attend(query: jax.Array, key: jax.Array, value: jax.Array) -> jax.Array:
                after.extend(jax.lax.dynamic_update_slice_in_dim(old, new, 8 + step, 1) for old, new in ((keys, key), (values, value)))
                return decoder._attention(CONFIG, query, *after, visible[:, None])

            return decoder._layer(params, x, CONFIG, (BATCH, 1), turn, attend), (after[0], after[1])

        return jax.lax.scan(layer, x, (stacked, *both))

    @jax.jit
    def naive(params: decoder.Params, stacked: decoder.Params, both: tuple[jax.Array, jax.Array]) -> jax.Array:
        def step(number: jax.Array, carry: tuple) -> tuple:
            token, both = carry
            hidden, both = one(stacked, number, params["embedding"][token], both)
            return jnp.argmax(logits(params, CONFIG, decoder._norm(params["norm"], CONFIG, hidden)), axis=-1), both

        return jax.lax.fori_loop(0, NEW, step, (prompt[:, -1], both))[0]

    @jax.jit
    def ours(params: decoder.Params, cache: decoder.Cache) -> jax.Array:
        def step(number: jax.Array, carry: tuple) -> tuple:
            token, cache = carry
            hidden, cache = decode_step(params, CONFIG, token, positions + number, 8 + number, visible, cache)
            return jnp.argmax(logits(params, CONFIG, hidden), axis=-1), cache

        return jax.lax.fori_loop(0, NEW, step, (prompt[:, -1], cache))[0]

    return lambda: naive(own.params, stacked, caches), lambda: ours(own.params, cache)


LESSONS = {"flat rows": flat_rows, "chosen logit": chosen_logit, "drawing": drawing, "cache in place": cache_in_place}


def cpu_ms(form: Form) -> float:
    began = time.process_time()
    jax.block_until_ready(form())
    return 1e3 * (time.process_time() - began)


def whole_step(own: Given, repeats: int) -> dict[str, float]:
    """Forward and backward of the whole model, and its activations in memory, in this process's way with memory."""

    def loss(params: decoder.Params, remat: bool) -> jax.Array:
        return jnp.sum(token_log_probs(params, CONFIG, hidden_states(params, CONFIG, own.tokens, None, remat)[:, :-1], own.tokens[:, 1:]))

    kept, again = (
        jax.jit(jax.grad(lambda params, remat=remat: loss(params, remat))).lower(own.params).compile() for remat in (False, True)
    )
    times = [cpu_ms(lambda: kept(own.params)["norm"]["scale"]) for _ in range(repeats + 1)][1:]
    sizes = {name: each.memory_analysis().temp_size_in_bytes / 2**20 for name, each in (("activations_mb", kept), ("remat_mb", again))}
    return {"cpu_ms": statistics.median(times), **sizes}


def whole_step_without(repeats: int) -> dict[str, float]:
    """The same in a process that leaves memory as it is."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, __file__, PLAIN, "--repeats", str(repeats)]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return json.loads(told.splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(PLAIN, action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.plain_memory:
        print(json.dumps(whole_step(given(), options.repeats)))
        return 0
    startup.prepare_large_steps()
    own = given()
    found: dict[str, dict[str, object]] = {}
    for name, lesson in LESSONS.items():
        naive, ours = lesson(own)
        pairs = [(cpu_ms(naive), cpu_ms(ours)) for _ in range(options.repeats + 1)][1:]
        slow, fast = (statistics.median(each[side] for each in pairs) for side in (0, 1))
        found[name] = {"naive_ms": slow, "ours_ms": fast, "ratio": slow / fast, "raw": pairs}
        print(f"{name}: {slow:.2f} ms -> {fast:.2f} ms, {slow / fast:.2f} times", flush=True)
    plain, kept = whole_step_without(options.repeats), whole_step(own, options.repeats)
    found["memory kept"] = {"naive_ms": plain["cpu_ms"], "ours_ms": kept["cpu_ms"], "ratio": plain["cpu_ms"] / kept["cpu_ms"]}
    found["memory kept"] |= {"naive_mb": plain, "ours_mb": kept}
    print(f"memory kept: {plain} -> {kept}")
    content = {
        "command": "python benchmarks/language_lessons.py",
        "commit": commit(HERE.parent),
        "processor": processor(),
        "lessons": found,
    }
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(content | {"lessons": found}, indent=2) + "\n")
    return int(any(float(str(each["ratio"])) < SLOWER for each in found.values()))


if __name__ == "__main__":
    sys.exit(main())
