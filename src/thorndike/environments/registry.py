"""One environment id, the fastest engine: which engine runs what a user names, and how each is built.

The order, with ``engine="auto"``:

0. ``native``: a game (``games/registry.py``), which plays itself; it is evaluated against an opponent.
1. ``native``: an id of ``native.NATIVE`` whose factory takes the settings given, or any Gymnasium environment with a transition table
   (``unwrapped.P``) around which nothing but Gymnasium's own checks and time limit is wrapped.
2. ``envpool``: an id that means the same task in EnvPool and Gymnasium (``host/envpool_ids.py`` says how that was found), or that only
   EnvPool has, where EnvPool is installed. Ids that both have but that were not found equal stay with Gymnasium.
3. ``ale``: an Atari game (``ALE/...``), preprocessed as ``host/atari.py`` says; the same on ``envpool``, ``gymnasium`` and ``subprocess``.
4. ``gymnasium``: everything else. ``subprocess`` is chosen by hand, for environments slow enough to pay for the processes.

Nothing heavy is imported at the top: a wrong id is rejected before JAX is.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from thorndike.environments.host.atari import PREFIX, atari_settings, episode_limit, is_preprocessed, pool_id, pool_settings
from thorndike.environments.host.envpool_ids import SAME_AS_GYMNASIUM, pool_ids, pool_is_installed
from thorndike.environments.native import NATIVE, factory, is_only_native, settings_of
from thorndike.errors import UserError
from thorndike.games.registry import game, game_ids, is_game
from thorndike.games.settings import game_settings
from thorndike.suggestions import did_you_mean, nearest

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from thorndike.environments.host.ale_engine import AleEngine
    from thorndike.environments.host.envpool_engine import EnvPoolEngine
    from thorndike.environments.host.gymnasium_engine import LoopEngine
    from thorndike.environments.host.subprocess_engine import SubprocessEngine
    from thorndike.environments.host.vector_engine import VectorEngine
    from thorndike.environments.native.vectorize import Dynamics
    from thorndike.games.game import Game
    from thorndike.types import Environment

    HostEngine: TypeAlias = LoopEngine | SubprocessEngine | VectorEngine | EnvPoolEngine | AleEngine
    Named: TypeAlias = str | gymnasium.Env | Callable[..., gymnasium.Env] | VectorEnv | Environment | Dynamics | Game

ENGINES = ("auto", "native", "gymnasium", "subprocess", "envpool", "ale")
NO_SETTINGS: Mapping[str, object] = MappingProxyType({})


class Choice(NamedTuple):
    """What was named, and the engine that runs it."""

    id: str
    """What the run is called by and, where a string was given, rebuilt from."""
    engine: str
    """``native``, ``gymnasium``, ``subprocess``, ``envpool`` or ``ale``."""
    origin: "Named"
    env_kwargs: Mapping[str, object]
    max_episode_steps: int | None
    """The override; None keeps the limit that is registered."""


def resolve(
    environment: "Named",
    *,
    engine: str = "auto",
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
) -> Choice:
    """Choose the engine of an id, ``module:Id``, ``path/to/file.py:ClassName``, class, function or object.

    Raises UserError in one line for an unknown id (with the nearest known one), an engine that cannot run it, or a limit below 1.
    """
    if engine not in ENGINES:
        raise UserError(f"unknown engine {engine!r}{did_you_mean(engine, ENGINES)}")
    if max_episode_steps is not None and max_episode_steps < 1:
        raise UserError(f"max_episode_steps must be at least 1, not {max_episode_steps}: leave it out to keep the environment's own")
    settings = dict(env_kwargs or {})
    if isinstance(environment, str):
        chosen = _engine_of_name(environment, engine, settings, max_episode_steps)
        return Choice(environment, chosen, environment, settings, max_episode_steps)
    return _resolve_object(environment, engine, settings, max_episode_steps)


def build_native(choice: Choice, num_envs: int) -> "Environment":
    """The compiled batch. Raises UserError if the engine is another, or an Environment was given with another number of environments."""
    from thorndike.environments.native.vectorize import Dynamics, vectorize
    from thorndike.games.environment import game_environment
    from thorndike.types import Environment

    if choice.engine != "native":
        raise UserError(f"{choice.id} runs on the {choice.engine} engine, which is not compiled: build it with build_host")
    rules = game_of(choice)
    if rules is not None:
        environment = game_environment(rules, num_envs, game_settings(choice.id, choice.env_kwargs))
        return environment._replace(spec=environment.spec._replace(id=choice.id))
    if not isinstance(choice.origin, Environment):
        dynamics = choice.origin if isinstance(choice.origin, Dynamics) else _dynamics(choice)
        return vectorize(dynamics, num_envs, choice.max_episode_steps)
    if choice.origin.spec.num_envs != num_envs:
        raise UserError(f"{choice.id} was built with {choice.origin.spec.num_envs} environments, not {num_envs}: build it with {num_envs}")
    if choice.max_episode_steps not in (None, choice.origin.spec.max_episode_steps):
        raise UserError(f"{choice.id} is built already: give max_episode_steps where it is built")
    return choice.origin


def game_of(choice: Choice) -> "Game | None":
    """The rules, where what was named is a game."""
    from thorndike.games.game import Game

    if isinstance(choice.origin, Game):
        return choice.origin
    return game(choice.origin) if choice.engine == "native" and isinstance(choice.origin, str) and is_game(choice.origin) else None


def build_host(choice: Choice, num_envs: int, masks: bool = False, env_timeout: float | None = None) -> "HostEngine":
    """The host engine; with ``masks``, action masks that the environment gives elsewhere are moved into its observations.

    `env_timeout` is how many seconds a step in another process may take (60 by default); a reset may take twice that. Raises UserError if
    the engine is ``native``, or a VectorEnv was given with another number of environments.
    """
    from thorndike.environments.host.faults import timeouts
    from thorndike.environments.host.gymnasium_engine import LoopEngine
    from thorndike.environments.host.subprocess_engine import SubprocessEngine
    from thorndike.environments.host.vector_engine import VectorEngine
    from thorndike.environments.origins import VectorEnv, frames_of, limit_of, make_single

    if choice.engine == "native":
        raise UserError(f"{choice.id} runs on the native engine, which is compiled: build it with build_native")
    if choice.engine == "envpool":
        return _build_pool(choice, num_envs)
    if choice.engine == "ale":
        from thorndike.environments.host.ale_engine import AleEngine

        return AleEngine(choice.id, num_envs, atari_settings(choice.env_kwargs), choice.max_episode_steps)
    if isinstance(choice.origin, VectorEnv):
        if choice.origin.num_envs != num_envs:
            raise UserError(f"{choice.id} is a vector of {choice.origin.num_envs} environments, not {num_envs}: set num_envs to that")
        return VectorEngine(choice.origin, choice.id, timeouts=timeouts(env_timeout))
    make: Callable[..., gymnasium.Env] = partial(make_single, choice.origin, choice.env_kwargs, choice.max_episode_steps)
    probe = make()
    limit, frames = limit_of(probe), frames_of(probe)
    probe.close()
    if masks:
        from thorndike.environments.host.action_masks import mask_in_observation

        make = mask_in_observation(make)
    engine: HostEngine
    if choice.engine == "subprocess":
        engine = SubprocessEngine([make] * num_envs, choice.id, limit, timeouts(env_timeout))
    else:
        engine = LoopEngine([make] * num_envs, choice.id, limit)
    engine.spec = engine.spec._replace(frames=frames)
    return engine


def reference(choice: Choice, render_mode: str | None = None) -> "gymnasium.Env":
    """One fresh Gymnasium environment of what was named, for evaluation and video, whatever engine trains.

    Where Gymnasium has none (a probe, an id of EnvPool alone), that engine in Gymnasium's form; of a game, one against an opponent.
    """
    from thorndike.environments.origins import VectorEnv, make_single

    rules = game_of(choice)
    if rules is not None:
        return _against_opponent(choice, rules, render_mode)
    if isinstance(choice.origin, VectorEnv):
        makers = getattr(choice.origin.unwrapped, "env_fns", None)
        if not makers:
            raise UserError(f"{choice.id} is a vector that does not say how one environment is made: evaluate on its id or class instead")
        return makers[0]()
    if _only_native(choice):
        if render_mode is not None:
            raise UserError(f"{choice.id} has no picture: it exists as a compiled engine alone; watch an environment that Gymnasium draws")
        from thorndike.environments.native_env import NativeEnv

        return NativeEnv(build_native(choice, _own_size(choice)))
    if choice.engine == "envpool" and not _gymnasium_has(choice.id):
        from thorndike.environments.host.envpool_engine import PoolEnv

        return PoolEnv(choice.id, choice.env_kwargs, choice.max_episode_steps, render_mode)
    return make_single(choice.origin, choice.env_kwargs, choice.max_episode_steps, render_mode)


def _against_opponent(choice: Choice, rules: "Game", render_mode: str | None) -> "gymnasium.Env":
    from thorndike.games.against import AgainstOpponent

    if render_mode is not None:
        raise UserError(f"{choice.id} is a game, which is watched by playing: thorndike play {choice.id}")
    return AgainstOpponent(rules, game_settings(choice.id, choice.env_kwargs))


def environment_ids() -> dict[str, list[str]]:
    """Every id by the engine that ``auto`` would choose; tables count as ``gymnasium`` here, for they are known only once made."""
    from thorndike.environments.origins import gymnasium, starts_here

    pool = sorted(id for id in _automatic_pool_ids() if starts_here(id))
    taken = {*NATIVE, *pool}
    return {
        "native": sorted({*NATIVE, *game_ids()}),
        "envpool": pool,
        "gymnasium": sorted(id for id in gymnasium.registry if id not in taken and not id.startswith("GymV")),
    }


def _engine_of_name(name: str, engine: str, settings: dict[str, object], max_episode_steps: int | None) -> str:
    """The engine of an id; raises UserError if nobody has it or the engine asked for does not."""
    if is_game(name):
        if engine not in ("auto", "native"):
            raise UserError(f"{name} is a game, which is compiled: leave engine={engine!r} out")
        game_settings(name, settings, max_episode_steps)
        return "native"
    if engine in ("auto", "native") and name in NATIVE and _accepts(name, settings):
        return "native"
    if name.startswith(PREFIX):
        return _engine_of_atari(name, engine, settings)
    if engine == "ale":
        raise UserError(f"engine='ale' runs Atari games, whose ids begin with {PREFIX}, not {name}: use engine='auto'")
    if engine == "envpool":
        _check_pool(name)
        return "envpool"
    if engine == "auto" and not settings and name in SAME_AS_GYMNASIUM and pool_is_installed():
        return "envpool"
    if is_only_native(name):
        raise UserError(f"{name} exists as a native engine alone, and takes no settings {sorted(settings)}: use engine='native'")
    if _gymnasium_has(name):
        return _host_or_table(name, engine, settings)
    if engine == "auto" and name in pool_ids():
        _check_pool(name)
        return "envpool"
    raise UserError(_unknown(name, engine))


def _engine_of_atari(name: str, engine: str, settings: dict[str, object]) -> str:
    """``ale`` unless another is asked for; ``gymnasium`` for the raw game, which settings of Gymnasium's own ask for."""
    if not _gymnasium_has(name) or engine == "native":
        raise UserError(_unknown(name, engine))
    if not is_preprocessed(name, settings):
        if engine in ("ale", "envpool"):
            raise UserError(
                f"{name} with {sorted(settings)} is the raw game, which engine={engine!r} does not have: use engine='gymnasium'"
            )
        return "gymnasium" if engine == "auto" else engine
    atari_settings(settings)
    if engine == "envpool":
        _check_pool(pool_id(name))
    return "ale" if engine == "auto" else engine


