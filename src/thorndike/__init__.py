"""Thorndike: learning from reward, from a two-armed bandit to a language model, in one small code base on JAX.

>>> import thorndike as td
>>> policy = td.load(td.train("ppo", "CartPole-v1", seeds=8).run)  # doctest: +SKIP
>>> action, memory = policy.predict(obs)  # doctest: +SKIP
"""

import importlib

from thorndike import startup

# Environment variables only, in a millisecond: JAX reads them when it is imported, which the first use of anything below does.
startup.prepare()

_PUBLIC = {
    "train": "thorndike.api",
    "resume": "thorndike.api",
    "reproduce": "thorndike.api",
    "load": "thorndike.api",
    "runs": "thorndike.api",
    "Result": "thorndike.api",
    "LoadedPolicy": "thorndike.api",
    "PPO": "thorndike.api",
    "A2C": "thorndike.api",
    "A3C": "thorndike.api",
    "IMPALA": "thorndike.api",
    "TRPO": "thorndike.api",
    "REINFORCE": "thorndike.api",
    "DQN": "thorndike.api",
    "Rainbow": "thorndike.api",
    "QRDQN": "thorndike.api",
    "IQN": "thorndike.api",
    "PQN": "thorndike.api",
    "BootstrappedDQN": "thorndike.api",
    "DDPG": "thorndike.api",
    "TD3": "thorndike.api",
    "SAC": "thorndike.api",
    "TQC": "thorndike.api",
    "CrossQ": "thorndike.api",
    "REDQ": "thorndike.api",
    "BC": "thorndike.api",
    "CQL": "thorndike.api",
    "IQL": "thorndike.api",
    "TD3BC": "thorndike.api",
    "AWAC": "thorndike.api",
    "QLearning": "thorndike.api",
    "AlphaZero": "thorndike.api",
    "MuZero": "thorndike.api",
    "make": "thorndike.api",
    "evaluate": "thorndike.api",
    "check_env": "thorndike.api.checking",
    "compare": "thorndike.api",
    "record": "thorndike.api",
    "dataset": "thorndike.api",
    "mix": "thorndike.api",
    "evaluate_offline": "thorndike.api",
    "collect_clips": "thorndike.api.clips",
    "judge_clips": "thorndike.api.clips",
    "fit_clips": "thorndike.api.clips",
    "train_on_choices": "thorndike.api.clip_rounds",
    "SimulatedRater": "thorndike.api.clip_rounds",
    "sweep": "thorndike.api",
    "resume_sweep": "thorndike.api",
    "game": "thorndike.games.registry",
    "player": "thorndike.api.playing",
    "play_match": "thorndike.api.playing",
    "arena": "thorndike.api.playing",
    "UserError": "thorndike.errors",
    "Network": "thorndike.networks.network",
    "planning": "thorndike.algorithms.planning",
    "wrappers": "thorndike.environments.wrappers",
}
"""Public name -> the module it lives in, imported when it is first used: ``import thorndike`` costs milliseconds."""

__all__ = sorted(_PUBLIC)
__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'thorndike' has no attribute {name!r}")
    module = importlib.import_module(_PUBLIC[name])
    return module if module.__name__.rpartition(".")[2] == name else getattr(module, name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
