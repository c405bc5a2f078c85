"""``thorndike watch RUN``: an mp4 of the policy at work, or a window."""

import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError
from thorndike.records import from_policy, read_policy_facts

EXAMPLES = """\
  thorndike watch latest                       a window; without a display, an mp4 in the run's videos/
  thorndike watch latest --video cartpole.mp4 --episodes 3"""


def run(words: Sequence[str]) -> Answer:
    """Show the policy, and say where the film is."""
    parser = Parser("watch", "Film a trained policy, or show it in a window.", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("--video", metavar="FILE.mp4", type=Path, help="write a film there (default without a display: RUN/videos/)")
    parser.add_argument("--window", action="store_true", help="open a window even if no display was found")
    parser.add_argument("--episodes", type=positive_whole, default=1, help="episodes to show (default: 1)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number the episodes follow from (default: 0)")
    options = parser.parse(words)
    if options.video is not None and options.video.suffix != ".mp4":
        raise UserError(f"--video {options.video}: a film is written as .mp4")
    if options.video is not None and options.window:
        raise UserError("--video and --window: choose one of them")
    directory = find_run(options.run, options.output)
    # JAX is not imported yet: a policy that is damaged, or not there, is told of at once.
    from_policy(directory, read_policy_facts)
    path = options.video
    if path is None and not options.window and not has_display():
        path = next_video(directory)
    if path is not None:
        # Drawing into memory needs no screen: neither SDL (classic control, Box2D) nor MuJoCo may look for one.
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        os.environ.setdefault("MUJOCO_GL", "egl")
    from thorndike.api import load

    film = load(directory).watch(path, episodes=options.episodes, seed=options.seed)
    data = {"run": directory, "video": film, "episodes": options.episodes}
    return Answer(data, "shown" if film is None else f"film: {shlex.quote(str(film))}")


def has_display() -> bool:
    """Whether a window can be opened: always outside Linux, there if X11 or Wayland is named."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def next_video(run: Path) -> Path:
    """The next file of ``RUN/videos/`` that does not exist: no film is overwritten."""
    number = 1
    while (path := run / "videos" / f"episode-{number}.mp4").exists():
        number += 1
    return path
