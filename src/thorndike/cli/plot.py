"""``thorndike plot RUN...``: learning curves over each other."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.plotting.learning_curve import METRIC, plot_learning_curves, read_curve
from thorndike.plotting.style import FORMATS

EXAMPLES = """\
  thorndike plot latest
  thorndike plot CartPole-v1/ppo CartPole-v1/dqn --file curves.svg
  thorndike plot latest --metric train/approx_kl"""


def run(words: Sequence[str]) -> Answer:
    """Draw, and say where the picture is."""
    parser = Parser("plot", "Draw the learning curves of one or several runs, with their 95 % interval over seeds.", EXAMPLES)
    add_run_arguments(parser, several=True)
    parser.add_argument("--file", metavar="FILE", type=Path, help=f"the picture, {' '.join(FORMATS)} (default: RUN/learning_curve.png)")
    parser.add_argument("--metric", default=METRIC, help=f"what is drawn (default: {METRIC})")
    parser.add_argument("--title", help="the heading (default: the environment's id)")
    options = parser.parse(words)
    if options.file is not None and options.file.suffix.lower() not in FORMATS:
        raise UserError(f"--file {options.file}: a plot is written as {', '.join(FORMATS)}")
    directories = list(dict.fromkeys(find_run(text, options.output) for text in options.runs))
    curves = [read_curve(directory, options.metric) for directory in directories]
    default = directories[0] / "learning_curve.png" if len(directories) == 1 else Path("learning_curves.png")
    path = plot_learning_curves(curves, options.file or default, metric=options.metric, title=options.title)
    return Answer({"runs": directories, "plot": path}, f"plot: {shlex.quote(str(path))}")
