"""``thorndike language pretrain CORPUS``: a small model from nothing."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import (
    add_device_argument,
    add_settings_argument,
    configured,
    given_settings,
    prepare_device,
    settings_in_words,
)
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.report import report
from thorndike.cli.parser import Parser, seed_number

EXAMPLES = """\
  thorndike language pretrain movie-reviews --out runs/base
  thorndike language pretrain texts.txt --out runs/base --set hidden_size=256 --set total_steps=2000
The same command again goes on where it stopped. Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Learn from a corpus, and say how well."""
    examples = EXAMPLES.format(settings=settings_in_words("pretraining"))
    parser = Parser("language pretrain", "Learn a tokenizer and a small model from plain text.", examples)
    parser.add_argument("corpus", metavar="CORPUS", help="movie-reviews (a package), a .txt of paragraphs, or rows with a column text")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the run's folder; its model/ is a Hugging Face folder")
    add_settings_argument(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    add_device_argument(parser)
    options = parse_with_config(parser, words, "pretrain", "pretraining")
    settings = given_settings(options.settings, "pretraining")
    prepare_device(options.device, None)
    from thorndike.language.pretraining import Config, pretrain

    return report(pretrain(options.corpus, options.out, configured(Config, settings), options.seed))