def _resolve_object(environment: "Named", engine: str, settings: dict[str, object], max_episode_steps: int | None) -> Choice:
    from thorndike.environments.native.vectorize import Dynamics
    from thorndike.environments.origins import VectorEnv, name_of
    from thorndike.games.game import Game
    from thorndike.types import Environment

    if isinstance(environment, Game) and engine in ("auto", "native"):
        game_settings(environment.id, settings, max_episode_steps)
        return Choice(environment.id, "native", environment, settings, max_episode_steps)
    if isinstance(environment, Environment | Dynamics):
        if engine not in ("auto", "native") or settings:
            raise UserError("a native environment runs on engine='native' and has its settings already: leave both out")
        id = environment.spec.id if isinstance(environment, Environment) else environment.id
        return Choice(id, "native", environment, settings, max_episode_steps)
    if isinstance(environment, VectorEnv):
        if engine not in ("auto", "gymnasium") or settings or max_episode_steps is not None:
            raise UserError("a VectorEnv is built already: give engine, env_kwargs and max_episode_steps where it is built")
        return Choice(name_of(environment), "gymnasium", environment, settings, None)
    if engine in ("envpool", "ale"):
        raise UserError(f"engine={engine!r} needs an id of its own, not an object: use engine='gymnasium' or 'subprocess'")
    chosen = _host_or_table(environment, engine, settings)
    return Choice(name_of(environment), chosen, environment, settings, max_episode_steps)


