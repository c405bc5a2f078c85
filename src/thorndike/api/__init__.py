"""Where algorithms, environments and training meet. The command line and the studio call only this."""

from thorndike.api.building import make
from thorndike.api.learners import DQN, PPO, Learner, QLearning
from thorndike.api.loading import LoadedPolicy, load
from thorndike.api.loading import evaluate_run as evaluate
from thorndike.api.training import resume, runs, train
from thorndike.api.training_result import Result

__all__ = ["DQN", "PPO", "Learner", "LoadedPolicy", "QLearning", "Result", "evaluate", "load", "make", "resume", "runs", "train"]
