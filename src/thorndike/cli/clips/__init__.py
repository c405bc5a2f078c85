"""``thorndike clips VERB ...``: learning from choices between clips of behaviour; finds the verb's file and runs it."""

import importlib
from collections.abc import Sequence
from importlib.util import find_spec

from thorndike.cli.answer import Answer
from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

CLIP_VERBS = {
    "collect": "record clips of an agent, or of random actions, and ask for choices between pairs of them",
    "judge": "let a program choose, by the environment's own reward, to try everything out",
    "fit": "learn a reward from the choices so far",
    "train": "all of it in rounds: record, wait for choices, learn the reward, train on it",
}
"""Verb -> its line in the help; each is a file beside this one."""

EXAMPLES = """\
  thorndike clips train ppo Pendulum-v1 --to runs/swing            films, then waits for you to judge
  thorndike language label --db runs/swing/choices.db              the page on which you do
  thorndike clips train ppo Pendulum-v1 --to runs/swing            goes on
  thorndike clips train ppo Pendulum-v1 --to runs/try --simulate   a program judges
By hand:
  thorndike clips collect Pendulum-v1 --to runs/swing --pairs 60
  thorndike clips fit runs/swing
  thorndike train ppo Pendulum-v1 --reward runs/swing
`thorndike clips VERB --help` tells more."""


def run(words: Sequence[str]) -> Answer:
    """Run a verb of clips."""
    listed = "; ".join(f"{verb}: {summary}" for verb, summary in CLIP_VERBS.items())
    verb = next((word for word in words if not word.startswith("-")), None)
    if verb is None:
        parser = Parser("clips", f"Learn from choices between clips of behaviour. {listed}.", EXAMPLES)
        parser.add_argument("verb", metavar="VERB", help=f"one of {', '.join(CLIP_VERBS)}")
        parser.parse(words)
    if verb not in CLIP_VERBS:
        raise UserError(f"there is no verb 'clips {verb}'{did_you_mean(str(verb), CLIP_VERBS)}; see: thorndike clips --help")
    if find_spec("sqlalchemy") is None and not {"-h", "--help"} & set(words):
        raise UserError("choices are kept by SQLAlchemy, which is not installed: pip install 'thorndike[language]'")
    rest = list(words)
    rest.remove(str(verb))
    answer: Answer = importlib.import_module(f"thorndike.cli.clips.{verb}").run(rest)
    return answer
