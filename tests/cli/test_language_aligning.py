"""The verbs that learn from preferences and rewards: what they answer, what they leave behind, mistakes in one line."""

import json
import shutil
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.cli.main import main
from thorndike.language import aligning
from thorndike.language.decoder import hidden_states, initial_params, logits
from thorndike.language.model import LanguageModel, load_model, save_model
from thorndike.language.preference_files import read_prompts
from thorndike.language.preferences.assignment import Plan, next_assignments
from thorndike.language.preferences.store import Store
from thorndike.language.pretraining import Config, small_llama, train_tokenizer
from thorndike.language.reward_files import load_reward_model
from thorndike.language.reward_training import passes
from thorndike.language.rollouts import make_prompts

pytestmark = pytest.mark.usefixtures("quick_compile")
SMALL = ["--set=episodes=8", "--set=batch_size=4", "--set=max_new_tokens=4", "--set=max_prompt_length=12", "--set=total_steps=2"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that has learnt nothing, prompts, preferences for long words, and a reward function."""
    path = tmp_path_factory.mktemp("aligning")
    texts = [f"The {what} is {how}." for what in ("film", "play", "book") for how in ("good", "bad", "long")]
    tokenizer = train_tokenizer(texts, 270)
    config = small_llama(Config(vocab_size=270, hidden_size=16, num_layers=1, num_heads=2, intermediate_size=24), tokenizer)
    save_model(LanguageModel(config, initial_params(config, jax.random.key(0)), tokenizer), path / "base")
    (path / "prompts.jsonl").write_text(
        "".join(json.dumps({"prompt": f"The {each}"}) + "\n" for each in ("film", "play", "book", "film is"))
    )
    rows = [{"prompt": "The film", "chosen": f" {'z' * (2 + n % 3)} is", "rejected": f" a{n % 4}", "p_chosen": 0.9} for n in range(80)]
    (path / "preferences.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (path / "rewards.py").write_text("def length(prompts, completions, ids):\n    return [len(text) for text in completions]\n")
    return path


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    status = main(["language", *words, "--json"])
    told = capsys.readouterr()
    assert status == 0, told.err
    return json.loads(told.out)


def reward_words(folder: Path) -> list[str]:
    words = ["reward", str(folder / "base"), "--data", str(folder / "preferences.jsonl"), "--out", str(folder / "reward"), "--members", "2"]
    return [*words, "--set=pool=mean", "--set=batch_size=8", "--set=total_steps=40", "--set=learning_rate=0.01"]


@pytest.fixture(scope="module")
def reward(folder: Path) -> Path:
    """A reward model made by the command."""
    assert main(["language", *reward_words(folder)]) == 0
    return folder / "reward" / "model"


def test_a_reward_model_says_how_good_it_is(folder: Path, reward: Path) -> None:
    model, told = load_reward_model(reward), json.loads((folder / "reward" / "outcome.json").read_text())
    assert len(model.members) == 2 and model.held_out is not None
    assert told["pairs"] == model.held_out.pairs == 8 and told["accuracy"] == model.held_out.accuracy > 0.9
    assert model.pool == "mean" and model.deviation > 0


def test_an_interrupted_reward_model_goes_on_bit_for_bit(
    folder: Path, reward: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [str(tmp_path) if word == str(folder / "reward") else word for word in reward_words(folder)]

    def stopping(*given):
        batch = passes(*given)
        return lambda step, state: signal.raise_signal(signal.SIGINT) or batch(step, state) if step == 20 else batch(step, state)

    with monkeypatch.context() as patch:
        patch.setattr(aligning, "passes", stopping)
        assert main(["language", *words]) == 130 and "goes on from here" in capsys.readouterr().out
    assert not (tmp_path / "model").exists() and (tmp_path / "checkpoints" / "21").is_dir()
    assert answer(capsys, *words)["status"] == "finished"
    for name in ("model.safetensors", "member-1/model.safetensors", "reward.json"):
        assert (tmp_path / "model" / name).read_bytes() == (reward / name).read_bytes()
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 40 and list(tmp_path.glob("events.out.tfevents.*"))


def test_a_run_whose_data_have_changed_is_not_gone_on_with(
    folder: Path, reward: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    told, data = json.loads((folder / "reward" / "run.json").read_text()), str(folder / "preferences.jsonl")
    assert list(told["files"]) == [data]
    (tmp_path / "run.json").write_text(json.dumps(told | {"files": {data: "0" * 64}}))
    words = [str(tmp_path) if word == str(folder / "reward") else word for word in reward_words(folder)]
    assert main(["language", *words]) == 2
    error = capsys.readouterr().err
    assert f"{data} has changed since {tmp_path} was begun" in error and error.count("\n") == 1


@pytest.mark.parametrize("verb", ["ppo", "rloo"])
def test_a_policy_is_trained_on_it_and_compared(verb: str, folder: Path, reward: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / verb
    words = [verb, str(folder / "base"), "--reward", str(reward), "--reward", f"0.1*{folder}/rewards.py:length", "--out", str(out)]
    words += [
        "--prompts",
        str(folder / "prompts.jsonl"),
        "--max-kl",
        "50",
        *SMALL,
        *(["--set=group=4", "--lora=2", "--set=learning_rate=0.01"] if verb == "rloo" else []),
    ]
    found = answer(capsys, *words)
    assert found["iterations"] == 2 and found["stopped"] is None and 0.0 <= found["judged"]["reward"]["win_rate"] <= 1.0
    assert load_model(out / "model").config == load_model(folder / "base").config
    assert len((out / "metrics.jsonl").read_text().splitlines()) == 2 and json.loads((out / "comparison.json").read_text())["samples"]
    assert answer(capsys, *words) == found  # the same command finds it done
    assert list(json.loads((out / "run.json").read_text())["files"]) == [str(folder / "prompts.jsonl")]
    if verb == "rloo":
        assert_adapter_makes_the_model(folder, out)
    else:
        assert not (out / "adapter").exists()


def test_no_text_ends_where_the_policy_is_told_so(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["ppo", str(folder / "base"), "--reward", f"{folder}/rewards.py:length", "--prompts", str(folder / "prompts.jsonl")]
    found = answer(capsys, *words, "--out", str(tmp_path / "ppo"), *SMALL, "--set=ignore_eos=true")
    assert found["length"] == found["base_length"] == 4.0
    assert load_model(tmp_path / "ppo" / "model").config == load_model(folder / "base").config


def assert_adapter_makes_the_model(folder: Path, run: Path) -> None:
    """Merged into the base, it says what the saved model says, and the base does not."""
    tokens = jnp.asarray([load_model(folder / "base").tokenizer.encode("The film is good.")])
    models = [load_model(folder / "base", adapter=run / "adapter"), load_model(run / "model"), load_model(folder / "base")]
    said = [np.asarray(logits(each.params, each.config, hidden_states(each.params, each.config, tokens))) for each in models]
    np.testing.assert_allclose(said[0], said[1], rtol=1e-5, atol=1e-6)
    assert np.abs(said[1] - said[2]).max() > 1e-4


def test_an_adapter_learnt_from_preferences_is_kept_apart_too(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["dpo", str(folder / "base"), "--data", str(folder / "preferences.jsonl"), "--out", str(tmp_path), "--lora", "2"]
    answer(capsys, *words, "--set=batch_size=8", "--set=learning_rate=0.01", "--set=total_steps=4")
    assert_adapter_makes_the_model(folder, tmp_path)


def test_dpo_and_eval(folder: Path, reward: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["dpo", str(folder / "base"), "--data", str(folder / "preferences.jsonl"), "--out", str(folder / "dpo")]
    found = answer(capsys, *words, "--set=batch_size=8", "--set=learning_rate=0.01", "--set=total_steps=12")
    assert found["status"] == "finished" and found["steps"] == 12 and found["train/reward_margin"] > 0
    assert list(json.loads((folder / "dpo" / "run.json").read_text())["files"]) == [str(folder / "preferences.jsonl")]
    table = {"model": "base", "data": "preferences.jsonl", "out": "dpo"}
    lines = [f'{name} = "{folder / path}"' for name, path in table.items()]
    (folder / "way.toml").write_text("\n".join(["[dpo]", *lines, "batch_size = 8", "learning_rate = 0.01", "total_steps = 5"]))
    same = answer(capsys, "dpo", "--config", str(folder / "way.toml"), "--set=total_steps=12")
    assert same["steps"] == 12, "a file that says the same is the same request, which is done"
    words = ["eval", str(folder / "dpo" / "model"), "--base", str(folder / "base"), "--prompts", str(folder / "prompts.jsonl")]
    length = f"{folder}/rewards.py:length"
    seen = answer(capsys, *words, "--reward", str(reward), "--reward", length, "--reward", f"0.5*{length}", "--max-new-tokens", "4")
    assert seen["kl"] > 0.01 and set(seen["judged"]) == {str(reward), length, f"0.5*{length}"} and seen["prompts"] == 4
    assert seen["judged"][f"0.5*{length}"]["policy"] == pytest.approx(seen["judged"][length]["policy"] / 2)


def test_the_best_samples_are_learnt_from(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    base, prompts, reward = str(folder / "base"), str(folder / "prompts.jsonl"), f"{folder}/rewards.py:length"
    ends = ["--max-new-tokens", "6", "--ignore-eos"]
    words = ["generate", base, "--prompts", prompts, *ends, "--samples", "12", "--to", str(tmp_path / "best.jsonl")]
    assert answer(capsys, *words, "--reward", reward)["prompts"] == 4
    rows = [json.loads(line) for line in (tmp_path / "best.jsonl").read_text().splitlines()]
    assert all(row["reward"] == len(row["completion"]) for row in rows)
    every = answer(capsys, *words[:-2], "--seed", "1")["rows"]
    assert np.mean([row["reward"] for row in rows]) > np.mean([len(text) for row in every for text in row["completions"]]) + 1
    words = ["sft", base, "--data", str(tmp_path / "best.jsonl"), "--out", str(tmp_path / "sft"), "--set=total_steps=30"]
    answer(capsys, *words, "--set=batch_size=4", "--set=learning_rate=0.02", "--set=max_length=32")
    words = ["eval", str(tmp_path / "sft" / "model"), "--base", base, "--prompts", prompts, *ends, "--reward", reward]
    found = answer(capsys, *words)
    assert found["length"] == found["base_length"] == 6.0 and found["kl"] > 0.1
    assert found["judged"][reward]["policy"] > found["judged"][reward]["base"] + 1


def test_people_are_asked_first_where_the_members_disagree(folder: Path, reward: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"prompt": "The film", "candidates": [f" was {one}", f" is {other}"]} for one in "abc" for other in "xyz"]
    (folder / "candidates.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    db = ["--db", str(folder / "asked.db")]
    answer(capsys, "import", str(folder / "candidates.jsonl"), *db)
    found = answer(capsys, "ask", *db, "--reward", str(reward))
    assert found["items"] == 9 and 0 < found["mean"] <= found["highest"] <= 0.5
    model = load_reward_model(reward)
    with Store(folder / "asked.db") as store:
        project = store.projects()["default"]
        prompts, candidates = store.contents(project)
        by_hand = {}
        for number, question in store.questions(project).items():
            texts = [model.tokenizer.encode(prompts[question.prompt]["text"]) for _ in question.candidates]
            texts = [
                [*before, *model.tokenizer.encode(candidates[each].content["text"], special=False), model.tokenizer.eos_id]
                for before, each in zip(texts, question.candidates, strict=True)
            ]
            one, other = model.all_scores(texts).T
            by_hand[number] = np.std([1 / (1 + np.exp(-(a - b))) for a, b in zip(one, other, strict=True)])
        assert found["highest"] == pytest.approx(max(by_hand.values()), rel=1e-5)
        first = next_assignments(store, project, store.rater("anna"), 1, Plan(gold=0, repeats=0))
        (shown,) = store.shown(first)
        most = store.questions(project)[max(by_hand, key=lambda number: by_hand[number])]
        wanted = {candidates[each].content["text"] for each in most.candidates}
        assert {each["text"] for each in shown.candidates} == wanted


def test_prompts_may_be_conversations(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rows: list[dict] = [{"prompt": [{"role": "user", "content": "The film"}]}, {"prompt": "The play"}]
    (tmp_path / "prompts.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    words = ["--prompts", str(tmp_path / "prompts.jsonl"), "--reward", f"{folder}/rewards.py:length", "--max-new-tokens", "4"]
    assert main(["language", "eval", str(folder / "base"), "--base", str(folder / "base"), *words]) == 2
    assert "this model has no chat template" in capsys.readouterr().err
    shutil.copytree(folder / "base", tmp_path / "chat")
    template = "<s>{% for each in messages %}{{ each.role }}: {{ each.content }}{% endfor %}{% if add_generation_prompt %}|{% endif %}"
    (tmp_path / "chat" / "chat_template.jinja").write_text(template)
    found = answer(capsys, "eval", str(tmp_path / "chat"), "--base", str(tmp_path / "chat"), *words)
    assert found["prompts"] == 2
    tokenizer = load_model(tmp_path / "chat").tokenizer
    prompts = make_prompts(read_prompts([tmp_path / "prompts.jsonl"]), tokenizer, 24)
    tokens = [row[kept > 0].tolist() for row, kept in zip(prompts.tokens, prompts.segments, strict=True)]
    assert tokens == [tokenizer.encode("user: The film|"), tokenizer.encode("The play")], "one beginning of text each"
    assert prompts.texts == ("<s>user: The film|", "The play")


def test_mistakes_are_one_line(folder: Path, reward: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    base, prompts = str(folder / "base"), str(folder / "prompts.jsonl")
    ppo = ["ppo", base, "--prompts", prompts, "--out", str(tmp_path / "x"), *SMALL]
    (tmp_path / "same.jsonl").write_text('{"prompt": "a", "chosen": "b", "rejected": "b"}\n')
    (tmp_path / "odd.jsonl").write_text('{"prompt": "a", "chosen": "b", "rejected": "c", "p_chosen": 2}\n')
    (tmp_path / "wrong.py").write_text("def score(prompts, completions, ids):\n    return 1.0\n")
    (tmp_path / "raising.py").write_text("def score(prompts, completions, ids):\n    return [int('a\\nb')]\n")
    cases = [
        ([*ppo, "--reward", "nowhere"], "is no reward"),
        ([*ppo, "--reward", "x*nowhere"], "WEIGHT*WHAT"),
        ([*ppo, "--reward", f"{folder}/rewards.py:width"], "no function width"),
        ([*ppo, "--reward", base], "without a scalar head"),
        ([*ppo, "--reward", f"{tmp_path}/wrong.py:score"], "a number a text"),
        (
            [*ppo, "--reward", f"2*{tmp_path}/raising.py:score", "--out", str(tmp_path / "w")],
            f"the reward {tmp_path}/raising.py:score failed: ValueError: invalid literal for int() with base 10: 'a\\nb' "
            f"({tmp_path}/raising.py, line 2)",
        ),
        ([*ppo, "--reward", str(reward), "--max-kl", "-1"], "above 0"),
        ([*ppo, "--reward", str(reward), "--set", "target_kll=3"], "did you mean"),
        (["rloo", *ppo[1:], "--reward", str(reward), "--set", "baseline=group"], "thorndike language grpo"),
        (["generate", base, "--prompts", prompts, "--reward", str(reward), "--top-k", "3"], "leave --top-k, --top-p"),
        ([*ppo, "--reward", str(reward), "--set", "ignore_eos=true", "--set", "missing_eos_penalty=1"], "would charge all"),
        (["dpo", base, "--data", str(tmp_path / "same.jsonl"), "--out", str(tmp_path / "y")], "same.jsonl, row 1: chosen and rejected"),
        (["dpo", base, "--data", str(tmp_path / "odd.jsonl"), "--out", str(tmp_path / "y")], "odd.jsonl, row 1: p_chosen is 2"),
        (["reward", base, "--data", prompts, "--out", str(tmp_path / "y")], "expected a preference"),
        (["eval", str(reward), "--base", base, "--prompts", prompts, "--reward", str(reward)], "not of the shape"),
        (["eval", base, "--base", base, "--prompts", prompts, "--reward", str(reward), "--reward", str(reward)], "given twice"),
        (["ask", "--db", str(folder / "p.db"), "--reward", str(reward)], "there is no store"),
        (["eval", base, "--base", base, "--prompts", prompts, "--reward", str(reward), "--temperature", "0"], "above 0"),
        ([*reward_words(folder), "--lora", "2"], "begun with another lora"),
        (["demo", "--out", str(tmp_path / "z"), "--learners", "pppo"], "did you mean 'ppo'"),
    ]
    for words, expected in cases:
        assert main(["language", *words]) == 2, words
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1, error


def test_a_model_near_chance_is_refused(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rows = [{"prompt": "The film", "chosen": f" {'ab'[n % 2]}", "rejected": f" {'ba'[n % 2]}"} for n in range(40)]
    (tmp_path / "noise.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    words = [
        "reward",
        str(folder / "base"),
        "--data",
        str(tmp_path / "noise.jsonl"),
        "--out",
        str(tmp_path / "noise"),
        "--set=batch_size=8",
    ]
    assert answer(capsys, *words)["near_chance"] is True
    ppo = ["ppo", str(folder / "base"), "--prompts", str(folder / "prompts.jsonl"), "--out", str(tmp_path / "x"), *SMALL]
    assert main(["language", *ppo, "--reward", str(tmp_path / "noise" / "model")]) == 2
    assert "which guessing explains" in capsys.readouterr().err
