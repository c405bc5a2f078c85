"""How far the logits of each family are from transformers', on the tiny models of ``tests/language/reference``.

    .venv/bin/python benchmarks/language_parity.py

The largest difference over the largest logit, float32, texts padded on the left; and how many of 64 greedy tokens of three texts agree.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load_file

from thorndike.language.decoder import hidden_states, logits
from thorndike.language.generation import GREEDY, generate
from thorndike.language.model import load_decoder

REFERENCE = Path(__file__).parents[1] / "tests" / "language" / "reference"


def main() -> None:
    print(json.loads((REFERENCE / "versions.json").read_text()))
    for folder in sorted(REFERENCE.iterdir()):
        if not (folder / "config.json").exists() or folder.name.endswith("_scored"):
            continue
        expected = load_file(folder / "expected.safetensors")
        config, params = load_decoder(folder)
        tokens, segments = jnp.asarray(expected["tokens"], jnp.int32), jnp.asarray(expected["mask"], jnp.int32)
        found = np.asarray(logits(params, config, hidden_states(params, config, tokens, segments)) * segments[..., None])
        relative = np.abs(found - expected["logits"]).max() / np.abs(expected["logits"]).max()
        texts = generate(params, config, tokens, segments, jax.random.key(0), max_new_tokens=64, sampling=GREEDY)
        agree = f"{int((texts.tokens == expected['greedy']).sum())}/{expected['greedy'].size}"
        print(f"{folder.name:14} {config.model_type:12} {relative:.1e} {agree}")


if __name__ == "__main__":
    main()
