"""``--config FILE.toml``: what the verbs of language models are to do, a table a step, in one file for all of them.

A key is a flag, a positional argument or a setting of ``--set``, by its name. What stands on the command line wins: a flag that may be
repeated replaces the file's list, a setting only itself. Paths mean what they mean on the command line.
"""

import argparse
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from thorndike.cli.language.arguments import known_settings
from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.settings import FieldFacts, parse_settings
from thorndike.suggestions import did_you_mean

STEPS = ("pretrain", "sft", "reward", "ppo", "grpo", "rloo", "dpo", "eval", "generate", "label", "chat")
"""The verbs that read such a file."""
_FLAG = "--config"
_NOT_IN_A_FILE = ("help", "json", "config", "settings")


def parse_with_config(parser: Parser, words: Sequence[str], step: str, module: str | None) -> argparse.Namespace:
    """The options in ``words``, and for what they leave out those of the table ``step`` of the file that ``--config`` names.

    ``module``: whose settings ``--set`` takes, if it is there. Raises ``UserError`` for an unknown key, naming the nearest known one.
    """
    parser.add_argument(_FLAG, type=Path, metavar="FILE", help=f"a TOML file with a table [{step}] of these arguments and settings")
    path = _named_file(words)
    if path is None:
        return parser.parse(words)
    arguments = {action.dest: action for action in parser._actions if action.dest not in _NOT_IN_A_FILE}
    known = {} if module is None else known_settings(module)
    lists: dict[str, list[object]] = {}
    settings: list[str] = []
    for key, value in _table(path, step).items():
        name, where = key.replace("-", "_"), f"{path}: [{step}] {key}"
        if name in arguments:
            action = arguments[name]
            given = _argument(action, value, where)
            if isinstance(given, list):
                lists[name], action.default = given, None
            else:
                action.default = given
            action.required = False
            if not action.option_strings:
                action.nargs = "?"
        elif name in known:
            settings.append(_setting(name, value, known, step, where))
        else:
            raise UserError(f"{where}: there is no such key{did_you_mean(name, [*arguments, *known])}")
    options = parser.parse(words)
    for name, given in lists.items():
        if getattr(options, name) is None:
            setattr(options, name, given)
    if settings:
        # Those of the command line come later, and the last counts.
        options.settings = [*settings, *options.settings]
    return options


def _named_file(words: Sequence[str]) -> Path | None:
    found = None
    for word, following in zip(words, [*words[1:], None], strict=True):
        if word == _FLAG and following is not None:
            found = following
        elif word.startswith(f"{_FLAG}="):
            found = word.partition("=")[2]
    return None if found is None else Path(found)


def _table(path: Path, step: str) -> Mapping[str, object]:
    """The table of a step. Raises ``UserError`` for a file that is none, has none, or has one of no step."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{_FLAG} {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not UTF-8 (byte {error.start}); save the file as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: no TOML: {error}") from error
    for name, table in content.items():
        if name not in STEPS:
            raise UserError(f"{path}: there is no step '{name}'{did_you_mean(name, STEPS)}")
        if not isinstance(table, dict):
            raise UserError(f"{path}: {name} must be a table, as in: [{name}]")
    if step not in content:
        raise UserError(f"{path} has no table [{step}]; it has {', '.join(f'[{name}]' for name in content) or 'none at all'}")
    found: Mapping[str, object] = content[step]
    return found


def _argument(action: argparse.Action, value: object, where: str) -> object:
    """The value of a flag or a positional argument, checked as the command line's are."""
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise UserError(f"{where} = {_shown(value)}, but it must be true or false")
        return value
    if isinstance(action, argparse._AppendAction):
        return [_one(action, each, where) for each in (value if isinstance(value, list) else [value])]
    return _one(action, value, where)


def _one(action: argparse.Action, value: object, where: str) -> object:
    if isinstance(value, bool | list | dict):
        raise UserError(f"{where} = {_shown(value)}, but it must be one text or number")
    convert = action.type
    try:
        found = convert(str(value)) if callable(convert) else str(value)
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise UserError(f"{where}: {error}") from error
    if action.choices is not None and found not in action.choices:
        raise UserError(f"{where} = {_shown(value)}{did_you_mean(str(found), list(map(str, action.choices)))}")
    return found


def _setting(name: str, value: object, known: Mapping[str, FieldFacts], step: str, where: str) -> str:
    """The setting in the words of ``--set``, once it has been found good."""
    if isinstance(value, dict):
        raise UserError(f"{where} is a table; settings stand beside the flags, as in: {name} = {known[name].default}")
    plain = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    text = f"{name}={plain.lower() if isinstance(value, bool) else plain}"
    try:
        parse_settings([text], known, step)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    return text


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
