"""``thorndike language generate MODEL``: continuations of prompts."""

import json
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer, printable
from thorndike.cli.language.arguments import add_model_argument, add_sampling_arguments, prepare_device
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError

EXAMPLES = """\
  thorndike language generate runs/base/model --prompt "The film was" --samples 4
  thorndike language generate MODEL --prompts prompts.jsonl --samples 4 --to candidates.jsonl
  thorndike language generate MODEL --prompt "The film was" --temperature 0"""


def run(words: Sequence[str]) -> Answer:
    """Go on with prompts, and show or keep what was written."""
    parser = Parser("language generate", "Go on with prompts: texts, or conversations by the model's chat template.", EXAMPLES)
    add_model_argument(parser)
    parser.add_argument("--prompt", action="append", default=[], metavar="TEXT", help="a prompt; may be repeated")
    parser.add_argument("--prompts", type=Path, metavar="FILE", help="rows with a column prompt: .jsonl, .json, .csv")
    parser.add_argument("--samples", type=positive_whole, default=1, metavar="N", help="continuations of each prompt (default: 1)")
    add_sampling_arguments(parser, 64)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that all samples follow from (default: 0)")
    parser.add_argument("--batch-size", type=positive_whole, default=64, metavar="N", help="prompts at a time (default: 64)")
    parser.add_argument("--to", type=Path, metavar="FILE", help="write them there, one JSON object with prompt and completions a line")
    options = parser.parse(words)
    if not options.prompt and options.prompts is None:
        raise UserError("generate needs prompts: --prompt TEXT, or --prompts FILE")
    if options.to is not None and options.to.exists():
        raise UserError(f"--to {options.to} is there already: nothing is written over; choose another file")
    prepare_device(options.device, options.model)
    from thorndike.language.data import read_rows, text_at
    from thorndike.language.generation import Sampling, generate_texts
    from thorndike.language.model import load_model

    model = load_model(options.model, adapter=options.adapter)
    prompts = [*options.prompt, *([] if options.prompts is None else [text_at(row, "prompt") for row in read_rows(options.prompts)])]
    found = generate_texts(
        model,
        prompts,
        max_new_tokens=options.max_new_tokens,
        sampling=Sampling(options.temperature, options.top_k, options.top_p),
        samples=options.samples,
        seed=options.seed,
        batch_size=options.batch_size,
    )
    rows = [{"prompt": prompt, "completions": texts} for prompt, texts in zip(prompts, found, strict=True)]
    data = {"model": options.model, "samples": options.samples, "seed": options.seed}
    if options.to is not None:
        options.to.write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows), encoding="utf-8")
        return Answer(
            data | {"file": options.to, "prompts": len(rows)}, f"{len(rows)} prompts, {options.samples} samples each: {options.to}"
        )
    lines = [printable(f"{row['prompt']}|{text}".replace("\n", " ")) for row in rows for text in row["completions"]]
    return Answer(data | {"rows": rows}, "\n".join(lines))
