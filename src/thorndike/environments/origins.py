"""What a user names, as one Gymnasium environment: an id, ``module:Id``, ``path/to/file.py:ClassName``, an object or a function.

Kept free of JAX: a wrong name is rejected before it is imported, and worker processes start fast.
"""

import copy
import importlib
import importlib.metadata
import importlib.util
import warnings
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import TypeAlias

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from thorndike.environments.host.atari import atari_settings, is_preprocessed
from thorndike.errors import UserError
from thorndike.user_code import attribute_in_file, import_module, load_file, one_line

Settings: TypeAlias = Mapping[str, object]
"""Keyword settings of an environment."""

_IN_A_FILE = "path/to/file.py:ClassName"

gymnasium.register("DeepSea-v0", "thorndike.environments.deep_sea:DeepSeaEnv")


def is_known_id(name: str) -> bool:
    """Whether Gymnasium has this id, after importing the module of ``module:Id`` or the package of ``ALE/...`` or ``MinAtar/...``."""
    module, _, id = name.rpartition(":")
    if module:
        import_module(module, name, _IN_A_FILE)
    elif id.startswith("ALE/") and importlib.util.find_spec("ale_py") is not None:
        package = importlib.import_module("ale_py")
        gymnasium.register_envs(package)
        # It greets on stderr otherwise, once for each game.
        package.ALEInterface.setLoggerMode(package.LoggerMode.Error)
    elif id.startswith("MinAtar/") and id not in gymnasium.registry and importlib.util.find_spec("minatar") is not None:
        # Not by itself when Gymnasium starts: it brings Matplotlib, Seaborn and pandas.
        importlib.import_module("minatar.gym").register_envs()
    elif id.startswith(_ROBOTICS) and id not in gymnasium.registry and importlib.util.find_spec("gymnasium_robotics") is not None:
        gymnasium.register_envs(importlib.import_module("gymnasium_robotics"))
    return id in gymnasium.registry


_ROBOTICS = ("Fetch", "HandReach", "HandManipulate", "AdroitHand", "PointMaze", "AntMaze", "FrankaKitchen")
"""How the ids of Gymnasium-robotics begin."""


def missing_package(id: str) -> str | None:
    """What to install for an id whose package is not there, in one line; None if nothing is missing."""
    if id.startswith("ALE/") and importlib.util.find_spec("ale_py") is None:
        return f"{id} needs the Atari package: pip install 'thorndike[atari]'"
    if id.startswith("MinAtar/") and importlib.util.find_spec("minatar") is None:
        return f"{id} trains without it, but is evaluated and filmed on the package minatar: pip install 'thorndike[minatar]'"
    if id.startswith(_ROBOTICS) and id not in gymnasium.registry and importlib.util.find_spec("gymnasium_robotics") is None:
        return f"{id} needs the robotics package: pip install 'thorndike[robotics]'"
    return _missing_family(id)


def starts_here(id: str) -> bool:
    """Whether the reference environment of an id that EnvPool has can be made: Gymnasium-robotics' cannot everywhere."""
    return not id.startswith(_ROBOTICS) or (is_known_id(id) and missing_package(id) is None)


def _missing_family(id: str) -> str | None:
    """The same for the families that Gymnasium registers whether their package is there or not."""
    spec = gymnasium.registry.get(id)
    where = str(spec.entry_point) if spec is not None else ""
    robot = where.startswith(("gymnasium_robotics.envs.fetch", "gymnasium_robotics.envs.shadow_dexterous"))
    if robot and not _joints_are_numbers():
        version = importlib.metadata.version("mujoco")
        return f"{id} does not start on mujoco {version}, whose joints gymnasium-robotics cannot read: pip install mujoco==3.5.0"
    for family, package in (("mujoco", "mujoco"), ("box2d", "Box2D")):
        if where.startswith(f"gymnasium.envs.{family}") and importlib.util.find_spec(package) is None:
            return f"{id} needs the package {package}: pip install 'thorndike[{family}]'"
    return None


def _joints_are_numbers() -> bool:
    """Whether mujoco's kinds of joints equal the numbers that a model has for them, as Gymnasium-robotics 1.4.2 takes for granted."""
    # In this order: NumPy's own comparison finds them equal where mujoco's, which Gymnasium-robotics comes upon, does not.
    return bool(importlib.import_module("mujoco").mjtJoint.mjJNT_SLIDE == np.int32(2))


def make_single(
    origin: object, env_kwargs: Settings, max_episode_steps: int | None = None, render_mode: str | None = None
) -> gymnasium.Env:
    """One fresh Gymnasium environment; `max_episode_steps` overrides the limit it is registered with.

    An object is copied, so that the one a user holds is never stepped. Raises UserError in one line if it cannot be made.
    """
    if isinstance(origin, str):
        return _from_name(origin, env_kwargs, max_episode_steps, render_mode)
    if isinstance(origin, gymnasium.Env):
        return _limited(_copy(origin, env_kwargs, render_mode), max_episode_steps)
    if not callable(origin):
        raise UserError(
            f"an environment must be an id, a gymnasium.Env, a function that makes one, a VectorEnv or a native one, not {origin!r}"
        )
    return _limited(_called(origin, env_kwargs, render_mode, name_of(origin)), max_episode_steps)


