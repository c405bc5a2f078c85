"""``thorndike language reward MODEL``: a reward model from preferences."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.aligning import add_training_arguments, lora_of
from thorndike.cli.language.arguments import given_settings, prepare_device, settings_in_words, sharing
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.parser import Parser, positive_whole

EXAMPLES = """\
  thorndike language reward MODEL --data preferences.jsonl --out runs/reward
  thorndike language reward MODEL --data preferences.jsonl --out runs/reward --members 3 --set pool=mean
The same command again goes on where it stopped. Without total_steps it is one pass over the data. Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Learn, and say how good it is on what was held out."""
    summary = "Learn a reward model from preferences; models of a few million parameters want pool=mean."
    parser = Parser("language reward", summary, EXAMPLES.format(settings=settings_in_words("reward_model")))
    add_training_arguments(parser)
    parser.add_argument("--data", type=Path, action="append", required=True, metavar="FILE", help="rows with chosen and rejected")
    parser.add_argument(
        "--held-out", type=Path, action="append", default=[], metavar="FILE", help="rows to measure with (default: a tenth)"
    )
    parser.add_argument("--members", type=positive_whole, default=1, metavar="N", help="models whose mean is the reward (default: 1)")
    options = parse_with_config(parser, words, "reward", "reward_model")
    settings = given_settings(options.settings, "reward_model")
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model, options.devices)
    from thorndike.language.aligning import train_reward_model

    with sharing(options.devices):
        found = train_reward_model(
            options.model, options.data, options.held_out, options.out, settings, members=options.members, seed=options.seed,
            lora=lora_of(options.lora), dtype=options.dtype,
        )  # fmt: skip
    if found is None:
        return Answer({"run": options.out, "status": "interrupted"}, "interrupted\nthe same command again goes on from here", 130)
    low, high = found.accuracy_ci95
    lines = [
        f"right on {found.accuracy:.1%} [{low:.1%}, {high:.1%}] of {found.pairs} held-out pairs; "
        f"calibration error {found.calibration_error:.3f}",
        *(f"  rewards {each.low:.2f} to {each.high:.2f} apart: {each.accuracy:.1%} of {each.pairs}" for each in found.by_gap),
        f"model: {options.out / 'model'}",
    ]
    if found.near_chance:
        lines.append("that is near chance: no policy is trained on it; give it more comparisons, or train it longer")
    data = {"run": options.out, "status": "finished", "model": options.out / "model", **found._asdict(), "near_chance": found.near_chance}
    return Answer(data | {"by_gap": [each._asdict() for each in found.by_gap]}, "\n".join(lines))
