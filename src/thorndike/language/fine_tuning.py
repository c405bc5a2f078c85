"""Fine-tuning a model's folder on rows of text, prompts with completions, or conversations: data, ``sft``, a run's directory."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax

from thorndike.errors import UserError
from thorndike.language.data import read_rows, tokenize
from thorndike.language.json_fields import Dtype
from thorndike.language.learner import State
from thorndike.language.lora import Adapter, LoraConfig, save_adapter
from thorndike.language.model import LanguageModel, computing_in, load_model, precision, save_model
from thorndike.language.packing import PackedRows, batch_at, packed
from thorndike.language.pretraining import held_out_loss
from thorndike.language.sft import Config, TextBatch, sft
from thorndike.language.text_run import ADAPTER, MODEL, TextOutcome, TextPlan, open_run, run_learner
from thorndike.settings import settings_of


def fine_tune(
    folder: Path,
    data: Sequence[Path],
    out: Path,
    config: Config,
    *,
    lora: LoraConfig | None = None,
    held_out: Sequence[Path] = (),
    seed: int = 0,
    dtype: Dtype | None = None,
    progress: bool = True,
) -> TextOutcome:
    """Learn from files of rows into a run's directory: its ``model`` loads in transformers, its ``adapter`` (with ``lora``) in PEFT.

    Goes on where it stopped. Raises ``UserError`` for rows that nothing can be learnt from, naming file and row.
    """
    plain = load_model(folder)
    model = computing_in(plain, dtype)
    request = {
        "verb": "sft",
        "model": str(folder.absolute()),
        "data": [str(path.absolute()) for path in data],
        "held_out": [str(path.absolute()) for path in held_out],
        "seed": seed,
        "settings": settings_of(config),
        "lora": None if lora is None else settings_of(lora),
        **precision(dtype),
    }
    length = min(config.max_length, model.config.max_positions)
    rows = _rows(data, model, length)
    open_run(out, request, [*data, *held_out])
    learner = sft(config, model.config, lora)
    frozen, score = learner.frozen(model.params), jax.jit(learner.evaluate)
    measured = _rows(held_out, model, length) if held_out else None

    def evaluate(state: State) -> Mapping[str, float]:
        if measured is None:
            return {}
        return held_out_loss(lambda part: score(state, frozen, part), measured, min(config.batch_size, len(measured.tokens)))

    def batch(step: int, state: State) -> TextBatch:
        return batch_at(rows, config.batch_size, step, seed)

    plan = TextPlan(config.total_steps, log_every=max(1, config.total_steps // 100), checkpoint_every=max(1, config.total_steps // 5))
    outcome = run_learner(out, learner, model.params, batch, plan, seed, evaluate=evaluate, progress=progress)
    if outcome.status == "finished" and not (out / MODEL).exists():
        if lora is not None:
            save_adapter(Adapter(lora, outcome.state.trained), model.config, out / ADAPTER, str(folder.absolute()))
        save_model(plain._replace(params=learner.params(outcome.state, frozen)), out / MODEL)
    return outcome


def _rows(paths: Sequence[Path], model: LanguageModel, length: int) -> PackedRows:
    texts = tokenize((row for path in paths for row in read_rows(path)), model.tokenizer)
    highest = max(max(text.tokens, default=0) for text in texts)
    if highest >= model.config.vocab_size:
        raise UserError(
            f"the tokenizer has token {highest}, the model only {model.config.vocab_size}: they do not belong together; "
            "take the tokenizer files from the folder the model came from"
        )
    return packed(texts, length, model.tokenizer.pad_id)
