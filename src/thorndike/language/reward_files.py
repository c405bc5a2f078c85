"""Reward models as folders: ``*ForSequenceClassification`` as transformers loads it, and beside it what makes its numbers rewards.

``reward.json``: what the head reads, mean and deviation of the rewards of the base's own samples, by which they are made comparable
(Ziegler et al. 2019, section 2.1), and how good the model was on held-out comparisons. Further members of an ensemble are in ``member-1``,
``member-2``...
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from thorndike.errors import UserError
from thorndike.language.decoder import Params
from thorndike.language.generation import bucket
from thorndike.language.model import LanguageModel, load_decoder, load_model, save_model, whole_folder
from thorndike.language.model_config import ModelConfig
from thorndike.language.reward_report import GapAccuracy, HeldOut
from thorndike.language.scalar_head import text_scores
from thorndike.language.tokenizer import Tokenizer
from thorndike.training.json_files import NUMBER, Json, Kind, as_bytes, blamed_on, check_fields, read_object

FACTS = "reward.json"
_POOL = Kind("last or mean", lambda value: value in ("last", "mean"))
_LIST = Kind("a list", lambda value: isinstance(value, list))


class RewardModel(NamedTuple):
    """One or several scalar-head models, whose mean is the reward."""

    config: ModelConfig
    members: tuple[Params, ...]
    tokenizer: Tokenizer
    pool: str
    mean: float = 0.0
    """Of the raw rewards of the base's samples; subtracted."""
    deviation: float = 1.0
    """By which rewards are divided."""
    held_out: HeldOut | None = None

    def all_scores(self, ids: Sequence[Sequence[int]]) -> Float[np.ndarray, "E B"]:
        """The reward of each text by each member, from the tokens of prompt and completion."""
        tokens, segments = right_padded(ids, self.tokenizer.pad_id)
        raw = [np.asarray(_scores(params, self.config, tokens, segments, self.pool), np.float64) for params in self.members]
        return (np.stack(raw) - self.mean) / self.deviation

    def score(self, prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> Float[np.ndarray, " B"]:
        """The reward of each text: the mean over members."""
        return self.all_scores(ids).mean(axis=0)


def normalised(model: RewardModel, base_samples: Sequence[Sequence[int]]) -> RewardModel:
    """The same model with rewards of mean 0 and deviation 1 on samples of the base. Raises ``UserError`` if they all get one."""
    raw = model._replace(mean=0.0, deviation=1.0).all_scores(base_samples).mean(axis=0)
    deviation = float(raw.std())
    if not deviation > 0:
        raise UserError("the reward model gives every sample of the base the same reward: it has learnt nothing; train it longer")
    return model._replace(mean=float(raw.mean()), deviation=deviation)


def refuse_if_near_chance(model: RewardModel) -> None:
    """Raises ``UserError`` for a model that is not better than guessing on held-out comparisons: a policy would learn its mistakes."""
    found = model.held_out
    if found is not None and found.near_chance:
        low, high = found.accuracy_ci95
        raise UserError(
            f"the reward model is right on {found.accuracy:.1%} of {found.pairs} held-out pairs (95 % interval {low:.1%} to {high:.1%}), "
            "which guessing explains: give it more comparisons or train it longer before a policy learns from it"
        )


def save_reward_model(model: RewardModel, folder: str | Path) -> None:
    """Write a new folder. Raises ``UserError`` if there is something in it already."""
    config = replace(model.config, num_labels=1)
    facts: Json = {"pool": model.pool, "mean": model.mean, "deviation": model.deviation, "members": len(model.members)}
    facts["held_out"] = None if model.held_out is None else _as_json(model.held_out)
    with whole_folder(folder) as path:
        save_model(LanguageModel(config, model.members[0], model.tokenizer), path)
        for number, params in enumerate(model.members[1:], 1):
            save_model(LanguageModel(config, params, model.tokenizer), path / f"member-{number}")
        (path / FACTS).write_bytes(as_bytes(facts))


def load_reward_model(folder: str | Path) -> RewardModel:
    """A reward model from its folder; one that other programs made has no ``reward.json`` and is taken as it is.

    Raises ``UserError`` where there is none, or it is no model with a scalar head.
    """
    path = Path(folder)
    model = load_model(path)
    if not model.config.num_labels:
        raise UserError(f"{folder} is a language model without a scalar head; make a reward model of it: thorndike language reward")
    try:
        facts = read_object(path / FACTS)
    except FileNotFoundError:
        return RewardModel(model.config, (model.params,), model.tokenizer, "last")
    kinds = {"pool": _POOL, "mean": NUMBER, "deviation": NUMBER, "members": NUMBER}
    check_fields(facts, kinds, path / FACTS)
    further = tuple(load_decoder(path / f"member-{number}")[1] for number in range(1, int(cast(int, facts["members"]))))
    mean, deviation = float(cast(float, facts["mean"])), float(cast(float, facts["deviation"]))
    held_out = None if facts.get("held_out") is None else _held_out(cast(Json, facts["held_out"]), path / FACTS)
    return RewardModel(model.config, (model.params, *further), model.tokenizer, str(facts["pool"]), mean, deviation, held_out)


def right_padded(texts: Sequence[Sequence[int]], pad_id: int) -> tuple[Int[Array, "B T"], Int[Array, "B T"]]:
    """Texts as one array, the padding behind them, and their segments. The width is the next of a few."""
    if not texts or not all(map(len, texts)):
        raise UserError("a text to be scored is empty")
    width = bucket(max(map(len, texts)))
    tokens, segments = np.full((len(texts), width), pad_id, np.int32), np.zeros((len(texts), width), np.int32)
    for row, text in enumerate(texts):
        tokens[row, : len(text)] = text
        segments[row, : len(text)] = 1
    return jnp.asarray(tokens), jnp.asarray(segments)


@partial(jax.jit, static_argnames=("config", "pool"))
def _scores(params: Params, config: ModelConfig, tokens: Int[Array, "B T"], segments: Int[Array, "B T"], pool: str) -> Float[Array, " B"]:
    return text_scores(params, config, tokens, segments, "mean" if pool == "mean" else "last")


def _as_json(found: HeldOut) -> Json:
    return {**found._asdict(), "by_gap": [each._asdict() for each in found.by_gap], "near_chance": found.near_chance}


def _held_out(content: Json, where: Path) -> HeldOut:
    check_fields(
        content, {"pairs": NUMBER, "accuracy": NUMBER, "calibration_error": NUMBER, "accuracy_ci95": _LIST, "by_gap": _LIST}, where
    )
    with blamed_on(where):
        fields = {name: content[name] for name in HeldOut._fields}
        low, high = cast(list[float], fields["accuracy_ci95"])
        fields |= {"accuracy_ci95": (float(low), float(high))}
        fields["by_gap"] = tuple(GapAccuracy(**each) for each in cast(list[dict], content["by_gap"]))
        return HeldOut(**cast(dict, fields))
