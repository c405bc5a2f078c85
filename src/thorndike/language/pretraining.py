"""Pre-training a small model from nothing: a tokenizer of the corpus's own, a Llama-shaped decoder, ``sft`` on plain text."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp

from thorndike.errors import UserError
from thorndike.language.corpus import MOVIE_REVIEWS, read_corpus
from thorndike.language.data import TokenRow
from thorndike.language.decoder import initial_params
from thorndike.language.learner import State
from thorndike.language.model import LanguageModel, save_model
from thorndike.language.model_config import ModelConfig, parse_model_config
from thorndike.language.packing import PackedRows, batch_at, concatenated
from thorndike.language.sft import Config as SftConfig
from thorndike.language.sft import TextBatch, sft
from thorndike.language.text_run import MODEL, TextOutcome, TextPlan, open_run, run_learner
from thorndike.language.tokenizer import Tokenizer, new_tokenizer
from thorndike.settings import AtLeast, Between, check, settings_of
from thorndike.startup import cache_directory
from thorndike.types import Metrics

BEGIN, END, PAD = "<s>", "</s>", "<pad>"


@dataclass(frozen=True)
class Config:
    """Settings of pre-training: the model's size, and how it learns."""

    vocab_size: Annotated[int, AtLeast(260)] = 2048  # tokens of the tokenizer, bytes included
    hidden_size: Annotated[int, AtLeast(8)] = 128  # d
    num_layers: Annotated[int, AtLeast(1)] = 4
    num_heads: Annotated[int, AtLeast(1)] = 4
    intermediate_size: Annotated[int, AtLeast(8)] = 352  # of the feed-forward layers
    max_positions: Annotated[int, AtLeast(16)] = 512  # the longest text it can read
    total_steps: Annotated[int, AtLeast(1)] = 900  # gradient steps
    batch_size: Annotated[int, AtLeast(1)] = 72  # rows of a gradient step
    max_length: Annotated[int, AtLeast(2)] = 64  # tokens of a row
    learning_rate: Annotated[float | str, AtLeast(0)] = "cosine(2e-3, 2e-4)"  # AdamW's step size
    warmup_fraction: Annotated[float, Between(0, 1)] = 0.03
    weight_decay: Annotated[float, AtLeast(0)] = 0.1

    def __post_init__(self) -> None:
        check(self)
        if self.hidden_size % (2 * self.num_heads):
            raise UserError(f"pretraining: hidden_size {self.hidden_size} must be an even multiple of num_heads {self.num_heads}")


DEFAULT = Config()


def pretrain(source: str, out: Path, config: Config, seed: int = 0, progress: bool = True) -> TextOutcome:
    """Learn from a corpus (see ``read_corpus``) into a run's directory with a Hugging Face folder ``model``; go on where it stopped."""
    corpus = read_corpus(source)
    settings = settings_of(config)
    open_run(out, {"verb": "pretrain", "corpus": source, "sha256": corpus.sha256, "seed": seed, "settings": settings})
    tokenizer = train_tokenizer(corpus.train, config.vocab_size)
    model_config = small_llama(config, tokenizer)
    rows, held_out = (
        concatenated(as_rows(texts, tokenizer), config.max_length, tokenizer.pad_id) for texts in (corpus.train, corpus.held_out)
    )
    learner = sft(_learning(config), model_config)
    score = jax.jit(learner.evaluate)

    def evaluate(state: State) -> Mapping[str, float]:
        return held_out_loss(lambda batch: score(state, (), batch), held_out, config.batch_size)

    def batch(step: int, state: State) -> TextBatch:
        return batch_at(rows, config.batch_size, step, seed)

    plan = TextPlan(config.total_steps, log_every=20, checkpoint_every=300)
    params = initial_params(model_config, jax.random.key(seed))
    outcome = run_learner(out, learner, params, batch, plan, seed, evaluate=evaluate, progress=progress)
    if outcome.status == "finished" and not (out / MODEL).exists():
        save_model(LanguageModel(model_config, outcome.state.trained, tokenizer), out / MODEL)
    return outcome


