"""``thorndike language generate MODEL``: continuations of prompts."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from thorndike.cli.answer import Answer, printable
from thorndike.cli.language.arguments import add_ignore_eos_argument, add_model_argument, add_sampling_arguments, prepare_device
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError

if TYPE_CHECKING:
    from thorndike.language.data import Text

EXAMPLES = """\
  thorndike language generate runs/base/model --prompt "The film was" --samples 4
  thorndike language generate MODEL --prompts prompts.jsonl --samples 4 --to candidates.jsonl
  thorndike language generate MODEL --prompts prompts.jsonl --samples 16 --reward runs/reward/model --to best.jsonl
  thorndike language generate MODEL --prompt "The film was" --temperature 0"""


def run(words: Sequence[str]) -> Answer:
    """Go on with prompts, and show or keep what was written."""
    parser = Parser("language generate", "Go on with prompts: texts, or conversations by the model's chat template.", EXAMPLES)
    add_model_argument(parser)
    parser.add_argument("--prompt", action="append", default=[], metavar="TEXT", help="a prompt; may be repeated")
    parser.add_argument("--prompts", type=Path, metavar="FILE", help="rows with a column prompt: .jsonl, .json, .csv")
    parser.add_argument("--samples", type=positive_whole, default=1, metavar="N", help="continuations of each prompt (default: 1)")
    add_sampling_arguments(parser, 64)
    add_ignore_eos_argument(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that all samples follow from (default: 0)")
    parser.add_argument("--batch-size", type=positive_whole, default=64, metavar="N", help="prompts at a time (default: 64)")
    parser.add_argument("--reward", action="append", default=[], metavar="WHAT", help="keep the best of a prompt's samples by this reward")
    parser.add_argument("--to", type=Path, metavar="FILE", help="write them there, one JSON object with prompt and completions a line")
    options = parse_with_config(parser, words, "generate", None)
    if not options.prompt and options.prompts is None:
        raise UserError("generate needs prompts: --prompt TEXT, or --prompts FILE")
    if options.to is not None and options.to.exists():
        raise UserError(f"--to {options.to} is there already: nothing is written over; choose another file")
    if options.reward and (options.top_k, options.top_p, options.adapter) != (0, 1.0, None):
        raise UserError("--reward chooses among samples of the model's own distribution: leave --top-k, --top-p and --adapter out")
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model)
    from thorndike.language.data import read_rows, text_at

    prompts: list[Text] = [*options.prompt]
    if options.prompts is not None:
        prompts += [text_at(row, "prompt") for row in read_rows(options.prompts)]
    rows = _best_rows(options, prompts) if options.reward else _rows(options, prompts)
    data = {"model": options.model, "samples": options.samples, "seed": options.seed}
    if options.to is not None:
        options.to.write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows), encoding="utf-8")
        kept = f"the best of {options.samples} samples each" if options.reward else f"{options.samples} samples each"
        return Answer(data | {"file": options.to, "prompts": len(rows)}, f"{len(rows)} prompts, {kept}: {options.to}")
    lines = [
        printable(f"{row['prompt']}|{text}".replace("\n", " "))
        for row in rows
        for text in ([row["completion"]] if options.reward else cast(list[str], row["completions"]))
    ]
    return Answer(data | {"rows": rows}, "\n".join(lines))


def _rows(options: argparse.Namespace, prompts: "Sequence[Text]") -> list[dict[str, object]]:
    """All samples of each prompt."""
    from thorndike.language.generation import Sampling, generate_texts
    from thorndike.language.model import load_model, never_ending

    model = load_model(options.model, adapter=options.adapter)
    found = generate_texts(
        never_ending(model) if options.ignore_eos else model, prompts, max_new_tokens=options.max_new_tokens,
        sampling=Sampling(options.temperature, options.top_k, options.top_p), samples=options.samples, seed=options.seed,
        batch_size=options.batch_size,
    )  # fmt: skip
    return [{"prompt": prompt, "completions": texts} for prompt, texts in zip(prompts, found, strict=True)]


def _best_rows(options: argparse.Namespace, prompts: "Sequence[Text]") -> list[dict[str, object]]:
    """The best of each prompt's samples."""
    from thorndike.language.aligning import best_completions, parse_reward

    texts = [prompt for prompt in prompts if isinstance(prompt, str)]
    if len(texts) < len(prompts):
        raise UserError("--reward takes prompts that are texts; this file has conversations")
    return best_completions(
        options.model, [parse_reward(each) for each in options.reward], texts, options.samples, max_new_tokens=options.max_new_tokens,
        temperature=options.temperature, seed=options.seed, ignore_eos=options.ignore_eos, batch_size=options.batch_size,
    )  # fmt: skip
