"""A language model: its config, its parameters and its tokenizer, read from and written to a Hugging Face folder."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.language.decoder import Params
from thorndike.language.json_fields import Dtype
from thorndike.language.lora import load_adapter, merged
from thorndike.language.model_config import ModelConfig, as_json, read_model_config, with_dtype, write_model_config
from thorndike.language.tokenizer import Tokenizer, load_tokenizer, save_tokenizer
from thorndike.language.weights import SHARD, load_params, save_params
from thorndike.training.json_files import as_bytes


class LanguageModel(NamedTuple):
    """A model that reads and writes text."""

    config: ModelConfig
    params: Params
    tokenizer: Tokenizer


def stop_tokens(model: LanguageModel) -> tuple[int, ...]:
    """Where the model's texts end, by its config and its tokenizer."""
    end = model.tokenizer.eos_id
    return tuple(dict.fromkeys([*model.config.eos_token_ids, *([] if end is None else [end])]))


def never_ending(model: LanguageModel) -> LanguageModel:
    """The same model, whose texts go on to their limit: stop tokens are never chosen, by the policy, its reference and its learner alike.

    Chosen and passed over they would be a way to write nothing, and the model has never read on after one.
    """
    return model._replace(config=replace(model.config, never_chosen=stop_tokens(model)))


def load_model(folder: str | Path, *, dtype: Dtype | None = None, adapter: str | Path | None = None) -> LanguageModel:
    """The model in a Hugging Face folder, in another precision if ``dtype`` says so, with a LoRA ``adapter`` merged into it if given.

    Raises ``UserError`` where there is no model, or one whose logits would not be those of transformers.
    """
    config, params = load_decoder(folder, dtype=dtype)
    if adapter is not None:
        params = merged(params, config, load_adapter(Path(adapter), config))
    return LanguageModel(config, params, load_tokenizer(Path(folder)))


def computing_in(model: LanguageModel, dtype: Dtype | None) -> LanguageModel:
    """The same parameters, activations in another precision; as it is for None.

    Parameters that are learnt stay in float32 all the same, so that small steps are not lost: mixed precision.
    """
    return model if dtype is None else model._replace(config=with_dtype(model.config, dtype))


def precision(dtype: Dtype | None) -> dict[str, object]:
    """What a run's request says of it: nothing where nothing was asked for, as runs of older versions have it."""
    return {} if dtype is None else {"dtype": dtype}


def load_decoder(folder: str | Path, *, dtype: Dtype | None = None) -> tuple[ModelConfig, Params]:
    """The same without a tokenizer."""
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{folder} is no folder; give one as transformers' save_pretrained writes it")
    config = read_model_config(path)
    config = config if dtype is None else with_dtype(config, dtype)
    return config, load_params(path, config)


def save_model(model: LanguageModel, folder: str | Path, shard_bytes: int = SHARD) -> None:
    """Write a folder that transformers and vLLM load. Raises ``UserError`` if there is something in it already."""
    config = model.config
    with whole_folder(folder) as path:
        write_model_config(config, path)
        if not config.num_labels:
            content = as_json(config)
            tokens = {name: content[name] for name in ("bos_token_id", "eos_token_id", "pad_token_id") if content[name] is not None}
            (path / "generation_config.json").write_bytes(as_bytes(tokens))
        save_params(model.params, config, path, shard_bytes)
        save_tokenizer(model.tokenizer, path)


@contextmanager
def whole_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to write to, renamed to ``folder`` at the end of the block: a process killed before leaves nothing that looks like a model.

    Raises ``UserError`` if there is something in ``folder`` already.
    """
    path = Path(folder).resolve()
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UserError(f"{folder} is there already: a model is never written over; choose another folder")
    aside = path.with_name(f"{path.name}.partial")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        yield aside
        aside.replace(path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
