"""Learners whose batches several devices share, and those that compute in bfloat16: the results of one device in float32, to tolerance."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.language.model import load_decoder
from thorndike.language.model_config import with_dtype
from thorndike.language.sft import Config as SftConfig
from thorndike.language.sft import TextBatch, sft
from thorndike.training.devices import rows_shared, same_everywhere, sharing_rows

pytestmark = pytest.mark.usefixtures("quick_compile")

# In a process of its own: JAX chooses its devices once.
SHARED = """
import sys
from dataclasses import replace
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_disable_most_optimizations", True)
from thorndike.language import dpo as direct, grpo as groups, ppo as proximal
from thorndike.language.comparisons import comparison_data, preferred
from thorndike.language.model import load_decoder
from thorndike.language.rollouts import Prompts, distance, sample_rollout
from thorndike.language.sft import Config as SftConfig, TextBatch, sft
from thorndike.training.devices import rows_shared, sharing_rows

assert jax.device_count() == 2
config, params = load_decoder(Path(sys.argv[1]) / "llama")
draws = np.random.default_rng(0)
texts = draws.integers(10, 90, (8, 12))
tokens = jnp.asarray(texts, jnp.int32)
prompts = Prompts(texts[:, :5].astype(np.int32), np.ones((8, 5), np.int32), tuple("abcdefgh"))
score = jnp.asarray(draws.normal(size=8), jnp.float32)

def learnt_by_sft():
    learner = sft(SftConfig(total_steps=2, learning_rate=1e-2, gradient_accumulation=2, batch_size=8), config)
    state = learner.init(params, jax.random.key(0))
    state, _ = jax.jit(learner.update)(state, (), TextBatch(tokens, jnp.ones_like(tokens), tokens > 0))
    return learner.params(state, ())

def learnt_by_dpo():
    rows = comparison_data([preferred(one[:4], one[4:], other[4:]) for one, other in zip(texts[::2], texts[1::2])], 0)
    learner = direct.dpo(direct.Config(total_steps=2, batch_size=4, learning_rate=1e-2), config)
    reference = direct.reference_log_probs(params, config, rows, 4)
    state = learner.init(params, jax.random.key(0))
    state, _ = jax.jit(learner.update)(state, (), direct.Batch(rows.rows(np.arange(4)), jnp.asarray(reference)))
    return learner.params(state, ())

def learnt_by(learner):
    state = learner.init(jax.random.key(0))
    rollout = sample_rollout(params, config, prompts, np.arange(8 // learner.samples), jax.random.key(1), max_new_tokens=5,
                             temperature=1.0, stop_tokens=(7,), pad_id=0, samples=learner.samples)
    found = distance(params, params, config, rollout, 1.0)
    places = {str(rollout.tokens.sharding), str(found.log_probs.sharding)}
    state, _ = learner.update(state, rollout, found, score, jax.random.key(2))
    return learner.params(state), rollout.tokens, places

def learnt_by_policies():
    grpo, written, places = learnt_by(groups.grpo(groups.Config(**SMALL, group=4), config, params))
    ppo, _, _ = learnt_by(proximal.ppo(proximal.Config(**SMALL, n_epochs=1), config, params))
    return [grpo, ppo, written], places

SMALL = dict(total_steps=2, episodes=8, batch_size=4, max_prompt_length=5, max_new_tokens=5, learning_rate=1e-2)

def everything():
    learnt, places = [learnt_by_sft()], {"rows"}
    if sys.argv[2] == "all":
        policies, places = learnt_by_policies()
        learnt += [learnt_by_dpo(), *policies]
    return learnt, places

alone, _ = everything()
with sharing_rows(2):
    together, places = everything()
    halves = rows_shared(tokens)
assert len(halves.addressable_shards) == 2 and halves.addressable_shards[0].data.shape == (4, 12)
assert all("rows" in place for place in places), places
flat = lambda tree: np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in jax.tree.leaves(tree)])
for number, (one, other) in enumerate(zip(alone, together)):
    if number == 4:
        assert np.array_equal(one, other), "the same tokens were written"
        continue
    # Adam makes the rounding of tiny gradients large, so that lengths are compared and not single numbers.
    moved, gap = np.linalg.norm(flat(one) - flat(params)), np.linalg.norm(flat(one) - flat(other))
    assert moved > 0.1 and gap < 2e-3 * moved, (number, moved, gap)
print("equal")
"""


@pytest.mark.parametrize("which", ["sft", pytest.param("all", marks=pytest.mark.slow)])
def test_two_devices_that_share_rows_learn_what_one_does(which, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    monkeypatch.setenv("NPROC", "2")
    words = [sys.executable, "-c", SHARED, str(REFERENCE), which]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout.strip() == "equal", done.stderr[-3000:]


def test_one_device_leaves_everything_as_it_is():
    rows = {"a": jnp.ones((4, 2))}
    with sharing_rows(1):
        assert rows_shared(rows) is rows and same_everywhere(rows) is rows


def test_bfloat16_activations_move_float32_parameters_the_same_way():
    config, params = load_decoder(REFERENCE / "llama")
    tokens = jnp.asarray(np.random.default_rng(0).integers(10, 90, (4, 12)), jnp.int32)
    batch = TextBatch(tokens, jnp.ones_like(tokens), tokens > 0)
    moved = {}
    for dtype in ("float32", "bfloat16"):
        learner = sft(SftConfig(total_steps=2, learning_rate=1e-3), with_dtype(config, dtype))
        state = learner.init(params, jax.random.key(0))
        after, _ = jax.jit(learner.update)(state, (), batch)
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(after.trained))
        changes = jax.tree.map(lambda new, old: (new - old).ravel(), after.trained, state.trained)
        moved[dtype] = np.concatenate([np.asarray(each) for each in jax.tree.leaves(changes)])
    one, other = moved["float32"], moved["bfloat16"]
    assert not np.array_equal(one, other), "it was computed in bfloat16"
    assert float(one @ other / np.linalg.norm(one) / np.linalg.norm(other)) > 0.9
