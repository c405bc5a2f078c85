"""With TRL, transformers and peft installed (``pip install 'thorndike[reference]'``): they read what a chain of commands leaves behind.

A store is judged and exported, TRL trains on every export; a reward model that was trained here, a policy that GRPO, PPO or DPO aligned
here and the adapter of a LoRA run are loaded by the libraries that users will load them with, and say the same numbers.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.language.aligning import align, align_by_preferences, parse_reward, train_reward_model
from thorndike.language.decoder import hidden_states, initial_params, logits
from thorndike.language.fine_tuning import fine_tune
from thorndike.language.lora import LoraConfig
from thorndike.language.model import LanguageModel, load_model, save_model
from thorndike.language.over_optimisation import Limits
from thorndike.language.preferences.formats import export_rows
from thorndike.language.preferences.judgements import Candidate, NewItem
from thorndike.language.preferences.raters import crowd, let_them_judge
from thorndike.language.preferences.records import write_records
from thorndike.language.preferences.store import Store
from thorndike.language.pretraining import Config as ModelSize
from thorndike.language.pretraining import small_llama
from thorndike.language.reward_files import load_reward_model
from thorndike.language.sft import Config as SftConfig
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.slow
trl = pytest.importorskip("trl")
transformers = pytest.importorskip("transformers")
datasets = pytest.importorskip("datasets")
torch = pytest.importorskip("torch")

SIZE = ModelSize(hidden_size=32, num_layers=2, num_heads=2, intermediate_size=48, max_positions=64)
WORDS = ["the film was good", "a bad film", "what a fine cast", "not my taste", "dull and long", "I laughed", "a mess", "so warm"]
TRAINERS = {
    "preference": ("DPO", "Reward"),
    "implicit": ("DPO", "Reward"),
    "unpaired": ("KTO",),
    "prompt_only": ("GRPO",),
    "prompt_completion": ("SFT",),
}


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """A small model's folder."""
    tokenizer = load_tokenizer(REFERENCE / "tokenizer")
    config = small_llama(SIZE, tokenizer)
    params = jax.tree.map(lambda leaf: leaf * 4, initial_params(config, jax.random.key(0)))
    folder = tmp_path_factory.mktemp("base") / "model"
    save_model(LanguageModel(config, params, tokenizer), folder)
    return folder


def question(number: int, answers: tuple[str, str]) -> NewItem:
    return NewItem({"text": f"Review {number}:"}, [Candidate({"text": f" {answer}"}) for answer in answers], raters=2)


@pytest.fixture(scope="module")
def exports(tmp_path_factory) -> dict[str, Path]:
    """A store that a crowd has judged, as files."""
    folder, found = tmp_path_factory.mktemp("exports"), {}
    with Store(folder / "prefs.db") as store:
        project = store.project("films")
        pairs = [(one, other) for one in WORDS for other in WORDS if one < other]
        store.add_items(project, [question(number, pair) for number, pair in enumerate(pairs)])
        let_them_judge(store, project, crowd(), lambda prompt, answer: 0.1 * len(str(answer["text"])), seed=0)
        for what in TRAINERS:
            found[what] = folder / f"{what}.jsonl"
            assert write_records(found[what], export_rows(store, project, what)) > 10
    return found


def trained_by_trl(name: str, model: Path, data: Path, out: Path):
    """Two steps; what the trainer says of them."""
    shared = {
        "output_dir": str(out), "max_steps": 2, "per_device_train_batch_size": 4, "use_cpu": True, "bf16": False, "report_to": "none",
        "save_strategy": "no", "disable_tqdm": True, "gradient_checkpointing": False,
    }  # fmt: skip
    rows = datasets.load_dataset("json", data_files=str(data), split="train", cache_dir=str(out / "cache"))
    tokenizer = transformers.AutoTokenizer.from_pretrained(model)
    if name == "Reward":
        loaded = transformers.AutoModelForSequenceClassification.from_pretrained(model, num_labels=1)
        trainer = trl.RewardTrainer(loaded, trl.RewardConfig(**shared), train_dataset=rows, processing_class=tokenizer)
    elif name == "GRPO":
        config = trl.GRPOConfig(**shared, num_generations=2, max_completion_length=4)
        trainer = trl.GRPOTrainer(
            str(model), lambda completions, **columns: [float(len(each)) for each in completions], config, train_dataset=rows,
            processing_class=tokenizer,
        )  # fmt: skip
    else:
        loaded = transformers.AutoModelForCausalLM.from_pretrained(model)
        config = getattr(trl, f"{name}Config")(**shared)
        trainer = getattr(trl, f"{name}Trainer")(loaded, args=config, train_dataset=rows, processing_class=tokenizer)
    return trainer.train()


