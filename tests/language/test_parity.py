"""Tiny models that transformers wrote: the same logits, the same greedy texts, and what is written is what was read."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from language.make_reference import CASES, LORA, REFERENCE, SCORED
from language.make_reference import GREEDY as GREEDY_TOKENS
from thorndike.errors import UserError
from thorndike.language.decoder import hidden_states, initial_params, logits, param_shapes, positions_in, token_divergences, token_log_probs
from thorndike.language.generation import GREEDY, generate
from thorndike.language.lora import LoraConfig, initial_adapter, load_adapter, merged, save_adapter
from thorndike.language.model import LanguageModel, load_decoder, load_model, save_model
from thorndike.language.model_config import FAMILIES, as_json, parse_model_config, read_model_config, with_dtype, write_model_config
from thorndike.language.scalar_head import text_scores, token_values, with_scalar_head
from thorndike.language.tokenizer import load_tokenizer
from thorndike.language.weights import INDEX, load_params, save_params

TOLERANCE = 1e-5
"""Of the largest logit; the promise is 1e-4."""

pytestmark = pytest.mark.usefixtures("quick_compile")
forward = jax.jit(hidden_states, static_argnames=("config", "remat"))


def expected(name: str) -> dict[str, np.ndarray]:
    return load_file(REFERENCE / name / "expected.safetensors")


def inputs(name: str = "llama") -> tuple[jax.Array, jax.Array]:
    arrays = expected(name)
    return jnp.asarray(arrays["tokens"], jnp.int32), jnp.asarray(arrays["mask"], jnp.int32)


def logits_of(name: str) -> np.ndarray:
    config, params = load_decoder(REFERENCE / name)
    tokens, segments = inputs(name)
    return np.asarray(logits(params, config, forward(params, config, tokens, segments)) * segments[..., None])


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@pytest.mark.parametrize("name", CASES)
def test_logits_are_those_of_transformers_with_left_padding(name: str) -> None:
    assert relative(logits_of(name), expected(name)["logits"]) < TOLERANCE


@pytest.mark.parametrize("name", CASES)
def test_greedy_texts_are_those_of_transformers_for_64_tokens(name: str) -> None:
    config, params = load_decoder(REFERENCE / name)
    found = generate(params, config, *inputs(name), jax.random.key(0), max_new_tokens=GREEDY_TOKENS, sampling=GREEDY)
    wanted = expected(name)["greedy"]
    assert len(set(wanted.ravel().tolist())) > 10, "the reference repeats itself: it would not tell a wrong decoder"
    np.testing.assert_array_equal(found.tokens, wanted)


def test_every_family_is_among_the_cases() -> None:
    found = {json.loads((REFERENCE / name / "config.json").read_text())["model_type"] for name in CASES}
    assert found == set(FAMILIES)


@pytest.mark.parametrize("name", ["llama3", "gemma2", "gpt2"])
def test_bfloat16_agrees_on_the_likeliest_token(name: str) -> None:
    """Random models have many near ties, so that a few may differ; the logits are within bfloat16's precision."""
    config, params = load_decoder(REFERENCE / name, dtype="bfloat16")
    tokens, segments = inputs(name)
    found = np.asarray(logits(params, config, forward(params, config, tokens, segments)) * segments[..., None])
    assert params["embedding"].dtype == jnp.bfloat16
    assert relative(found, expected(name)["logits"]) < 0.05


@pytest.mark.parametrize("name", ["llama", "gpt2", "gemma3"])
def test_padding_batches_and_packing_do_not_change_logits(name: str) -> None:
    config, params = load_decoder(REFERENCE / name)
    tokens, segments = inputs(name)
    alone = [np.asarray(row)[np.asarray(mask) > 0] for row, mask in zip(tokens, segments, strict=True)]
    wanted = [expected(name)["logits"][row, -len(text) :] for row, text in enumerate(alone)]
    packed = jnp.asarray(np.concatenate([*alone, [0, 0]])[None])
    numbers = jnp.asarray(np.concatenate([*(np.full(len(text), row + 1) for row, text in enumerate(alone)), [0, 0]])[None], jnp.int32)
    found = np.asarray(logits(params, config, forward(params, config, packed, numbers)))[0, :-2]
    assert relative(found, np.concatenate(wanted)) < TOLERANCE
    right = jnp.asarray(np.pad(alone[2], (0, 20 - len(alone[2])))[None])
    found = np.asarray(logits(params, config, forward(params, config, right, (jnp.arange(20) < len(alone[2])).astype(jnp.int32)[None])))
    assert relative(found[0, : len(alone[2])], wanted[2]) < TOLERANCE


