"""Where algorithms, environments and training meet. The command line and the studio call only this."""

from thorndike.api.learners import DQN, PPO, Learner, QLearning
from thorndike.api.loading import LoadedPolicy, load
from thorndike.api.training import Result, resume, runs, train

__all__ = ["DQN", "PPO", "Learner", "LoadedPolicy", "QLearning", "Result", "load", "resume", "runs", "train"]
