"""Where algorithms, environments and training meet. The command line and the studio call only this."""

from thorndike.api.building import make
from thorndike.api.comparing import Comparison, compare
from thorndike.api.evaluating_offline import OfflineEvaluation, evaluate_offline
from thorndike.api.learners import (
    A2C,
    A3C,
    AWAC,
    BC,
    CQL,
    DDPG,
    DQN,
    IMPALA,
    IQL,
    IQN,
    PPO,
    PQN,
    QRDQN,
    REDQ,
    REINFORCE,
    SAC,
    TD3,
    TD3BC,
    TQC,
    TRPO,
    AlphaZero,
    BootstrappedDQN,
    CrossQ,
    Learner,
    QLearning,
    Rainbow,
)
from thorndike.api.loading import LoadedPolicy, load
from thorndike.api.loading import evaluate_run as evaluate
from thorndike.api.recording import dataset, mix, record
from thorndike.api.reproducing import Reproduction, reproduce
from thorndike.api.sweeping import Sweep, resume_sweep, sweep
from thorndike.api.training import resume, runs, train
from thorndike.api.training_result import Result

__all__ = [
    "A2C",
    "A3C",
    "AWAC",
    "BC",
    "CQL",
    "DDPG",
    "DQN",
    "IMPALA",
    "IQL",
    "IQN",
    "PPO",
    "PQN",
    "QRDQN",
    "REDQ",
    "REINFORCE",
    "SAC",
    "TD3",
    "TD3BC",
    "TQC",
    "TRPO",
    "AlphaZero",
    "BootstrappedDQN",
    "Comparison",
    "CrossQ",
    "Learner",
    "LoadedPolicy",
    "OfflineEvaluation",
    "QLearning",
    "Rainbow",
    "Reproduction",
    "Result",
    "Sweep",
    "compare",
    "dataset",
    "evaluate",
    "evaluate_offline",
    "load",
    "make",
    "mix",
    "record",
    "reproduce",
    "resume",
    "resume_sweep",
    "runs",
    "sweep",
    "train",
]