def test_positions_count_from_the_beginning_of_each_text() -> None:
    segments = jnp.asarray([[0, 0, 1, 1, 1], [1, 1, 2, 2, 0]])
    np.testing.assert_array_equal(positions_in(segments)[:, :], [[0, 1, 0, 1, 2], [0, 1, 0, 1, 0]])


@pytest.mark.parametrize("name", ["llama3", "gemma2"])
@pytest.mark.parametrize("temperature", [1.0, 0.7])
def test_log_probabilities_are_those_of_the_whole_distribution(name: str, temperature: float, monkeypatch: pytest.MonkeyPatch) -> None:
    config, params = load_decoder(REFERENCE / name)
    tokens, segments = inputs(name)
    hidden = forward(params, config, tokens, segments)
    wanted = jnp.take_along_axis(jax.nn.log_softmax(logits(params, config, hidden) / temperature), tokens[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(token_log_probs(params, config, hidden, tokens, temperature), wanted, atol=1e-5)

    def total(hidden: jax.Array) -> jax.Array:
        return jnp.sum(token_log_probs(params, config, hidden, tokens, temperature))

    gradient = jax.grad(total)(hidden)
    monkeypatch.setattr("thorndike.language.decoder._CHUNK", 7 * config.vocab_size)
    np.testing.assert_allclose(token_log_probs(params, config, hidden, tokens, temperature), wanted, atol=1e-5)
    np.testing.assert_allclose(jax.grad(total)(hidden), gradient, atol=1e-5)


def test_the_divergence_of_two_models_is_the_sum_over_the_vocabulary(monkeypatch: pytest.MonkeyPatch) -> None:
    config, params = load_decoder(REFERENCE / "llama")
    other = jax.tree.map(lambda leaf: 0.9 * leaf, params)
    tokens, segments = inputs()
    hidden, theirs = (forward(each, config, tokens, segments) for each in (params, other))
    p, q = (np.asarray(jax.nn.log_softmax(logits(each, config, x) / 0.7), np.float64) for each, x in ((params, hidden), (other, theirs)))
    for chunk in (2**24, 7 * config.vocab_size):
        monkeypatch.setattr("thorndike.language.decoder._CHUNK", chunk)
        found = np.asarray(token_divergences(params, hidden, other, theirs, config, 0.7))
        np.testing.assert_allclose(found, (np.exp(p) * (p - q)).sum(-1), atol=1e-5)
        assert found.shape == tokens.shape and found.min() >= 0


def test_recomputed_layers_have_the_same_gradient() -> None:
    config, params = load_decoder(REFERENCE / "llama")
    tokens, segments = inputs()

    def loss(params: dict, remat: bool) -> jax.Array:
        return jnp.sum(jnp.square(hidden_states(params, config, tokens, segments, remat)))

    kept, again = (jax.jit(jax.grad(loss), static_argnums=1)(params, remat) for remat in (False, True))
    for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", [*CASES, *(f"{name}_scored" for name in SCORED)])
def test_what_is_written_is_what_was_read(name: str, tmp_path: Path) -> None:
    config, params = load_decoder(REFERENCE / name)
    write_model_config(config, tmp_path)
    save_params(params, config, tmp_path, shard_bytes=50_000)
    assert (tmp_path / INDEX).exists() and len(list(tmp_path.glob("*.safetensors"))) > 1
    again = read_model_config(tmp_path)
    assert replace(again, source="") == replace(config, source="")
    for one, other in zip(jax.tree.leaves(params), jax.tree.leaves(load_params(tmp_path, again)), strict=True):
        np.testing.assert_array_equal(one, other)
    files = [path for path in (REFERENCE / name).glob("model*.safetensors")]
    theirs = {key: array for path in files for key, array in load_file(path).items()}
    ours = {key: array for path in tmp_path.glob("*.safetensors") for key, array in load_file(path).items()}
    assert theirs.keys() == ours.keys()
    assert all(np.array_equal(theirs[key], ours[key]) for key in theirs)


@pytest.mark.parametrize("name", SCORED)
def test_scores_are_those_of_transformers(name: str) -> None:
    config, params = load_decoder(REFERENCE / f"{name}_scored")
    tokens, segments = inputs()
    wanted = expected(f"{name}_scored")["scores"]
    assert relative(np.asarray(text_scores(params, config, tokens, segments)), wanted) < TOLERANCE
    np.testing.assert_allclose(token_values(params, config, tokens, segments)[:, -1], wanted, rtol=1e-4, atol=1e-5)
    flipped = jnp.stack([jnp.roll(row, -(20 - length)) for row, length in zip(tokens, (20, 17, 9), strict=True)])
    mask = jnp.stack([jnp.roll(row, -(20 - length)) for row, length in zip(segments, (20, 17, 9), strict=True)])
    assert relative(np.asarray(text_scores(params, config, flipped, mask)), wanted) < TOLERANCE


def test_a_scalar_head_takes_the_place_of_the_output_layer() -> None:
    config, params = load_decoder(REFERENCE / "llama")
    scored, scoring = with_scalar_head(params, config, jax.random.key(0), zero=True)
    assert jax.tree.map(jnp.shape, scored) == jax.tree.map(lambda leaf: leaf.shape, param_shapes(scoring))
    tokens, segments = inputs()
    np.testing.assert_array_equal(text_scores(scored, scoring, tokens, segments, "mean"), np.zeros(3))
    assert as_json(scoring)["architectures"] == ["LlamaForSequenceClassification"]
    with pytest.raises(UserError, match="pad_token_id"):
        with_scalar_head(params, parse_model_config(as_json(config) | {"pad_token_id": None}), jax.random.key(0))


@pytest.mark.parametrize("name", LORA)
def test_a_merged_adapter_gives_the_logits_of_peft(name: str, tmp_path: Path) -> None:
    config, params = load_decoder(REFERENCE / name)
    adapter = load_adapter(REFERENCE / f"{name}_lora", config)
    tokens, segments = inputs(name)
    save_adapter(adapter, config, tmp_path)
    for each in (adapter, load_adapter(tmp_path, config)):
        found = logits(params, config, forward(merged(params, config, each), config, tokens, segments))
        assert relative(np.asarray(found * segments[..., None]), expected(f"{name}_lora")["logits"]) < TOLERANCE
    theirs, ours = (load_file(folder / "adapter_model.safetensors") for folder in (REFERENCE / f"{name}_lora", tmp_path))
    assert theirs.keys() == ours.keys() and all(np.array_equal(theirs[key], ours[key]) for key in theirs)


def test_a_new_adapter_changes_nothing_but_has_a_gradient() -> None:
    config, params = load_decoder(REFERENCE / "llama")
    adapter = initial_adapter(config, LoraConfig(rank=2, target_modules=("q_proj", "up_proj")), jax.random.key(0))
    assert sorted(adapter.pairs)[0] == "model.layers.0.mlp.up_proj" and len(adapter.pairs) == 4
    tokens, segments = inputs()

    def loss(pairs: dict) -> jax.Array:
        return jnp.sum(jnp.square(hidden_states(merged(params, config, adapter._replace(pairs=pairs)), config, tokens, segments)))

    np.testing.assert_allclose(loss(adapter.pairs), jnp.sum(jnp.square(hidden_states(params, config, tokens, segments))), rtol=1e-6)
    gradient = jax.grad(loss)(adapter.pairs)
    assert all(float(jnp.abs(pair.up).max()) > 0 for pair in gradient.values())
    with pytest.raises(UserError, match="q_proj"):
        initial_adapter(config, LoraConfig(target_modules=("q_pro",)), jax.random.key(0))
    with pytest.raises(UserError, match="adapts nothing"):
        load_adapter(REFERENCE / "gpt2_lora", config)


def test_initial_parameters_have_the_shapes_and_the_spread_that_training_needs() -> None:
    config = read_model_config(REFERENCE / "gemma3")
    params = initial_params(config, jax.random.key(1))
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(lambda leaf: leaf.shape, param_shapes(config))
    assert 0.015 < float(jnp.std(params["embedding"])) < 0.025
    tokens, segments = inputs()
    loss = -jnp.mean(token_log_probs(params, config, forward(params, config, tokens, segments), tokens))
    assert abs(float(loss) - np.log(96)) < 0.3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model_type": "lama"}, "did you mean 'llama'"),
        ({"model_type": "mamba"}, "not supported"),
        ({"hidden_act": "mish"}, "hidden_act 'mish' is not supported"),
        ({"rope_parameters": {"rope_type": "yarn", "rope_theta": 1e4, "factor": 2.0}}, "rope_type 'yarn' is not supported"),
        ({"rope_parameters": {"rope_type": "llama3", "rope_theta": 1e4, "factor": 2.0}}, "low_freq_factor"),
        ({"partial_rotary_factor": 0.5}, "partial_rotary_factor"),
        ({"hidden_size": "32"}, "hidden_size"),
        ({"num_key_value_heads": 3}, "do not share"),
        ({"dtype": "float8"}, "dtype"),
        ({"architectures": ["LlamaForSequenceClassification"]}, "num_labels"),
        ({"pretraining_tp": 2}, "pretraining_tp"),
    ],
)
def test_what_is_not_supported_is_refused_in_one_line(changes: dict, words: str) -> None:
    content = json.loads((REFERENCE / "llama" / "config.json").read_text())
    with pytest.raises(UserError, match=words) as refused:
        parse_model_config(content | changes)
    assert "\n" not in str(refused.value)


