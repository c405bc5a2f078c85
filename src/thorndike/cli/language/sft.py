"""``thorndike language sft MODEL``: supervised fine-tuning."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import (
    add_device_argument,
    add_precision_arguments,
    add_settings_argument,
    configured,
    given_settings,
    prepare_device,
    settings_in_words,
    sharing,
)
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.language.report import report
from thorndike.cli.parser import Parser, positive_whole, seed_number

EXAMPLES = """\
  thorndike language sft MODEL --data answers.jsonl --out runs/tuned
  thorndike language sft MODEL --data a.jsonl --data b.csv --out runs/tuned --lora 16 --set learning_rate=2e-4
The same command again goes on where it stopped. Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Learn from rows, and say how well."""
    parser = Parser("language sft", "Fine-tune a model on TRL's formats.", EXAMPLES.format(settings=settings_in_words("sft")))
    parser.add_argument("model", metavar="MODEL", type=Path, help="a folder as save_pretrained writes it, or owner/name on the hub")
    parser.add_argument("--data", type=Path, action="append", required=True, metavar="FILE", help="rows to learn from; may be repeated")
    parser.add_argument("--held-out", type=Path, action="append", default=[], metavar="FILE", help="rows to measure with")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the run's folder; its model/ is a Hugging Face folder")
    parser.add_argument("--lora", type=positive_whole, metavar="RANK", help="learn an adapter of this rank instead of all parameters")
    parser.add_argument("--lora-alpha", type=positive_whole, metavar="ALPHA", help="the adapter's scale (default: twice its rank)")
    parser.add_argument("--lora-targets", metavar="NAMES", help="adapt only these modules: q_proj,v_proj (default: all matrices)")
    add_settings_argument(parser)
    add_precision_arguments(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    add_device_argument(parser)
    options = parse_with_config(parser, words, "sft", "sft")
    settings = given_settings(options.settings, "sft")
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model, options.devices)
    from thorndike.language.fine_tuning import fine_tune
    from thorndike.language.lora import LoraConfig
    from thorndike.language.sft import Config

    targets = tuple(options.lora_targets.split(",")) if options.lora_targets else ()
    lora = None if options.lora is None else LoraConfig(options.lora, float(options.lora_alpha or 2 * options.lora), targets)
    with sharing(options.devices):
        found = fine_tune(
            options.model, options.data, options.out, configured(Config, settings), lora=lora, held_out=options.held_out,
            seed=options.seed, dtype=options.dtype,
        )  # fmt: skip
    return report(found)
