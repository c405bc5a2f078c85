"""Algorithms as objects, for those who think in them: ``PPO("CartPole-v1", learning_rate=1e-3).learn(100_000).predict(obs)``."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import PyTree

from thorndike.api.building import EnvironmentLike
from thorndike.api.loading import LoadedPolicy, load
from thorndike.api.training import resume, train
from thorndike.api.training_result import Result
from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.learning_sources import is_dataset
from thorndike.networks.network import NetworkBuilder
from thorndike.suggestions import did_you_mean
from thorndike.training.datasets import Dataset
from thorndike.training.evaluation import Evaluation
from thorndike.types import Wrapper


class Learner:
    """An algorithm on an environment or, of those that learn from data, on a dataset or its folder.

    Every ``learn`` makes or continues a run directory, ``learner.result.run``.
    """

    algorithm: str

    def __init__(
        self,
        environment: EnvironmentLike | Dataset | Path,
        *,
        num_envs: int | None = None,
        seeds: int = 1,
        seed: int = 0,
        preset: str | None = None,
        engine: str = "auto",
        device: str = "auto",
        devices: int | None = None,
        output: str | Path = "runs",
        name: str | None = None,
        checkpoint_every: int | None = None,
        max_episode_steps: int | None = None,
        wrappers: Sequence[Wrapper] | None = None,
        network: NetworkBuilder | None = None,
        env_kwargs: dict[str, object] | None = None,
        env_timeout: float | None = None,
        actor_threads: int = 0,
        actor_schedule: str = "fixed",
        env_restarts: int = 0,
        start_from: str | Path | None = None,
        **settings: object,
    ) -> None:
        """``settings`` are fields of the algorithm's ``Config``, the rest is as in ``td.train``. Raises ``UserError`` for unknown ones."""
        known = read_config_fields(self.algorithm)
        for name in settings:
            if name not in known:
                raise UserError(f"{self.algorithm} has no setting '{name}'{did_you_mean(name, known)}")
        place = environment.path if isinstance(environment, Dataset) else environment
        learns_from = str(place) if isinstance(place, Path) else place
        # What to evaluate on; a dataset's run knows the environment by itself.
        self._environment = None if is_dataset(learns_from) else learns_from
        self._wrappers, self._network = wrappers, network
        self._train = partial(
            train,
            self.algorithm,
            learns_from,
            num_envs=num_envs,
            seeds=seeds,
            seed=seed,
            settings=settings,
            preset=preset,
            engine=engine,
            device=device,
            devices=devices,
            output=output,
            name=name,
            checkpoint_every=checkpoint_every,
            max_episode_steps=max_episode_steps,
            wrappers=wrappers,
            network=network,
            env_kwargs=env_kwargs,
            env_timeout=env_timeout,
            actor_threads=actor_threads,
            actor_schedule=actor_schedule,
            env_restarts=env_restarts,
            start_from=start_from,
        )
        self.result: Result | None = None
        self._policy: LoadedPolicy | None = None

    def learn(self, steps: int | None = None, progress: bool = False) -> "Learner":
        """Train for ``steps`` environment steps of each seed, or updates on a dataset; a second call trains that much further."""
        if self.result is None:
            self.result = self._train(steps=steps, progress=progress)
        else:
            self.result = resume(
                self.result.run,
                steps=None if steps is None else self.result.steps + steps,
                environment=self._environment,
                wrappers=self._wrappers,
                network=self._network,
                progress=progress,
            )
        self._policy = None
        return self

    @property
    def policy(self) -> LoadedPolicy:
        """The trained policy. Raises ``UserError`` before ``learn``."""
        if self.result is None:
            raise UserError(f"this {type(self).__name__} has not learnt yet: call .learn(steps) first")
        if self._policy is None:
            self._policy = load(self.result.run, environment=self._environment, network=self._network)
        return self._policy

    def predict(
        self, obs: PyTree, memory: PyTree = None, deterministic: bool = True, action_mask: np.ndarray | None = None
    ) -> tuple[np.ndarray, PyTree]:
        """Action for one observation or a batch, and the memory to pass with the next."""
        return self.policy.predict(obs, memory, deterministic, action_mask)

    def evaluate(self, episodes: int = 100, seed: int = 0) -> Evaluation:
        """Run every seed on fresh reference environments."""
        return self.policy.evaluate(episodes, seed)


class PPO(Learner):
    """Proximal policy optimisation."""

    algorithm = "ppo"


class A2C(Learner):
    """Advantage actor-critic."""

    algorithm = "a2c"


class A3C(Learner):
    """Asynchronous advantage actor-critic."""

    algorithm = "a3c"


class IMPALA(Learner):
    """Actor-critic with V-trace."""

    algorithm = "impala"


class TRPO(Learner):
    """Trust region policy optimisation."""

    algorithm = "trpo"


class REINFORCE(Learner):
    """REINFORCE, with or without a baseline."""

    algorithm = "reinforce"


class DQN(Learner):
    """Deep Q-network."""

    algorithm = "dqn"


class Rainbow(Learner):
    """DQN with six improvements."""

    algorithm = "rainbow"


class QRDQN(Learner):
    """Quantile regression DQN."""

    algorithm = "qr_dqn"


class IQN(Learner):
    """Implicit quantile networks."""

    algorithm = "iqn"


class BootstrappedDQN(Learner):
    """DQN that follows one member of an ensemble each episode."""

    algorithm = "bootstrapped_dqn"


class PQN(Learner):
    """Parallelised Q-network."""

    algorithm = "pqn"


class SAC(Learner):
    """Soft actor-critic."""

    algorithm = "sac"


class TD3(Learner):
    """Twin delayed deep deterministic policy gradient."""

    algorithm = "td3"


class DDPG(Learner):
    """Deep deterministic policy gradient."""

    algorithm = "ddpg"


class TQC(Learner):
    """Truncated quantile critics."""

    algorithm = "tqc"


class CrossQ(Learner):
    """CrossQ: SAC without target networks."""

    algorithm = "crossq"


class REDQ(Learner):
    """Randomised ensembled double Q-learning."""

    algorithm = "redq"


class BC(Learner):
    """Behaviour cloning of a dataset."""

    algorithm = "bc"


class CQL(Learner):
    """Conservative Q-learning from a dataset."""

    algorithm = "cql"


class IQL(Learner):
    """Implicit Q-learning from a dataset."""

    algorithm = "iql"


class TD3BC(Learner):
    """TD3 from a dataset, kept near its actions."""

    algorithm = "td3_bc"


class AWAC(Learner):
    """Advantage-weighted actor-critic, from a dataset or an environment."""

    algorithm = "awac"


class QLearning(Learner):
    """Tabular Q-learning and its relatives."""

    algorithm = "q_learning"


class AlphaZero(Learner):
    """A game of two, learnt by playing oneself."""

    algorithm = "alphazero"


class MuZero(Learner):
    """A tree search through a learnt model, for games and for environments with Discrete actions."""

    algorithm = "muzero"
