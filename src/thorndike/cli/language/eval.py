"""``thorndike language eval POLICY``: a policy beside its base."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import above_zero, comparison_data, in_words
from thorndike.cli.language.arguments import add_device_argument, add_ignore_eos_argument, prepare_device
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.parser import Parser, positive_whole, seed_number

EXAMPLES = """\
  thorndike language eval runs/ppo/model --base MODEL --prompts held_out.jsonl --reward runs/reward/model
  thorndike language eval runs/ppo/model --base MODEL --prompts held_out.jsonl --reward runs/reward/model --reward my_gold:score --json"""


def run(words: Sequence[str]) -> Answer:
    """Let both answer, and say who wins how often, and how far they are apart."""
    parser = Parser("language eval", "Win rate of a policy against its base, and its divergence from it.", EXAMPLES)
    parser.add_argument("policy", metavar="POLICY", type=Path, help="the model's folder")
    parser.add_argument("--base", type=Path, required=True, metavar="DIR", help="the folder of the model that it began as")
    parser.add_argument("--prompts", type=Path, action="append", required=True, metavar="FILE", help="rows with a column prompt")
    parser.add_argument("--reward", action="append", required=True, metavar="WHAT", help="a score; each is reported on its own")
    parser.add_argument("--max-new-tokens", type=positive_whole, default=64, metavar="N", help="at most (default: 64)")
    add_ignore_eos_argument(parser)
    parser.add_argument("--temperature", type=above_zero, default=1.0, metavar="T", help="of both (default: 1)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that all texts follow from (default: 0)")
    add_device_argument(parser)
    options = parse_with_config(parser, words, "eval", None)
    options.policy, options.base = model_folder(options.policy), model_folder(options.base)
    prepare_device(options.device, options.policy)
    from thorndike.language.aligning import compare_folders, parse_reward

    found = compare_folders(
        options.base, options.policy, options.prompts, [parse_reward(text) for text in options.reward],
        max_new_tokens=options.max_new_tokens, temperature=options.temperature, seed=options.seed,
        ignore_eos=options.ignore_eos,
    )  # fmt: skip
    return Answer({"policy": options.policy, "base": options.base, **comparison_data(found)}, in_words(found))
