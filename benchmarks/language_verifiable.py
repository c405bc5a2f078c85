"""GRPO and RLOO on sums whose answers a function checks: `python benchmarks/language_verifiable.py [--seeds 3] [--learners grpo,rloo]`.

The model first reads sums of which seven in ten are wrong, so that it knows the form and is seldom right; then it is rewarded for right
answers. Printed and written to benchmarks/results/language/verifiable.json: accuracy before and after on all sums, ten samples of each. A
seed that is interrupted is not reported; the same command goes on with it, and passes over those that are done (in --runs).
"""

import argparse
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tokenizers
from tokenizers import decoders, models, pre_tokenizers

from machine import commit, processor
from thorndike.language.decoder import initial_params
from thorndike.language.grpo import Config, grpo
from thorndike.language.model import LanguageModel
from thorndike.language.over_optimisation import Limits
from thorndike.language.policy_training import Task, train_policy
from thorndike.language.pretraining import Config as ModelSize
from thorndike.language.pretraining import small_llama
from thorndike.language.rollouts import Prompts, make_prompts
from thorndike.language.sft import Config as SftConfig
from thorndike.language.sft import TextBatch, sft
from thorndike.language.text_run import open_run
from thorndike.language.tokenizer import Tokenizer, new_tokenizer
from thorndike.language.win_rate import written_by
from thorndike.statistics import summary

SUMS = [f"{a}+{b}=" for a in range(10) for b in range(10)]
WRONG, WIDTH, NEW = 0.7, 8, 3
SIZE = ModelSize(vocab_size=260, hidden_size=64, num_layers=2, num_heads=4, intermediate_size=128)
ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "language" / "verifiable.json"
DONE = "accuracy.json"


def is_right(prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> list[float]:
    """1 for the sum, 0 for anything else."""
    return [float(answer == str(int(prompt[0]) + int(prompt[2]))) for prompt, answer in zip(prompts, completions, strict=True)]


def characters() -> Tokenizer:
    names = ["<pad>", "</s>", *"0123456789+="]
    inner = tokenizers.Tokenizer(models.WordLevel({name: number for number, name in enumerate(names)}, unk_token="<pad>"))
    inner.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    inner.decoder = decoders.Fuse()
    inner.add_special_tokens(["<pad>", "</s>"])
    return new_tokenizer(inner, None, "</s>", "<pad>")


def warmed_up(seed: int, steps: int = 400, rows: int = 128) -> LanguageModel:
    """A model that has read sums, most of them wrong."""
    tokenizer = characters()
    config = small_llama(SIZE, tokenizer)
    learner = sft(SftConfig(total_steps=steps, learning_rate="linear(3e-3, 0)", batch_size=rows), config)
    state = learner.init(initial_params(config, jax.random.key(seed)), jax.random.key(seed))
    update, generator = jax.jit(learner.update, donate_argnums=0), np.random.default_rng(seed)
    for _ in range(steps):
        tokens, segments = np.zeros((rows, WIDTH), np.int32), np.zeros((rows, WIDTH), np.int32)
        for row in range(rows):
            a, b = generator.integers(0, 10, 2)
            answer = generator.integers(0, 19) if generator.random() < WRONG else a + b
            text = [*tokenizer.encode(f"{a}+{b}={answer}"), tokenizer.eos_id]
            tokens[row, : len(text)], segments[row, : len(text)] = text, 1
        learn = np.broadcast_to(np.arange(WIDTH) >= 4, tokens.shape)
        state, _ = update(state, (), TextBatch(*map(jnp.asarray, (tokens, segments, learn))))
    return LanguageModel(config, learner.params(state, ()), tokenizer)


def accuracy(base: LanguageModel, params: object, prompts: Prompts, seed: int) -> float:
    written, _, _ = written_by(base, params, prompts, jax.random.key(1000 + seed), NEW, 1.0, 1000)
    return float(np.mean(is_right(written.prompts, written.completions, written.ids)))


def one(learner: str, seed: int, steps: int, run: Path) -> dict[str, object] | None:
    """What a seed came to; None where it was interrupted."""
    if (run / DONE).exists():
        return json.loads((run / DONE).read_text())
    base = warmed_up(seed)
    prompts = make_prompts(SUMS, base.tokenizer, 4)
    often = make_prompts(SUMS * 10, base.tokenizer, 4)
    before, began = accuracy(base, base.params, often, seed), time.process_time()
    config = Config(
        total_steps=steps, episodes=256, group=8, batch_size=128, max_prompt_length=4, max_new_tokens=NEW, learning_rate=1e-3,
        kl_coefficient=0.01, baseline="leave_one_out" if learner == "rloo" else "group",
    )  # fmt: skip
    open_run(run, {"learner": learner, "seed": seed, "steps": steps})
    outcome = train_policy(
        Task(base, prompts, is_right), grpo(config, base.config, base.params), config, run, seed=seed,
        limits=Limits(None, None, None, None), checkpoint_every=50,
    )  # fmt: skip
    if not outcome.finished:
        return None
    after = accuracy(base, outcome.params, often, seed)
    found = {"learner": learner, "seed": seed, "before": before, "after": after, "gain": after - before, "kl": outcome.kl}
    found["cpu_s"] = time.process_time() - began
    (run / DONE).write_text(json.dumps(found))
    return found


def together(learner: str, found: Sequence[dict]) -> dict[str, object]:
    """The gain of all seeds, with its interval."""
    gain = summary(np.array([[row["gain"]] for row in found if row["learner"] == learner]))
    return {"learner": learner, "seeds": len(gain.per_seed), "gain": gain.mean, "least": gain.min, "ci95": gain.ci95}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--learners", default="grpo,rloo")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "verifiable", help="where the runs are made, and gone on with")
    options = parser.parse_args()
    found, learners = [], options.learners.split(",")
    show = partial(print, flush=True)
    for learner in learners:
        for seed in range(options.seeds):
            row = one(learner, seed, options.steps, options.runs / f"{learner}-{seed}-{options.steps}")
            if row is None:
                raise SystemExit(f"{learner}, seed {seed} was interrupted and is not reported: the same command goes on with it")
            found.append(row)
            show({name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()})
        show(together(learner, found))
    command = f"python benchmarks/language_verifiable.py --seeds {options.seeds} --steps {options.steps} --learners {options.learners}"
    about = {"command": command, "commit": commit(ROOT), "processor": processor(), "steps": options.steps}
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(about | {"learners": [together(each, found) for each in learners], "runs": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
