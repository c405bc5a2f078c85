"""The folder that all contestants of ``language_speed.py`` read: a random Llama, a reward model of its shape, prompts, preferences.

A word of the vocabulary is a token, so that both sides make the same tokens of the same files. Called as
``language_models.py SIZE FOLDER``, it makes one and prints the number of parameters.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np
import tokenizers
from tokenizers import models, pre_tokenizers

from thorndike.language.decoder import initial_params
from thorndike.language.model import LanguageModel, save_model
from thorndike.language.model_config import ModelConfig, parse_model_config
from thorndike.language.reward_files import RewardModel, save_reward_model
from thorndike.language.scalar_head import with_scalar_head
from thorndike.language.tokenizer import Tokenizer, new_tokenizer

sys.path.insert(0, str(Path(__file__).parent / "peers"))

from language_task import BOS, EOS, NEW, PAD, PROMPT, SIZES

ROWS = 1024


def config_of(size: str) -> ModelConfig:
    vocabulary, width, layers, heads, inner = SIZES[size]
    return parse_model_config(
        {
            "model_type": "llama", "vocab_size": vocabulary, "hidden_size": width, "num_hidden_layers": layers,
            "num_attention_heads": heads, "num_key_value_heads": heads, "intermediate_size": inner,
            "max_position_embeddings": 512, "tie_word_embeddings": True,
            "pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2,
        }
    )  # fmt: skip


def words(vocabulary: int) -> Tokenizer:
    """``w3``, ``w4``, ... with spaces between them."""
    names = [PAD, BOS, EOS, *(f"w{number}" for number in range(3, vocabulary))]
    inner = tokenizers.Tokenizer(models.WordLevel({name: number for number, name in enumerate(names)}, unk_token=PAD))
    inner.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    inner.add_special_tokens([PAD, BOS, EOS])
    return new_tokenizer(inner, BOS, EOS, PAD)


def make_folder(size: str, folder: Path) -> int:
    """Write ``policy``, ``reward``, ``prompts.jsonl`` and ``preferences.jsonl``; the number of the policy's parameters."""
    config, key = config_of(size), jax.random.key(0)
    tokenizer = words(config.vocab_size)
    params = initial_params(config, key)
    save_model(LanguageModel(config, params, tokenizer), folder / "policy")
    scored, scored_config = with_scalar_head(params, config, jax.random.fold_in(key, 1))
    save_reward_model(RewardModel(scored_config, (scored,), tokenizer, "last"), folder / "reward")
    generator = np.random.default_rng(0)

    def text(length: int) -> str:
        return " ".join(f"w{number}" for number in generator.integers(3, config.vocab_size, length))

    # The end of a text is the last of its NEW tokens; both sides add it.
    rows = [{"prompt": text(PROMPT), "chosen": " " + text(NEW - 1), "rejected": " " + text(NEW - 1)} for _ in range(ROWS)]
    (folder / "preferences.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "prompts.jsonl").write_text("".join(json.dumps({"prompt": row["prompt"]}) + "\n" for row in rows))
    return sum(leaf.size for leaf in jax.tree.leaves(params))


if __name__ == "__main__":
    print(make_folder(sys.argv[1], Path(sys.argv[2])))