def base_model(corpus: str = MOVIE_REVIEWS, config: Config = DEFAULT, seed: int = 0, progress: bool = True) -> Path:
    """The folder of a small model of a corpus; made at its first use (10 CPU-minutes), then kept in Thorndike's cache directory."""
    asked = json.dumps([settings_of(config), seed], sort_keys=True)
    run = cache_directory() / "language" / f"{Path(corpus).stem}-{hashlib.sha256(asked.encode()).hexdigest()[:12]}"
    if not (run / MODEL / "config.json").exists() and pretrain(corpus, run, config, seed, progress).status != "finished":
        raise UserError(f"making the base model was interrupted; the same command goes on from where it stopped ({run})")
    return run / MODEL


def _learning(config: Config) -> SftConfig:
    return SftConfig(
        total_steps=config.total_steps,
        learning_rate=config.learning_rate,
        warmup_fraction=config.warmup_fraction,
        batch_size=config.batch_size,
        max_length=config.max_length,
        weight_decay=config.weight_decay,
    )


def train_tokenizer(texts: Sequence[str], vocab_size: int) -> Tokenizer:
    """Byte-pair encoding (Sennrich et al. 2016, arXiv:1508.07909) of bytes, so that no text is unknown. It puts ``<s>`` before a text."""
    try:
        import tokenizers
        from tokenizers import decoders, models, pre_tokenizers, processors, trainers
    except ModuleNotFoundError:
        raise UserError("language models need the package tokenizers: pip install 'thorndike[language]'") from None
    inner = tokenizers.Tokenizer(models.BPE())
    inner.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    inner.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=vocab_size, special_tokens=[PAD, BEGIN, END], initial_alphabet=alphabet, show_progress=False)
    inner.train_from_iterator(texts, trainer)
    begin = inner.token_to_id(BEGIN)
    inner.post_processor = processors.TemplateProcessing(single=f"{BEGIN} $A", special_tokens=[(BEGIN, begin)])
    return new_tokenizer(inner, BEGIN, END, PAD)


def small_llama(config: Config, tokenizer: Tokenizer) -> ModelConfig:
    """The decoder's config, as ``config.json`` would say it."""
    return parse_model_config(
        {
            "model_type": "llama",
            "vocab_size": tokenizer.vocab_size,
            "hidden_size": config.hidden_size,
            "intermediate_size": config.intermediate_size,
            "num_hidden_layers": config.num_layers,
            "num_attention_heads": config.num_heads,
            "num_key_value_heads": config.num_heads,
            "max_position_embeddings": config.max_positions,
            "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0},
            "tie_word_embeddings": True,
            "bos_token_id": tokenizer.bos_id,
            "eos_token_id": tokenizer.eos_id,
            "pad_token_id": tokenizer.pad_id,
        }
    )


def as_rows(texts: Sequence[str], tokenizer: Tokenizer) -> list[TokenRow]:
    """Texts in tokens, each from its beginning to its end; all is learnt."""
    ends = [] if tokenizer.eos_id is None else [tokenizer.eos_id]
    return [TokenRow([*tokens, *ends], [True] * (len(tokens) + len(ends))) for tokens in tokenizer.encode_many(texts)]


def held_out_loss(score: Callable[[TextBatch], Metrics], rows: PackedRows, batch_size: int, most: int = 8) -> dict[str, float]:
    """Mean nats a token over the first batches of held-out rows, and its perplexity."""
    loss = tokens = 0.0
    for number in range(max(1, min(most, len(rows.tokens) // batch_size))):
        part = slice(number * batch_size, (number + 1) * batch_size)
        found = score(TextBatch(*(jnp.asarray(array[part]) for array in rows)))
        loss, tokens = loss + float(found["eval/loss_sum"]), tokens + float(found["eval/tokens"])
    mean = loss / max(tokens, 1.0)
    return {"eval/loss": mean, "eval/perplexity": math.exp(mean)}
