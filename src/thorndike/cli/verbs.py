"""Commands that have verbs of their own, each a file of a folder: ``thorndike language VERB``, ``thorndike clips VERB``."""

import importlib
from collections.abc import Mapping, Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean


def chosen_verb(command: str, about: str, verbs: Mapping[str, str], examples: str, words: Sequence[str]) -> str:
    """The verb among ``words``; without one the command's help. Raises ``UserError`` for one that is not there."""
    verb = next((word for word in words if not word.startswith("-")), None)
    if verb is None:
        listed = "; ".join(f"{name}: {summary}" for name, summary in verbs.items())
        parser = Parser(command, f"{about} {listed}.", examples)
        parser.add_argument("verb", metavar="VERB", help=f"one of {', '.join(verbs)}")
        parser.parse(words)
    if verb not in verbs:
        raise UserError(f"there is no verb '{command} {verb}'{did_you_mean(str(verb), verbs)}; see: thorndike {command} --help")
    return str(verb)


def run_verb(command: str, verb: str, words: Sequence[str]) -> Answer:
    """Run a verb with the other words."""
    rest = list(words)
    rest.remove(verb)
    answer: Answer = importlib.import_module(f"thorndike.cli.{command}.{verb}").run(rest)
    return answer
