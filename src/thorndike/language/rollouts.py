"""Texts that a policy writes, and what is known of them: rewards, the distance to the reference, as learners from rewards need it.

Tokens go in as they were sampled and are never made from text again; only what is scored is text. All logits are divided by the temperature
that was sampled at: the policy's when it acted, the policy's when it learns, the reference's.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from thorndike.errors import UserError
from thorndike.functional.policy_divergence import categorical_divergence
from thorndike.functional.token_rewards import kl_estimate
from thorndike.language.data import Text, prompts_tokens
from thorndike.language.decoder import Params, by_vocabulary, hidden_states, logits, token_log_probs
from thorndike.language.generation import Generated, Sampling, generate, left_padded
from thorndike.language.model_config import ModelConfig
from thorndike.language.rewards import Score, checked_scores
from thorndike.language.tokenizer import Tokenizer
from thorndike.training.devices import rows_shared
from thorndike.types import Metrics


class Prompts(NamedTuple):
    """What is to be answered, all padded on the left to one width, so that one program serves every batch."""

    tokens: Int[np.ndarray, "N P"]
    segments: Int[np.ndarray, "N P"]
    texts: tuple[str, ...]


class Rollout(NamedTuple):
    """Prompts and the completions sampled after them, ``N`` tokens at most."""

    tokens: Int[Array, "B T"]
    """Padding, prompt, completion, padding."""
    segments: Int[Array, "B T"]
    """1 for prompt and completion, 0 for padding."""
    log_probs: Float[Array, "B N"]
    """Of the completion's tokens when they were sampled."""
    valid: Bool[Array, "B N"]
    """Which of the completion's tokens are there: those up to its first stop token."""
    ended: Bool[Array, " B"]
    """Whether a stop token ended it."""


class Distance(NamedTuple):
    """How far the policy is from the reference at each of the completion's tokens; 0 where there is none."""

    log_probs: Float[Array, "B N"]
    """Of the policy, by a forward pass over the whole text."""
    reference_log_probs: Float[Array, "B N"]
    exact_kl: Float[Array, "B N"]
    """KL(policy || reference) over the whole vocabulary in that state: never negative, whatever was sampled."""


def make_prompts(prompts: Sequence[Text], tokenizer: Tokenizer, width: int) -> Prompts:
    """Prompts in tokens; the text of a conversation is what the chat template makes of it.

    Raises ``UserError`` for one that is empty or longer than ``width``.
    """
    encoded = prompts_tokens(prompts, tokenizer)
    texts = tuple(each if isinstance(each, str) else tokenizer.chat(each) for each in prompts)
    for number, each in enumerate(encoded, 1):
        if not 0 < len(each) <= width:
            raise UserError(f"prompt {number} has {len(each)} tokens; expected 1 to {width}: leave it out, or raise max_prompt_length")
    tokens, segments = left_padded(encoded, tokenizer.pad_id, width)
    return Prompts(np.asarray(tokens), np.asarray(segments), texts)


