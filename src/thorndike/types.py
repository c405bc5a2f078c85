"""The whole vocabulary: what environments, learners and the runner say to each other, as tuples of arrays or of pure functions.

Shapes are written ``[T, B, ...]``: time first, then the batch of environments. ``S`` is the number of seeds.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import gymnasium
from jaxtyping import Array, Bool, Float, Key, PyTree

from thorndike.games.game import Game

Observation: TypeAlias = PyTree
"""An array ``[B, ...]``, or a dict/tuple of them. Its entry ``action_mask``, if it has one, says which actions are allowed."""

Action: TypeAlias = PyTree
"""``int32[B]`` (Discrete), ``int32[B, K]`` (MultiDiscrete, MultiBinary) or ``float32[B, D]`` (Box)."""

Noise: TypeAlias = PyTree
"""Random numbers drawn ahead of a scan, ``[T, B, ...]``, or ``Shared`` ones ``[T, ...]``."""


class Shared(NamedTuple):
    """Noise of a step that all environments see, where other noise has a row for each of them."""

    numbers: Array


Metrics: TypeAlias = dict[str, Array]
"""Scalars by Stable-Baselines3's metric names, for example ``train/approx_kl``."""

Number: TypeAlias = float | Float[Array, ""]
"""A setting that is a plain number, or traced where the agents of one compiled program differ in it (a sweep)."""


class Step(NamedTuple):
    """One step of a batch of environments.

    ``terminated`` (the task ended: the future is worth 0) and ``truncated`` (a limit cut it: it goes on at ``next_obs``) stay apart.
    """

    obs: Observation
    """What the policy sees next, after any automatic reset: ``[B, ...]``."""
    next_obs: Observation
    """The true successor of the action, before any reset: ``[B, ...]``."""
    reward: Float[Array, "*batch"]
    cost: Float[Array, "*batch"]
    """0 unless the task is constrained."""
    terminated: Bool[Array, "*batch"]
    truncated: Bool[Array, "*batch"]
    valid: Bool[Array, "*batch"]
    """False only on the dead row that next-step autoreset makes: it is no transition."""

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """Whether the episode ended here, for either reason."""
        return self.terminated | self.truncated


class Rollout(NamedTuple):
    """A batch of experience, time-major ``[T, B, ...]``, as a source gives it to ``Algorithm.update``."""

    obs: Observation
    """What the policy saw when it chose ``action``."""
    action: Action
    extras: PyTree
    """What ``act`` returned beside the action (log-probabilities, exploration rate...)."""
    step: Step
    memory: PyTree
    """The recurrent state before the first step; ``()`` for feed-forward policies."""


class EpisodeStats(NamedTuple):
    """Sums over the episodes that ended in a rollout, of the environment's own rewards (before any shaping or scaling)."""

    episodes: Float[Array, ""]
    return_sum: Float[Array, ""]
    length_sum: Float[Array, ""]
    steps: Float[Array, ""]
    """Valid environment steps in the rollout."""


class Goal(NamedTuple):
    """How a goal environment judges, as pure functions of goals ``[M, ...]``: achieved, desired -> ``[M]``."""

    reward: Callable[[PyTree, PyTree], Float[Array, "*batch"]]
    terminated: Callable[[PyTree, PyTree], Bool[Array, "*batch"]]
    """Whether reaching ends the episode."""


class EnvSpec(NamedTuple):
    """Facts about an environment."""

    id: str
    observation_space: gymnasium.Space
    action_space: gymnasium.Space
    num_envs: int
    max_episode_steps: int | None = None
    engine: str = "native"
    """``native`` (compiled), ``gymnasium``, ``subprocess``, ``envpool`` or ``ale``; ``dataset`` where nothing is stepped."""
    goal: Goal | None = None
    """For hindsight; None where there are no goals, or where no compiled program can judge them."""
    frames: int = 1
    """How many successive frames an observation holds on its last axis, the newest last: replay stores each once."""
    game: Game | None = None
    """The rules, where the environment is a game of players who move in turn: what a search looks ahead with."""


class Environment(NamedTuple):
    """A batch of environments as pure functions (the compiled engines).

    ``step`` resets finished environments by itself. Its randomness is *noise*, drawn for many steps outside of the scan, which is cheap.
    """

    init: Callable[[Key[Array, ""]], tuple[PyTree, Observation]]
    """key -> state, first observation ``[B, ...]``. Consumes the key."""
    step: Callable[[PyTree, Action, Noise], tuple[PyTree, Step]]
    draw: Callable[[Key[Array, ""], int], Noise]
    """key, number of steps T -> noise with leading axis ``[T, ...]``. Consumes the key."""
    spec: EnvSpec


