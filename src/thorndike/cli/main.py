"""``thorndike VERB ...``: finds the verb, runs it, prints its answer. A user's mistake is one line and exit status 2."""

import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import NamedTuple

from thorndike.cli.answer import Answer, as_json_text, one_line, show, stdout_for_the_answer_only
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean
from thorndike.training.stopping import Terminated, leave, prompt_exit


class Verb(NamedTuple):
    """A verb's file, with ``run(words) -> Answer`` in it, and its line in ``--help``."""

    module: str
    arguments: str
    summary: str


VERBS: dict[str, Verb] = {
    "train": Verb("thorndike.cli.train", "ALGORITHM ENVIRONMENT", "train an agent, or several seeds of it at once"),
    "resume": Verb("thorndike.cli.resume", "RUN", "go on with a run that stopped, bit for bit, or for more steps"),
    "reproduce": Verb("thorndike.cli.reproduce", "RUN", "make a run again and compare it, bit for bit"),
    "eval": Verb("thorndike.cli.evaluate", "RUN", "score a trained policy on fresh reference environments"),
    "record": Verb("thorndike.cli.record", "RUN", "write down what a trained policy does, as a dataset"),
    "ope": Verb("thorndike.cli.ope", "RUN --data DATASET", "say what a policy is worth from episodes that others made"),
    "watch": Verb("thorndike.cli.watch", "RUN", "film a trained policy as mp4, or show it in a window"),
    "plot": Verb("thorndike.cli.plot", "RUN...", "draw learning curves with their 95 % interval"),
    "sweep": Verb("thorndike.cli.sweep", "ALGORITHM ENVIRONMENT", "search settings, say which matter, rerun the best on fresh seeds"),
    "compare": Verb("thorndike.cli.compare", "RUN RUN...", "say which run is better, worse, or that nobody can tell yet"),
    "studio": Verb("thorndike.cli.studio", "", "play games in the browser, on this machine"),
    "arena": Verb("thorndike.cli.arena", "GAME PLAYER PLAYER...", "let agents and programs play each other, and rate them"),
    "play": Verb("thorndike.cli.play", "GAME", "play a game against an agent or a program, here in the terminal"),
    "clips": Verb("thorndike.cli.clips", "VERB ...", "a reward learnt from choices between clips of behaviour, and agents trained on it"),
    "language": Verb("thorndike.cli.language", "VERB ...", "language models: generate, chat, pretrain, fine-tune, preferences of people"),
    "check-env": Verb("thorndike.cli.check_env", "ENVIRONMENT", "say what is wrong with an environment, with fixes"),
    "list": Verb("thorndike.cli.list", "[WHAT]", "list runs, algorithms, environments, presets or settings"),
    "show": Verb("thorndike.cli.show", "RUN", "show a run's settings, state and last results"),
    "info": Verb("thorndike.cli.info", "", "show versions, devices and optional packages"),
    "bench": Verb("thorndike.cli.bench", "ALGORITHM ENVIRONMENT", "measure steps per second here, learning included"),
}

HELP = """\
usage: thorndike VERB [ARGUMENTS] [--json]

Learning from reward, from a two-armed bandit up. Every learner and its environment are one compiled program.

verbs:
{verbs}

examples:
  thorndike train ppo CartPole-v1 --seeds 8        train eight agents at once
  thorndike train q_learning FrozenLake-v1         learn a table
  thorndike train ppo my_module:MyEnv-v0           your own Gymnasium environment
  thorndike check-env my_module:MyEnv-v0           what is wrong with it
  thorndike eval latest --episodes 100             score the newest run
  thorndike watch latest                           see it act
  thorndike plot latest                            draw its learning curve
  thorndike compare ppo-run dqn-run                which is better, and how sure is that
  thorndike language chat MODEL                    talk with a language model
  thorndike studio                                 play against what was trained, in the browser
  thorndike sweep ppo CartPole-v1 --over learning_rate=1e-4,3e-4,1e-3
                                                   which settings are best, and which matter

A RUN is a run's directory, a part of its name that only it has, or `latest`.
`thorndike VERB --help` tells more. `thorndike --version` prints the version."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status: 0 done, 2 a user's mistake, 130 interrupted, 143 terminated."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with prompt_exit():
        status = _answer(words)
        if arguments is None and status > 128:
            # Not through the interpreter's own end: what was interrupted may hang there, or crash.
            leave(status)
    return status


def _answer(words: list[str]) -> int:
    try:
        return _run(words)
    except UserError as error:
        return _report(str(error), "--json" in words)
    except (KeyboardInterrupt, Terminated) as stopped:
        print(f"thorndike: {'terminated' if isinstance(stopped, Terminated) else 'interrupted'}", file=sys.stderr)
        return 128 + (signal.SIGTERM if isinstance(stopped, Terminated) else signal.SIGINT)
    except BrokenPipeError:
        # The reader (`| head`) has gone: keep Python from failing once more when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0


def _run(words: list[str]) -> int:
    first = next((word for word in words if not word.startswith("-")), None)
    if first is None:
        return _without_verb(words)
    if first not in VERBS:
        raise UserError(f"there is no verb '{first}'{did_you_mean(first, VERBS)}")
    # Python adds the current folder only for `python -m`; a user's `my_module:MyEnv-v0` lies there. Last, so that it hides nothing.
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    verb = importlib.import_module(VERBS[first].module)
    words.remove(first)
    as_json = "--json" in words
    if as_json:
        with stdout_for_the_answer_only():
            answer: Answer = verb.run(words)
    else:
        answer = verb.run(words)
    show(answer, as_json)
    return answer.exit_status


def _without_verb(words: list[str]) -> int:
    if "--version" in words or "-V" in words:
        from importlib.metadata import version

        print(f"thorndike {version('thorndike')}")
        return 0
    unknown = [word for word in words if word not in ("-h", "--help", "--json")]
    if unknown:
        raise UserError(f"unknown flag {unknown[0]}; the verb comes first: thorndike VERB {unknown[0]}")
    width = max(len(f"{name} {verb.arguments}") for name, verb in VERBS.items())
    print(HELP.format(verbs="\n".join(f"  {f'{name} {verb.arguments}':{width}}  {verb.summary}" for name, verb in VERBS.items())))
    return 0


def _report(message: str, as_json: bool) -> int:
    line = one_line(message)
    if as_json:
        print(as_json_text({"error": line}))
    print(f"thorndike: {line}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
