"""Supervised fine-tuning: the loss, accumulation, adapters, and runs that go on bit for bit."""

import json
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from language.test_data import token_rows
from thorndike.errors import UserError
from thorndike.language.decoder import hidden_states, logits
from thorndike.language.fine_tuning import fine_tune
from thorndike.language.learner import Learner, State
from thorndike.language.lora import LoraConfig
from thorndike.language.model import load_decoder, load_model
from thorndike.language.packing import batch_at, packed
from thorndike.language.pretraining import Config as PretrainingConfig
from thorndike.language.pretraining import pretrain
from thorndike.language.sft import Config, TextBatch, sft, token_losses
from thorndike.language.text_run import TextPlan, open_run, run_learner

pytestmark = pytest.mark.usefixtures("quick_compile")
CONFIG, PARAMS = load_decoder(REFERENCE / "llama")
ROWS = packed(token_rows(), 16, 0)
SETTINGS = Config(total_steps=6, learning_rate=1e-2, warmup_fraction=0.0, batch_size=4, max_length=16)


def learner_and_step(config: Config, lora: LoraConfig | None = None) -> tuple[Learner, State, dict]:
    learner = sft(config, CONFIG, lora)
    state, metrics = jax.jit(learner.update)(
        learner.init(PARAMS, jax.random.key(0)), learner.frozen(PARAMS), batch_at(ROWS, config.batch_size, 0, 0)
    )
    return learner, state, metrics


def test_the_loss_is_that_of_a_loop() -> None:
    batch = TextBatch(*map(jnp.asarray, ROWS))._replace(learn=jnp.asarray(ROWS.learn & (ROWS.tokens % 3 > 0)))
    losses, weights = token_losses(PARAMS, CONFIG, batch)
    scores = np.asarray(jax.nn.log_softmax(logits(PARAMS, CONFIG, hidden_states(PARAMS, CONFIG, batch.tokens, batch.segments))))
    counted = 0
    for row in range(len(ROWS.tokens)):
        for place in range(1, 16):
            inside = ROWS.segments[row, place] == ROWS.segments[row, place - 1] > 0 and bool(batch.learn[row, place])
            assert float(weights[row, place - 1]) == inside
            counted += inside
            if inside:
                assert abs(float(losses[row, place - 1]) + scores[row, place - 1, batch.tokens[row, place]]) < 1e-4
    assert 10 < counted < int((ROWS.segments > 0).sum())


@pytest.mark.parametrize("lora", [None, LoraConfig(rank=2)])
def test_accumulated_parts_make_the_same_step(lora: LoraConfig | None) -> None:
    _, whole, metrics = learner_and_step(SETTINGS, lora)
    _, parts, same = learner_and_step(Config(**{**vars(SETTINGS), "gradient_accumulation": 4}), lora)
    assert float(same["train/loss"]) == pytest.approx(float(metrics["train/loss"]), rel=1e-5)
    assert float(same["train/grad_norm"]) == pytest.approx(float(metrics["train/grad_norm"]), rel=1e-4)
    # Adam's first step is the sign of the gradient: where that is next to nothing, its sign is too.
    one, other = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.trained)]) for state in (whole, parts))
    assert np.mean(np.abs(one - other) > 1e-4) < 0.01
    with pytest.raises(UserError, match="does not divide"):
        Config(batch_size=4, gradient_accumulation=3)


def test_an_adapter_learns_and_the_model_stays() -> None:
    learner, state, metrics = learner_and_step(SETTINGS, LoraConfig(rank=2, target_modules=("q_proj", "down_proj")))
    assert learner.frozen(PARAMS) is PARAMS and len(state.trained) == 4
    update, losses = jax.jit(learner.update), [float(metrics["train/loss"])]
    for step in range(5):
        state, metrics = update(state, PARAMS, batch_at(ROWS, 4, 0, 0))
        losses.append(float(metrics["train/loss"]))
        assert int(state.step) == step + 2
    assert losses[-1] < losses[0] - 0.1


def train(run: Path, steps: int, stop_at: int | None = None) -> State:
    def batch(step: int, state: State) -> TextBatch:
        if step == stop_at:
            signal.raise_signal(signal.SIGINT)
        return batch_at(ROWS, 4, step, 1)

    learner = sft(SETTINGS, CONFIG)
    return run_learner(run, learner, PARAMS, batch, TextPlan(steps, log_every=1, checkpoint_every=3), 0, progress=False).state