class Needs(NamedTuple):
    """What a learner asks of its source."""

    rollout_length: int
    """Steps of each environment between two updates."""
    on_policy: bool
    warmup_iterations: int = 0
    """Iterations that only ``observe`` before learning starts."""
    batch_size: int = 1
    """Transitions that a dataset gives side by side: its rollouts are ``[rollout_length, batch_size]``, a row an update."""


class Algorithm(NamedTuple):
    """A learner: a few pure functions, built by a factory such as ``ppo(config, spec)``. It does not own the environment loop."""

    init: Callable[[Key[Array, ""]], PyTree]
    """key -> State: parameters, optimiser, replay, statistics."""
    actor: Callable[[PyTree], PyTree]
    """State -> Actor: the small part needed to act; what is exported and evaluated."""
    memory: Callable[[int], PyTree]
    """batch size -> initial recurrent state; ``()`` for feed-forward policies."""
    draw: Callable[[Key[Array, ""], int], Noise]
    """key, number of steps T -> noise ``[T, ...]`` for ``act``. Consumes the key."""
    act: Callable[[PyTree, PyTree, Observation, Noise], tuple[PyTree, Action, PyTree]]
    """Actor, memory, obs ``[B, ...]``, noise of this step -> memory, action, extras."""
    greedy: Callable[[PyTree, PyTree, Observation, Noise], tuple[PyTree, Action, PyTree]]
    """The evaluation policy, with the signature of ``act``."""
    value: Callable[[PyTree, Observation], Float[Array, "*batch"]]
    """Actor, obs -> the learner's estimate of the state's value; with memory, as at the beginning of an episode."""
    update: Callable[[PyTree, Rollout, Key[Array, ""]], tuple[PyTree, Metrics]]
    """State, rollout, key -> State, metrics: one iteration of learning. Consumes the key."""
    observe: Callable[[PyTree, Rollout, Key[Array, ""]], tuple[PyTree, Metrics]]
    """The same signature: store only, no learning (the warm-up segment)."""
    needs: Needs
    probabilities: Callable[[PyTree, PyTree, Observation], Float[Array, "*batch actions"]] | None = None
    """Actor, memory, obs -> the probability of each Discrete action under ``act``; None where it is not known."""
    dynamics: Callable[[PyTree, PyTree], Metrics] | None = None
    """State, the latest rollout (``()`` if there is a replay to look into) -> what is logged at a few log points only: dead units, ..."""


class Wrapper(NamedTuple):
    """A change to what the learner sees, as pure functions over a stream of steps: it works on every engine.

    ``memory`` is per environment (stacked frames); ``statistics`` (running mean) are shared, frozen in evaluation, exported.
    """

    name: str
    settings: dict
    """What ``run.json`` records so that the wrapper can be rebuilt; empty if it holds a function of the user's."""
    spec: Callable[[EnvSpec], EnvSpec]
    statistics: Callable[[EnvSpec], PyTree]
    """wrapped spec -> initial statistics, ``()`` if none."""
    init: Callable[[PyTree, Observation], tuple[PyTree, Observation]]
    """statistics, first obs ``[B, ...]`` -> memory, obs as the learner sees it."""
    step: Callable[[PyTree, PyTree, Observation, Action, Step], tuple[PyTree, Step]]
    """statistics, memory, the unwrapped obs acted on, action, Step -> memory, Step as the learner sees it."""
    learn: Callable[[PyTree, PyTree, Rollout], tuple[PyTree, PyTree, Rollout]]
    """statistics, memory, rollout as ``step`` made it -> statistics, memory, rollout: once a rollout, all ``[T, B]`` rows at once."""
    randomize: Callable[[PyTree, Key[Array, ""]], PyTree] = lambda statistics, key: statistics
    """initial statistics, key -> those that a seed begins with, where some of them are random. Consumes the key."""


class Source(NamedTuple):
    """Where batches come from: a compiled rollout, a host rollout, a dataset."""

    init: Callable[[Key[Array, ""]], PyTree]
    """key -> source state. Consumes the key."""
    draw: Callable[[Key[Array, ""], int], Noise]
    """key, number of iterations -> their random numbers, leading with the iteration. Consumes the key."""
    collect: Callable[[PyTree, PyTree, Noise], tuple[PyTree, Rollout, EpisodeStats]]
    """source state, Actor, noise of one iteration -> source state, rollout ``[T, B, ...]``, episode statistics."""
    statistics: Callable[[PyTree], PyTree]
    """source state -> the wrappers' learnt statistics: exported with the policy."""
    spec: EnvSpec
    """As the learner sees it, wrappers included."""
    compiled: bool
    """Whether ``collect`` may be traced (compiled engines) or steps a host engine from Python."""
