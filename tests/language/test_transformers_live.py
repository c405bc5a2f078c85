"""With transformers installed (``pip install 'thorndike[reference]'``): it loads what is written here; the references are its answers."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from language.make_reference import CASES, CHATS, LORA, MESSAGES, REFERENCE, answers, inputs, make_model, make_tokenizer, scores
from thorndike.language.decoder import hidden_states, initial_params, logits
from thorndike.language.lora import load_adapter, merged, save_adapter
from thorndike.language.model import LanguageModel, load_decoder, load_model, save_model
from thorndike.language.model_config import read_model_config
from thorndike.language.scalar_head import text_scores, with_scalar_head
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.slow
transformers = pytest.importorskip("transformers")
torch = pytest.importorskip("torch")


def ours(params: dict, config: object) -> np.ndarray:
    tokens, mask = jnp.asarray(inputs()[0].numpy(), jnp.int32), jnp.asarray(inputs()[1].numpy(), jnp.int32)
    return np.asarray(logits(params, config, hidden_states(params, config, tokens, mask)) * mask[..., None])


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@pytest.mark.parametrize("name", CASES)
def test_the_references_are_what_transformers_answers_today(name: str) -> None:
    found, wanted = answers(make_model(name)), load_file(REFERENCE / name / "expected.safetensors")
    assert relative(found["logits"].numpy(), wanted["logits"]) < 1e-5
    np.testing.assert_array_equal(found["greedy"].numpy(), wanted["greedy"])


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_transformers_loads_what_is_written_here(name: str, dtype: str, tmp_path: Path) -> None:
    config = read_model_config(REFERENCE / name)
    params = initial_params(config, jax.random.key(3))
    params = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(leaf.size), leaf.shape), params)
    model = LanguageModel(config, params, load_tokenizer(REFERENCE / "tokenizer"))
    save_model(model, tmp_path / "out", shard_bytes=60_000)
    loaded = transformers.AutoModelForCausalLM.from_pretrained(
        tmp_path / "out", attn_implementation="eager", dtype=getattr(torch, dtype)
    ).eval()
    with torch.no_grad():
        tokens, mask, positions = inputs()
        theirs = loaded(input_ids=tokens, attention_mask=mask, position_ids=positions).logits.float() * mask[..., None]
    again = load_model(tmp_path / "out", dtype=dtype)
    found = ours(again.params, again.config)
    assert relative(found, theirs.numpy()) < (1e-5 if dtype == "float32" else 0.03)
    if dtype == "bfloat16":
        real = mask.numpy() > 0
        best, second = np.sort(theirs.numpy()[real], axis=-1)[:, -1], np.sort(theirs.numpy()[real], axis=-1)[:, -2]
        clear = best - second > 0.02 * np.abs(theirs.numpy()).max()
        agrees = (found[real].argmax(-1) == theirs.numpy()[real].argmax(-1))[clear]
        assert agrees.mean() >= 0.99
    assert transformers.AutoTokenizer.from_pretrained(tmp_path / "out")("the film")["input_ids"] == model.tokenizer.encode("the film")


@pytest.mark.parametrize("name", CASES)
def test_transformers_loads_scalar_heads(name: str, tmp_path: Path) -> None:
    config, params = load_decoder(REFERENCE / name)
    if config.pad_token_id is None:
        pytest.fail("the case has no padding token")
    scored, scoring = with_scalar_head(params, config, jax.random.key(0))
    save_model(LanguageModel(scoring, scored, load_tokenizer(REFERENCE / "tokenizer")), tmp_path / "out")
    loaded = transformers.AutoModelForSequenceClassification.from_pretrained(tmp_path / "out", attn_implementation="eager").eval()
    assert loaded.config.num_labels == 1
    tokens, mask, _ = inputs()
    found = text_scores(scored, scoring, jnp.asarray(tokens.numpy(), jnp.int32), jnp.asarray(mask.numpy(), jnp.int32))
    assert relative(np.asarray(found), scores(loaded).numpy()) < 1e-4


@pytest.mark.parametrize("name", LORA)
def test_peft_loads_adapters_written_here(name: str, tmp_path: Path) -> None:
    peft = pytest.importorskip("peft")
    config, params = load_decoder(REFERENCE / name)
    adapter = load_adapter(REFERENCE / f"{name}_lora", config)
    pairs = jax.tree.map(lambda leaf: leaf + 0.2 * jax.random.normal(jax.random.key(leaf.size), leaf.shape), adapter.pairs)
    adapter = adapter._replace(pairs=pairs)
    save_adapter(adapter, config, tmp_path, base_model=str(REFERENCE / name))
    loaded = peft.PeftModel.from_pretrained(make_model(name), tmp_path).merge_and_unload()
    assert relative(ours(merged(params, config, adapter), config), answers(loaded)["logits"].numpy()) < 1e-4


def test_chats_and_versions() -> None:
    tokenizer = make_tokenizer()
    expected = json.loads((REFERENCE / "tokenizer" / "expected.json").read_text(encoding="utf-8"))["chats"]
    for name, template in CHATS.items():
        assert tokenizer.apply_chat_template(MESSAGES, chat_template=template, tokenize=False) == expected[name]
    assert json.loads((REFERENCE / "versions.json").read_text())["transformers"] == transformers.__version__
