"""Speed of language models beside transformers, alternating, on one core with one thread; the models are random ones of two sizes.

    .venv/bin/python benchmarks/language_speed.py --repeats 3 --core 1

The peers' environment is ``.venv-peers`` (``make bench`` makes it), or what ``--peers`` says.
"""

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path

import jax

from processes import run_pinned
from thorndike.language.decoder import initial_params
from thorndike.language.model_config import ModelConfig, parse_model_config, write_model_config
from thorndike.language.weights import save_params

HERE = Path(__file__).parent
SIZES = {"1.07 M": (2048, 128, 4, 4, 352), "7.5 M": (4096, 256, 8, 8, 688)}
"""Vocabulary, width, layers, heads, inner width."""
GENERATION = {"--batch": 128, "--prompt": 8, "--new": 24}


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


def measured(command: list[str], source: Path, core: int, cache: Path) -> dict[str, float]:
    """What one process said of itself. Raises ``SystemExit`` with its last words if it failed."""
    done = run_pinned(command, {"PYTHONPATH": str(source), "THORNDIKE_CACHE": str(cache), "HF_HUB_OFFLINE": "1"}, core, 900)
    if done.exit_code:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=5, help="calls of generate a process")
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--peers", type=Path, default=HERE.parent / ".venv-peers" / "bin" / "python")
    options = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in options.sizes.split(","):
            config, at = config_of(size), Path(folder) / size.replace(" ", "")
            at.mkdir()
            params = initial_params(config, jax.random.key(0))
            save_params(params, config, at)
            write_model_config(config, at)
            settings = [str(word) for pair in GENERATION.items() for word in pair] + ["--rounds", str(options.rounds), str(at)]
            found: dict[str, list[dict[str, float]]] = {"Thorndike": [], "transformers": []}
            for _ in range(options.repeats):
                ours = [sys.executable, str(HERE / "thorndike_generate.py"), *settings]
                theirs = [str(options.peers), str(HERE / "peers" / "transformers_generate.py"), *settings]
                found["Thorndike"].append(measured(ours, HERE.parent / "src", options.core, Path(folder) / "cache"))
                found["transformers"].append(measured(theirs, HERE / "peers", options.core, Path(folder) / "cache"))
            rates = {
                name: {
                    "parameters": sum(leaf.size for leaf in jax.tree.leaves(params)),
                    "tokens_per_s": statistics.median(run["steps"] / run["wall_s"] for run in runs),
                    "tokens_per_cpu_s": statistics.median(run["steps"] / run["cpu_s"] for run in runs),
                    "peak_memory_mb": statistics.median(run["peak_memory_mb"] for run in runs),
                }
                for name, runs in found.items()
            }
            ratios = [
                (one["steps"] / one["cpu_s"]) / (other["steps"] / other["cpu_s"])
                for one, other in zip(found["Thorndike"], found["transformers"], strict=True)
            ]
            results[size] = rates | {"ratio_per_cpu_s": statistics.median(ratios), "ratios": ratios}
            print(json.dumps({size: results[size]}))


if __name__ == "__main__":
    main()