def _host_or_table(origin: "Named", engine: str, settings: dict[str, object]) -> str:
    """``native`` for a Gymnasium environment whose table says all, unless another engine is asked for."""
    from thorndike.environments.origins import is_plain, make_single, name_of

    if engine in ("gymnasium", "subprocess"):
        return engine
    environment = make_single(origin, settings)
    # Asked before JAX is imported, which only a table needs.
    tabular = hasattr(environment.unwrapped, "P") and is_plain(environment)
    if tabular:
        from thorndike.environments.native.table import has_table

        tabular = has_table(environment)
    environment.close()
    if engine == "native" and not tabular:
        raise UserError(
            f"{name_of(origin)} has no native engine and no plain transition table (unwrapped.P): use engine='auto'; "
            f"native are {', '.join(id for id in NATIVE if not id.startswith('probe/'))}"
        )
    return "native" if tabular else "gymnasium"


def _dynamics(choice: Choice) -> "Dynamics":
    """The dynamics of a native id, or of the table of a Gymnasium environment."""
    from thorndike.environments.native.table import read_table, table_dynamics
    from thorndike.environments.origins import make_single

    if isinstance(choice.origin, str) and choice.origin in NATIVE:
        return factory(choice.origin)(**choice.env_kwargs)
    environment = make_single(choice.origin, choice.env_kwargs, choice.max_episode_steps)
    table = read_table(environment)
    environment.close()
    return table_dynamics(table)


