"""Arguments that the verbs of clips share; nothing heavy is imported for them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from thorndike.cli.parser import Parser, at_least_zero, positive_whole
from thorndike.cli.record import probability
from thorndike.config_fields import fields_in_source
from thorndike.errors import UserError
from thorndike.settings import FieldFacts, describe_kind, parse_settings

FACTS, STORE = "clips.json", "choices.db"
LENGTH = 25


def add_clip_arguments(parser: Parser) -> None:
    """What a clip is, and what is asked of it."""
    parser.add_argument("--length", type=positive_whole, default=LENGTH, metavar="STEPS", help=f"of a clip (default: {LENGTH})")
    parser.add_argument("--question", metavar="TEXT", help="what people are asked (default: which does better what you want)")


def add_rater_arguments(parser: Parser, temperature: str = "--temperature") -> None:
    """How a program chooses; ``temperature`` is that flag's name, which settings of learners have, too."""
    parser.add_argument(
        temperature,
        dest="temperature",
        type=at_least_zero,
        default=1.0,
        metavar="T",
        help="it chooses by Bradley-Terry on the clips' returns over T; 0: always the better one (default: 1)",
    )
    parser.add_argument(
        "--error-rate", type=probability, default=0.0, metavar="X", help="this share of its choices is random (default: 0; the paper: 0.1)"
    )


def clips_folder(path: Path) -> Path:
    """A folder of clips. Raises ``UserError`` for something else, before anything heavy is imported."""
    if not (path / FACTS).is_file():
        raise UserError(f"{path} is no folder of clips: it has no {FACTS}; make one: thorndike clips collect ENVIRONMENT --to DIR")
    return path


def reward_settings(texts: Sequence[str]) -> dict[str, object]:
    """The settings of a reward that were given, checked. Raises ``UserError``."""
    return parse_settings(list(texts), _known(), "reward")


def settings_in_words() -> str:
    """The settings of a reward as lines of a verb's help."""
    return "\n".join(f"  {each.name} = {each.default}  {each.comment or describe_kind(each.kind)}" for each in _known().values())


def to_label(folder: Path) -> str:
    """The command of the page on which a folder's clips are judged."""
    return f"thorndike language label --db {folder / STORE}"


def _known() -> Mapping[str, FieldFacts]:
    source = Path(__file__).parents[2] / "clips" / "reward_fitting.py"
    return fields_in_source(source.read_text(encoding="utf-8"))
