"""``thorndike clips VERB ...``: learning from choices between clips of behaviour; finds the verb's file and runs it."""

from collections.abc import Sequence
from importlib.util import find_spec

from thorndike.cli.answer import Answer
from thorndike.cli.verbs import chosen_verb, run_verb
from thorndike.errors import UserError

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
    verb = chosen_verb("clips", "Learn from choices between clips of behaviour.", CLIP_VERBS, EXAMPLES, words)
    if find_spec("sqlalchemy") is None and not {"-h", "--help"} & set(words):
        raise UserError("choices are kept by SQLAlchemy, which is not installed: pip install 'thorndike[language]'")
    return run_verb("clips", verb, words)
