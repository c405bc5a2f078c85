"""Where algorithms, environments and training meet. The command line and the studio call only this."""

from thorndike import startup

startup.prepare()

from thorndike.api.building import make  # noqa: E402
from thorndike.api.learners import DQN, PPO, Learner, QLearning  # noqa: E402
from thorndike.api.loading import LoadedPolicy, load  # noqa: E402
from thorndike.api.loading import evaluate_run as evaluate  # noqa: E402
from thorndike.api.training import resume, runs, train  # noqa: E402
from thorndike.api.training_result import Result  # noqa: E402

__all__ = ["DQN", "PPO", "Learner", "LoadedPolicy", "QLearning", "Result", "evaluate", "load", "make", "resume", "runs", "train"]