def choose_prompts(prompts: Prompts, key: Key[Array, ""], number: int) -> Int[np.ndarray, " number"]:
    """Which prompts are answered: all before any is answered again, where there are enough. Consumes the key."""
    rows = len(prompts.texts)
    rounds = -(-number // rows)
    order = jnp.concatenate([jax.random.permutation(each, rows) for each in jax.random.split(key, rounds)])
    return np.asarray(order[:number])


def sample_rollout(
    params: Params, config: ModelConfig, prompts: Prompts, rows: Int[np.ndarray, " n"], key: Key[Array, ""], *, max_new_tokens: int,
    temperature: float, stop_tokens: Sequence[int], pad_id: int, samples: int = 1,
) -> Rollout:  # fmt: skip
    """Completions of some prompts, ``samples`` of each side by side. Consumes the key."""
    tokens, segments = rows_shared((jnp.asarray(prompts.tokens[rows]), jnp.asarray(prompts.segments[rows])))
    found = generate(
        params, config, tokens, segments, key, max_new_tokens=max_new_tokens, sampling=Sampling(temperature), stop_tokens=stop_tokens,
        samples=samples, pad_id=pad_id,
    )  # fmt: skip
    return as_rollout(tokens, segments, found)


@jax.jit
def as_rollout(tokens: Int[Array, "n P"], segments: Int[Array, "n P"], generated: Generated) -> Rollout:
    """Prompts and what was generated after them as one array."""
    samples = generated.tokens.shape[0] // tokens.shape[0]
    tokens, segments = jnp.repeat(tokens, samples, axis=0), jnp.repeat(segments, samples, axis=0)
    valid = jnp.arange(generated.tokens.shape[1])[None] < generated.lengths[:, None]
    return Rollout(
        jnp.concatenate([tokens, generated.tokens], axis=1), jnp.concatenate([segments, valid.astype(jnp.int32)], axis=1),
        generated.log_probs, valid, generated.ended,
    )  # fmt: skip


def before_tokens(hidden: Float[Array, "B T d"], number: int) -> Float[Array, "B N d"]:
    """The hidden states that the last ``number`` tokens were chosen from."""
    return hidden[:, -number - 1 : -1]


@partial(jax.jit, static_argnames=("config", "temperature"))
def distance(params: Params, reference: Params, config: ModelConfig, rollout: Rollout, temperature: float) -> Distance:
    """Policy and reference on the same texts, never with all logits of either in memory."""
    number = rollout.valid.shape[1]
    targets = rollout.tokens[:, -number:]
    rows = [before_tokens(hidden_states(each, config, rollout.tokens, rollout.segments), number) for each in (params, reference)]
    flat = [each.reshape(-1, each.shape[-1]) for each in rows]

    def divergence(ours: Array, theirs: Array) -> Array:
        return categorical_divergence(logits(params, config, ours) / temperature, logits(reference, config, theirs) / temperature)

    # Rounding gives -1e-7 for equal rows.
    exact = jnp.maximum(by_vocabulary(divergence, (flat[0], flat[1]), config.vocab_size).reshape(targets.shape), 0.0)
    ours, theirs = (token_log_probs(p, config, h, targets, temperature) for p, h in zip((params, reference), rows, strict=True))
    return Distance(*(jnp.where(rollout.valid, each, 0.0) for each in (ours, theirs, exact)))


@jax.jit
def distance_metrics(rollout: Rollout, found: Distance) -> Metrics:
    """The divergence in nats a text: exact, and by the estimators of Schulman 2020; ``train/log_prob_gap``: sampling beside reading."""
    log_ratio = found.log_probs - found.reference_log_probs
    metrics = {"objective/kl": jnp.mean(jnp.sum(found.exact_kl, axis=1))}
    for kind in ("k1", "k2", "k3"):
        by_token = jnp.where(rollout.valid, kl_estimate(log_ratio, kind), 0.0)
        metrics[f"objective/kl_{kind}"] = jnp.mean(jnp.sum(by_token, axis=1))
    metrics["objective/kl_per_token"] = jnp.sum(found.exact_kl) / jnp.maximum(jnp.sum(rollout.valid), 1)
    metrics["train/log_prob_gap"] = jnp.max(jnp.abs(jnp.where(rollout.valid, found.log_probs - rollout.log_probs, 0.0)))
    return metrics


class Written(NamedTuple):
    """A rollout as text, on the host."""

    prompts: list[str]
    completions: list[str]
    ids: list[list[int]]
    """Tokens of prompt and completion."""
    lengths: Int[np.ndarray, " B"]
    """Tokens of the completions."""
    ended: Bool[np.ndarray, " B"]


def as_written(rollout: Rollout, tokenizer: Tokenizer) -> Written:
    """The text of every row."""
    tokens, segments, valid, ended = (np.asarray(part) for part in (rollout.tokens, rollout.segments, rollout.valid, rollout.ended))
    width = tokens.shape[1] - valid.shape[1]
    ids = [row[kept > 0].tolist() for row, kept in zip(tokens, segments, strict=True)]
    prompts = [tokenizer.decode(row[kept > 0]) for row, kept in zip(tokens[:, :width], segments[:, :width], strict=True)]
    completions = [tokenizer.decode(row[kept]) for row, kept in zip(tokens[:, width:], valid, strict=True)]
    return Written(prompts, completions, ids, valid.sum(axis=1), ended)


def scored(score: Score, written: Written, missing_eos_penalty: float | None) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"]]:
    """What the reward says, and the same less the penalty of what never ended (Ziegler et al. 2019; Huang et al. 2024)."""
    raw = checked_scores(score, written.prompts, written.completions, written.ids)
    return raw, raw if missing_eos_penalty is None else raw - missing_eos_penalty * ~written.ended