def test_an_interrupted_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    for name in ("whole", "stopped"):
        open_run(tmp_path / name, {"verb": "sft"})
    whole = train(tmp_path / "whole", 6)
    assert int(train(tmp_path / "stopped", 6, stop_at=3).step) == 4
    again = train(tmp_path / "stopped", 6)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    lines = [[json.loads(line) for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()] for name in ("whole", "stopped")]
    assert [row["steps"] for row in lines[0]] == [1, 2, 3, 4, 5, 6] == [row["steps"] for row in lines[1]]
    assert [row["train/loss"] for row in lines[0]] == [row["train/loss"] for row in lines[1]]
    assert sorted(path.name for path in (tmp_path / "stopped" / "checkpoints").iterdir()) == ["4", "6"]


def test_a_run_is_gone_on_with_only_as_it_was_begun(tmp_path: Path) -> None:
    open_run(tmp_path / "run", {"seed": 0, "settings": {"batch_size": 4}})
    open_run(tmp_path / "run", {"seed": 0, "settings": {"batch_size": 4}})
    with pytest.raises(UserError, match="another seed"):
        open_run(tmp_path / "run", {"seed": 1, "settings": {"batch_size": 4}})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(UserError, match="is no run"):
        open_run(tmp_path / "other", {})


def test_a_file_that_has_changed_is_not_learnt_from(tmp_path: Path) -> None:
    data, run = tmp_path / "data.jsonl", tmp_path / "run"
    data.write_text("one")
    open_run(run, {}, [data])
    open_run(run, {}, [data])
    data.write_text("two")
    with pytest.raises(UserError, match=r"data\.jsonl has changed since .*run was begun"):
        open_run(run, {}, [data])
    told = json.loads((run / "run.json").read_text())
    del told["files"]
    (run / "run.json").write_text(json.dumps(told))
    open_run(run, {}, [data])  # begun by an older version


def test_a_loss_that_is_not_finite_ends_the_run(tmp_path: Path) -> None:
    open_run(tmp_path / "run", {})
    broken = jax.tree.map(lambda leaf: leaf * jnp.nan, PARAMS)
    with pytest.raises(UserError, match="not finite by step 1"):
        run_learner(
            tmp_path / "run",
            sft(SETTINGS, CONFIG),
            broken,
            lambda step, state: batch_at(ROWS, 4, step, 1),
            TextPlan(2, 1),
            0,
            progress=False,
        )
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.slow
def test_from_a_text_file_to_a_model_that_has_learnt_an_answer(tmp_path: Path) -> None:
    """The whole way: a tokenizer and a model from a text, then fine-tuning on one answer, whole and as an adapter."""
    sentences = [
        f"{who} {does} the {what}." for who in ("A cat", "My dog", "The bird") for does in ("sees", "likes") for what in ("fish", "sun")
    ]
    (tmp_path / "texts.txt").write_text("\n\n".join(sentences * 2), encoding="utf-8")
    small = PretrainingConfig(
        vocab_size=280, hidden_size=16, num_layers=1, num_heads=2, intermediate_size=24, total_steps=12, batch_size=4, max_length=16,
        learning_rate=1e-2,
    )  # fmt: skip
    made = pretrain(str(tmp_path / "texts.txt"), tmp_path / "base", small, progress=False)
    rows = [json.loads(line) for line in (made.run / "metrics.jsonl").read_text().splitlines()]
    assert made.status == "finished" and rows[-1]["eval/loss"] < 5.5
    (tmp_path / "data.jsonl").write_text(json.dumps({"prompt": "A cat", "completion": " sleeps"}))
    for lora in (None, LoraConfig(rank=4)):
        out = tmp_path / f"tuned-{lora is None}"
        settings = Config(total_steps=40, learning_rate=2e-2, batch_size=2, max_length=16)
        fine_tune(tmp_path / "base" / "model", [tmp_path / "data.jsonl"], out, settings, lora=lora, progress=False)
        logged = [json.loads(line)["train/loss"] for line in (out / "metrics.jsonl").read_text().splitlines()]
        # An adapter can do little to so small a model.
        assert logged[-1] < (0.5 if lora is None else logged[0] - 0.05)
        tuned = load_model(out / "model")
        assert (out / "adapter").exists() == (lora is not None)
        if lora is not None:
            merged = load_model(tmp_path / "base" / "model", adapter=out / "adapter")
            np.testing.assert_allclose(merged.params["layers"][0]["qkv"]["kernel"], tuned.params["layers"][0]["qkv"]["kernel"], atol=1e-5)