@pytest.mark.parametrize(("what", "name"), [(what, name) for what, names in TRAINERS.items() for name in names])
def test_trl_trains_on_every_export(what, name, base, exports, tmp_path):
    found = trained_by_trl(name, base, exports[what], tmp_path)
    assert found.global_step == 2 and np.isfinite(found.training_loss)


def logits_here(folder: Path, ids: list[int]) -> np.ndarray:
    model = load_model(folder)
    return np.asarray(logits(model.params, model.config, hidden_states(model.params, model.config, jnp.asarray([ids]))))


def logits_there(model, ids: list[int]) -> np.ndarray:
    with torch.no_grad():
        return model.eval()(input_ids=torch.tensor([ids])).logits.float().numpy()


def test_a_trained_reward_model_says_the_same_in_transformers(base, exports, tmp_path):
    settings = {"total_steps": 20, "learning_rate": 1e-3, "batch_size": 8}
    train_reward_model(base, [exports["preference"]], [], tmp_path / "run", settings)
    model = load_reward_model(tmp_path / "run" / "model")
    loaded = transformers.AutoModelForSequenceClassification.from_pretrained(tmp_path / "run" / "model")
    tokenizer = transformers.AutoTokenizer.from_pretrained(tmp_path / "run" / "model")
    ids = [model.tokenizer.encode(f"Review 3: {words}") for words in WORDS]
    assert ids == [tokenizer(f"Review 3: {words}")["input_ids"] for words in WORDS]
    ours = model.all_scores(ids)[0] * model.deviation + model.mean
    theirs = np.array([logits_there(loaded, each)[0, 0] for each in ids])
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
    padded = tokenizer([f"Review 3: {words}" for words in WORDS], padding=True, return_tensors="pt")
    with torch.no_grad():
        np.testing.assert_allclose(loaded.eval()(**padded).logits[:, 0].numpy(), theirs, rtol=1e-4, atol=1e-5)
    # Not the base's head: it was learnt.
    assert np.std(theirs) > 1e-3


@pytest.mark.parametrize("learner", ["grpo", "ppo", "dpo"])
def test_an_aligned_policy_says_the_same_in_transformers(learner, base, exports, tmp_path):
    run = tmp_path / "run"
    if learner == "dpo":
        align_by_preferences(base, [exports["preference"]], run, {"batch_size": 8, "learning_rate": 1e-3}, progress=False)
    else:
        (tmp_path / "taste.py").write_text("def length(prompts, completions, ids):\n    return [float(len(each)) for each in ids]\n")
        settings = {"total_steps": 2, "episodes": 8, "batch_size": 8, "max_prompt_length": 16, "max_new_tokens": 6, "learning_rate": 1e-3}
        align(
            base, [parse_reward(f"{tmp_path / 'taste.py'}:length")], [exports["prompt_only"]], run, learner,
            settings | ({"group": 4} if learner == "grpo" else {}), limits=Limits(None, None, None, None),
        )  # fmt: skip
    loaded = transformers.AutoModelForCausalLM.from_pretrained(run / "model")
    tokenizer = transformers.AutoTokenizer.from_pretrained(run / "model")
    ids = load_model(run / "model").tokenizer.encode("Review 3: the film was good")
    assert ids == tokenizer("Review 3: the film was good")["input_ids"]
    ours, theirs = logits_here(run / "model", ids), logits_there(loaded, ids)
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4 * np.abs(theirs).max())
    assert np.abs(ours - logits_here(base, ids)).max() > 1e-3, "the policy is not the base"
    written = loaded.generate(torch.tensor([ids]), max_new_tokens=5, do_sample=False, pad_token_id=tokenizer.pad_token_id)
    assert written.shape[1] > len(ids)


def test_peft_puts_the_adapter_of_a_run_on_the_base(base, exports, tmp_path):
    peft = pytest.importorskip("peft")
    run = tmp_path / "run"
    config = SftConfig(total_steps=5, learning_rate=1e-2, batch_size=4, max_length=32)
    fine_tune(base, [exports["prompt_completion"]], run, config, lora=LoraConfig(4, 8.0), progress=False)
    loaded = peft.PeftModel.from_pretrained(transformers.AutoModelForCausalLM.from_pretrained(base), run / "adapter")
    ids = load_model(base).tokenizer.encode("Review 3: the film was good")
    ours, theirs = logits_here(run / "model", ids), logits_there(loaded, ids)
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4 * np.abs(theirs).max())
    assert np.abs(ours - logits_here(base, ids)).max() > 1e-3