def _build_pool(choice: Choice, num_envs: int) -> "EnvPoolEngine":
    from thorndike.environments.host.envpool_engine import EnvPoolEngine
    from thorndike.environments.origins import make_single

    if choice.id.startswith(PREFIX):
        settings = atari_settings(choice.env_kwargs)
        limit = episode_limit(settings, choice.max_episode_steps)
        return EnvPoolEngine(
            choice.id,
            num_envs,
            max_episode_steps=limit,
            env_kwargs=pool_settings(settings),
            pool_id=pool_id(choice.id),
            tells_lives=settings.terminal_on_life_loss,
        )
    facts = make_single(choice.id, NO_SETTINGS) if _gymnasium_has(choice.id) else None
    engine = EnvPoolEngine(choice.id, num_envs, reference=facts, max_episode_steps=choice.max_episode_steps, env_kwargs=choice.env_kwargs)
    if facts is not None:
        facts.close()
    return engine


def _accepts(id: str, settings: dict[str, object]) -> bool:
    """Whether the native factory takes these settings. Its file, and so JAX, is imported only if it may."""
    if not settings:
        return True
    if not settings.keys() <= settings_of(id):
        return False
    try:
        inspect.signature(factory(id)).bind(**settings)
    except TypeError:
        return False
    return True


def _gymnasium_has(name: str) -> bool:
    from thorndike.environments.origins import is_known_id
    from thorndike.user_code import attribute_in_file

    if attribute_in_file(name) is not None or is_known_id(name):
        return True
    # ``module:ClassName``: the module is there; whether the class is, making it says.
    return ":" in name


def _check_pool(name: str) -> None:
    if name not in pool_ids():
        raise UserError(f"EnvPool has no environment {name!r}{did_you_mean(name, pool_ids())}")
    if not pool_is_installed():
        raise UserError(f"{name} runs on EnvPool, which is not installed: pip install 'thorndike[pool]'")


def _automatic_pool_ids() -> frozenset[str]:
    from thorndike.environments.origins import gymnasium

    if not pool_is_installed():
        return frozenset()
    return SAME_AS_GYMNASIUM | {id for id in pool_ids() if id not in gymnasium.registry and id not in NATIVE}


def _unknown(name: str, engine: str) -> str:
    from thorndike.environments.origins import gymnasium, missing_package

    close = nearest(name, {*NATIVE, *game_ids(), *pool_ids(), *gymnasium.registry})
    missing = missing_package(name)
    if missing is not None and (close == name or name.startswith("ALE/")):
        return missing
    if close == name:
        return f"{name} does not run on engine={engine!r}: use engine='auto'"
    hint = f"did you mean {close!r}?" if close else "give a Gymnasium id, module:Id or path/to/file.py:ClassName"
    return f"unknown environment {name!r}; {hint}"


def _only_native(choice: Choice) -> bool:
    """Whether Gymnasium has no environment of this choice."""
    return choice.engine == "native" and (not _is_gymnasium_origin(choice) or is_only_native(choice.id))


def _is_gymnasium_origin(choice: Choice) -> bool:
    from thorndike.environments.native.vectorize import Dynamics
    from thorndike.types import Environment

    return not isinstance(choice.origin, Environment | Dynamics)


def _own_size(choice: Choice) -> int:
    from thorndike.types import Environment

    return choice.origin.spec.num_envs if isinstance(choice.origin, Environment) else 1
