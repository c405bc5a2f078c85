"""Atari games as learners see them: which protocol, and what an ``ALE/...`` id means on every engine.

An id such as ``ALE/Pong-v5`` is the preprocessed game on each engine (``ale``, ``envpool``, ``gymnasium``, ``subprocess``) and in
evaluation: every action repeated for 4 frames, the maximum of the last two, grey, 84 x 84, the last 4 of these stacked on the last axis.
Two protocols differ in what makes a game random, and in what a lost life is:

* ``machado`` (the default): sticky actions, each frame repeats the last action with probability 0.25; nothing else. Machado et al. 2018,
  "Revisiting the Arcade Learning Environment" (arXiv:1709.06009), section 5.
* ``classic``: 1 to 30 frames of doing nothing at the start, no stickiness, and a lost life is told as the step's ``cost``, which the
  wrapper ``end_at_cost`` makes the end of the learner's episode. Mnih et al. 2015; Hessel et al. 2018.

Settings of Gymnasium's own (``obs_type``, ``mode``, ``difficulty``...) ask for the raw game instead. Kept free of JAX.
"""

from collections.abc import Mapping
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

PREFIX = "ALE/"
MAX_FRAMES = 108_000
"""Frames of the longest episode: half an hour of play."""


class AtariSettings(NamedTuple):
    """What an ``ALE/...`` id can be asked for, by the names of Gymnasium and ale-py."""

    repeat_action_probability: float
    noop_max: int
    """Doing nothing for 1 to this many frames at the start; 0: not at all."""
    terminal_on_life_loss: bool
    """Whether a lost life is told, as the cost of its step."""
    full_action_space: bool = False
    """All 18 actions, not only those that do something in this game."""
    use_fire_reset: bool = False
    """Press FIRE at the start."""
    frameskip: int = 4
    stack_num: int = 4
    screen_size: int = 84


PROTOCOLS = {"machado": AtariSettings(0.25, 0, False), "classic": AtariSettings(0.0, 30, True)}
KINDS: dict[str, tuple[type, ...]] = {
    "repeat_action_probability": (float, int),
    "noop_max": (int,),
    "terminal_on_life_loss": (bool,),
    "full_action_space": (bool,),
    "use_fire_reset": (bool,),
    "frameskip": (int,),
    "stack_num": (int,),
    "screen_size": (int,),
}
_LEAST = {"noop_max": 0, "frameskip": 2, "stack_num": 1, "screen_size": 36}


def is_preprocessed(id: str, env_kwargs: Mapping[str, object]) -> bool:
    """Whether an id with these settings means the preprocessed game, not Gymnasium's raw one."""
    return id.startswith(PREFIX) and not (env_kwargs.keys() - KINDS.keys() - {"protocol"})


def atari_settings(env_kwargs: Mapping[str, object]) -> AtariSettings:
    """The protocol that is named (or ``machado``) with the settings given in its place. Raises UserError."""
    given = dict(env_kwargs)
    protocol = str(given.pop("protocol", "machado"))
    if protocol not in PROTOCOLS:
        raise UserError(f"no Atari protocol {protocol!r}{did_you_mean(protocol, PROTOCOLS)}; there are {', '.join(PROTOCOLS)}")
    for name, value in given.items():
        kinds = KINDS[name]
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise UserError(f"Atari's {name} must be of the kind {kinds[0].__name__}, not {value!r}")
    settings = AtariSettings._make(given.get(name, value) for name, value in PROTOCOLS[protocol]._asdict().items())
    for name, least in _LEAST.items():
        if getattr(settings, name) < least:
            raise UserError(f"Atari's {name} must be at least {least}, not {getattr(settings, name)}")
    if not 0 <= settings.repeat_action_probability <= 1:
        raise UserError(f"Atari's repeat_action_probability lies between 0 and 1, not {settings.repeat_action_probability}")
    return settings


def episode_limit(settings: AtariSettings, max_episode_steps: int | None) -> int:
    """Steps of the longest episode."""
    return MAX_FRAMES // settings.frameskip if max_episode_steps is None else max_episode_steps


def described(id: str, env_kwargs: Mapping[str, object]) -> str | None:
    """The protocol in words; None for anything but a preprocessed Atari game."""
    if not is_preprocessed(id, env_kwargs):
        return None
    settings = atari_settings(env_kwargs)
    parts = [
        f"sticky actions {settings.repeat_action_probability:g}" if settings.repeat_action_probability else "no sticky actions",
        f"1 to {settings.noop_max} no-ops at the start" if settings.noop_max else "no no-ops",
        "all 18 actions" if settings.full_action_space else "minimal action set",
        *(["FIRE at the start"] if settings.use_fire_reset else []),
        f"frame skip {settings.frameskip}, {settings.stack_num} grey frames of {settings.screen_size} x {settings.screen_size}",
        "whole games, unclipped",
    ]
    return f"{env_kwargs.get('protocol', 'machado')}: {', '.join(parts)}"


def rom_name(id: str) -> str:
    """ale-py's name of a game: ``ALE/MsPacman-v5`` is ``ms_pacman``. Imports Gymnasium, where ale-py has registered its ids."""
    import gymnasium

    return str(gymnasium.spec(id).kwargs["game"])


def pool_id(id: str) -> str:
    """EnvPool's name of the same game."""
    return id.removeprefix(PREFIX)


def pool_settings(settings: AtariSettings) -> dict[str, object]:
    """The same settings in EnvPool's words. It always does nothing for one frame at the start, and more than that up to ``noop_max``."""
    return {
        "repeat_action_probability": float(settings.repeat_action_probability),
        "noop_max": max(settings.noop_max, 1),
        "full_action_space": settings.full_action_space,
        "use_fire_reset": settings.use_fire_reset,
        "frame_skip": settings.frameskip,
        "stack_num": settings.stack_num,
        "img_height": settings.screen_size,
        "img_width": settings.screen_size,
        "episodic_life": False,
        "reward_clip": False,
    }