def test_keys_of_transformers_4_say_the_same() -> None:
    for name in CASES:
        content = json.loads((REFERENCE / name / "config.json").read_text())
        config = parse_model_config(content)
        both = as_json(config)
        assert parse_model_config(both).rope == config.rope
        old = {key: value for key, value in both.items() if key not in ("rope_parameters", "dtype", "layer_types")}
        older = parse_model_config(old)
        assert (older.rope, older.local_rope, older.windows, older.dtype) == (
            config.rope,
            config.local_rope,
            config.windows,
            config.dtype,
        ), name


def test_texts_longer_than_the_model_reads_exactly_are_refused() -> None:
    config, params = load_decoder(REFERENCE / "llama_dynamic")
    with pytest.raises(UserError, match="129 tokens"):
        hidden_states(params, config, jnp.zeros((1, 129), jnp.int32))
    with pytest.raises(UserError, match="tokens is longer"):
        generate(params, config, *inputs(), jax.random.key(0), max_new_tokens=120)


def test_folders_that_are_no_models_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no folder"):
        load_model(tmp_path / "nothing")
    with pytest.raises(UserError, match=r"no config\.json"):
        load_model(tmp_path)
    (tmp_path / "config.json").write_bytes((REFERENCE / "llama" / "config.json").read_bytes())
    (tmp_path / "pytorch_model.bin").write_bytes(b"")
    with pytest.raises(UserError, match="pickle"):
        load_decoder(tmp_path)
    (tmp_path / "model.safetensors").write_bytes((REFERENCE / "qwen3" / "model.safetensors").read_bytes())
    with pytest.raises(UserError, match="shape"):
        load_decoder(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="cannot be read"):
        load_decoder(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    (tmp_path / INDEX).write_text(json.dumps({"weight_map": {"a": "../other.safetensors"}}))
    with pytest.raises(UserError, match="damaged"):
        load_decoder(tmp_path)


def test_a_saved_model_is_a_folder_with_everything_and_is_never_written_over(tmp_path: Path) -> None:
    config, params = load_decoder(REFERENCE / "llama")
    model = LanguageModel(config, params, load_tokenizer(REFERENCE / "tokenizer"))
    save_model(model._replace(config=with_dtype(config, "bfloat16")), tmp_path / "out")
    again = load_model(tmp_path / "out")
    assert again.config.dtype == "bfloat16" and again.tokenizer.eos_id == model.tokenizer.eos_id
    assert {"config.json", "generation_config.json", "model.safetensors", "tokenizer.json"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
    assert load_model(tmp_path / "out", dtype="float32").params["embedding"].dtype == jnp.float32
    with pytest.raises(UserError, match="never written over"):
        save_model(model, tmp_path / "out")
