"""``thorndike clips fit DIR``: a reward from the choices so far."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.clips.arguments import clips_folder, reward_settings, settings_in_words
from thorndike.cli.parser import Parser, seed_number

EXAMPLES = """\
  thorndike clips fit runs/swing
  thorndike clips fit runs/swing --set members=5 --set error_rate=0.05
Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Learn, and say how far the reward can be trusted."""
    parser = Parser("clips fit", "Learn a reward from all choices in a folder of clips.", EXAMPLES.format(settings=settings_in_words()))
    parser.add_argument("folder", metavar="DIR", type=Path, help="a folder of clips")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="a setting; may be repeated")
    parser.add_argument("--seed", type=seed_number, default=0, help="what the networks begin with (default: 0)")
    options = parser.parse(words)
    folder, settings = clips_folder(options.folder), reward_settings(options.settings)
    from thorndike.api.clips import fit_clips
    from thorndike.clips.folder import read_about

    found = fit_clips(folder, settings=settings, seed=options.seed)
    report, environment = found.report, read_about(folder).environment
    low, high = report.accuracy_ci95
    lines = [f"learnt from {report.choices} choices; right on {report.accuracy:.1%} [{low:.1%}, {high:.1%}] of {report.held_out} held out"]
    if report.near_chance:
        lines.append("guessing would explain that: judge more pairs before an agent learns from it")
    lines += [f"reward: {found.reward}", f"next: thorndike train ppo {environment} --reward {folder}"]
    return Answer({"reward": found.reward, **report._asdict(), "near_chance": report.near_chance}, "\n".join(lines))
