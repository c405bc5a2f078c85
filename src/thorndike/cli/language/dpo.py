"""``thorndike language dpo MODEL``: a policy from preferences, without a reward model."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import add_training_arguments, lora_of
from thorndike.cli.language.arguments import given_settings, prepare_device, settings_in_words, sharing
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.language.report import report
from thorndike.cli.parser import Parser

EXAMPLES = """\
  thorndike language dpo MODEL --data preferences.jsonl --out runs/dpo
  thorndike language dpo MODEL --data preferences.jsonl --out runs/dpo --set beta=0.05 --set label_smoothing=0.1
The same command again goes on where it stopped. Without total_steps it is one pass over the data. Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Learn from preferences, and say how well."""
    parser = Parser("language dpo", "Direct preference optimisation on TRL's columns.", EXAMPLES.format(settings=settings_in_words("dpo")))
    add_training_arguments(parser)
    parser.add_argument("--data", type=Path, action="append", required=True, metavar="FILE", help="rows with chosen and rejected")
    options = parse_with_config(parser, words, "dpo", "dpo")
    settings = given_settings(options.settings, "dpo")
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model, options.devices)
    from thorndike.language.aligning import align_by_preferences

    with sharing(options.devices):
        found = align_by_preferences(
            options.model, options.data, options.out, settings, lora=lora_of(options.lora), seed=options.seed, dtype=options.dtype
        )
    return report(found)