def name_of(origin: object) -> str:
    """What a run is called by: the id where there is one, else the class."""
    if isinstance(origin, str):
        return origin
    if isinstance(origin, type):
        # Of a class, ``spec`` may be the property that its instances have.
        return origin.__name__
    spec = getattr(origin, "spec", None)
    if spec is not None:
        return spec.id
    if isinstance(origin, gymnasium.Env | VectorEnv):
        return type(origin.unwrapped).__name__
    name = getattr(origin, "__name__", type(origin).__name__)
    return name.strip("<>")


def is_plain(environment: gymnasium.Env) -> bool:
    """Whether nothing but Gymnasium's own checks and time limit is wrapped around it, so that its table says all."""
    while isinstance(environment, gymnasium.Wrapper):
        if type(environment) not in (OrderEnforcing, PassiveEnvChecker, TimeLimit):
            return False
        environment = environment.env
    return True


def limit_of(environment: gymnasium.Env) -> int | None:
    """The time limit in force: the least of the wrapped ones and the registered one."""
    limits = [getattr(environment.unwrapped, "native_limit", None)]
    limits += [] if environment.spec is None else [environment.spec.max_episode_steps]
    while isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, TimeLimit):
            limits.append(environment._max_episode_steps)
        environment = environment.env
    return min((limit for limit in limits if limit is not None), default=None)


def frames_of(environment: gymnasium.Env) -> int:
    """How many successive frames an observation holds on its last axis, where the environment says so by ``frames_stacked``."""
    return int(getattr(environment.unwrapped, "frames_stacked", 1))


def _from_name(name: str, env_kwargs: Settings, max_episode_steps: int | None, render_mode: str | None) -> gymnasium.Env:
    in_file = attribute_in_file(name)
    if in_file is not None:
        return _limited(
            _called(_attribute(load_file(in_file[0], "the environment's class"), in_file[1], name), env_kwargs, render_mode, name),
            max_episode_steps,
        )
    module, _, id = name.rpartition(":")
    if not is_known_id(name) and module:
        return _limited(
            _called(_attribute(import_module(module, name, _IN_A_FILE), id, name), env_kwargs, render_mode, name), max_episode_steps
        )
    missing = missing_package(id)
    if missing is not None:
        raise UserError(missing)
    if is_preprocessed(id, env_kwargs) and id in gymnasium.registry:
        from thorndike.environments.host.atari_game import atari_game

        return atari_game(id, atari_settings(env_kwargs), max_episode_steps, render_mode)
    settings = dict(env_kwargs)
    if render_mode is not None:
        settings["render_mode"] = render_mode
    try:
        with warnings.catch_warnings():
            # MinAtar's versions are sets of actions; none of them is out of date.
            warnings.filterwarnings("ignore", message=".*MinAtar/.* is out of date", category=DeprecationWarning)
            # Without the checker that looks at every step: it is for writing environments, not for training in them.
            made = gymnasium.make(id, max_episode_steps=max_episode_steps, disable_env_checker=True, **settings)
    except Exception as error:
        # Whatever an environment's constructor raises is about what was asked of it.
        raise UserError(f"Gymnasium cannot make {name}: {type(error).__name__}: {one_line(error)}") from error
    if id.startswith("MinAtar/") and render_mode == "rgb_array":
        from thorndike.environments.magnified import Magnified

        return Magnified(made)
    return made


def _called(make: Callable[..., gymnasium.Env], env_kwargs: Settings, render_mode: str | None, name: str) -> gymnasium.Env:
    settings = dict(env_kwargs)
    if render_mode is not None:
        settings["render_mode"] = render_mode
    try:
        environment = make(**settings)
    except Exception as error:
        hint = "; give it a render_mode argument, as Gymnasium's environments have, to watch it" if render_mode is not None else ""
        raise UserError(
            f"{name} cannot be made with {settings or 'no settings'}: {type(error).__name__}: {one_line(error)}{hint}"
        ) from error
    if not isinstance(environment, gymnasium.Env):
        raise UserError(f"{name} must give a gymnasium.Env, not {type(environment).__name__}")
    return environment


def _copy(environment: gymnasium.Env, env_kwargs: Settings, render_mode: str | None) -> gymnasium.Env:
    if env_kwargs:
        raise UserError(f"settings {sorted(env_kwargs)} cannot be given to an environment that is made already: give its id or its class")
    try:
        copied = copy.deepcopy(environment)
    except (TypeError, ValueError, NotImplementedError, RuntimeError) as error:
        raise UserError(
            f"{name_of(environment)} cannot be copied ({one_line(error)}): give a function that makes one, such as lambda: MyEnv(...)"
        ) from error
    if render_mode is not None:
        copied.unwrapped.render_mode = render_mode
    return copied


def _limited(environment: gymnasium.Env, max_episode_steps: int | None) -> gymnasium.Env:
    """The limit as the outermost wrapper. Like Gymnasium's ``make``, it replaces the outermost limit already there."""
    if max_episode_steps is None:
        return environment
    if isinstance(environment, TimeLimit):
        environment = environment.env
    return TimeLimit(environment, max_episode_steps)


def _attribute(module: ModuleType, attribute: str, name: str) -> Callable[..., gymnasium.Env]:
    found = getattr(module, attribute, None)
    if not callable(found):
        from thorndike.suggestions import did_you_mean

        classes = [key for key, value in vars(module).items() if isinstance(value, type) and issubclass(value, gymnasium.Env)]
        raise UserError(f"{name}: no environment {attribute!r} there{did_you_mean(attribute, classes)}")
    return found
