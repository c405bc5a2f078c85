"""Where algorithms, environments and training meet. The command line and the studio call only this."""

from thorndike.api.building import make
from thorndike.api.comparing import Comparison, compare
from thorndike.api.learners import A2C, DQN, PPO, REINFORCE, Learner, QLearning
from thorndike.api.loading import LoadedPolicy, load
from thorndike.api.loading import evaluate_run as evaluate
from thorndike.api.reproducing import Reproduction, reproduce
from thorndike.api.training import resume, runs, train
from thorndike.api.training_result import Result

__all__ = [
    "A2C",
    "DQN",
    "PPO",
    "REINFORCE",
    "Comparison",
    "Learner",
    "LoadedPolicy",
    "QLearning",
    "Reproduction",
    "Result",
    "compare",
    "evaluate",
    "load",
    "make",
    "reproduce",
    "resume",
    "runs",
    "train",
]
