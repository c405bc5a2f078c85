"""Implicit quantile networks (IQN): deep Q-learning of the return's distribution, asked for at random quantile levels.

Dabney, Ostrovski, Silver and Munos 2018, "Implicit Quantile Networks for Distributional Reinforcement Learning" (arXiv:1806.06923). It is
DQN (algorithms/dqn.py, with its deviations) with another network and loss; ``dqn`` with ``distribution=implicit`` is the same learner.
Deviations from the paper:

1. Acting and the choice of the next action take the mean over fixed levels, 32 midpoints, in place of 32 drawn anew.
   (The next action of the target is chosen by the levels that its values are drawn at.)
2. As many levels are drawn for the target as for the prediction (N = N').
3. The embedding's 64 cosines count from 0, as in eq. 4 of the paper; the Huber threshold kappa is 1.

Logs what DQN logs. Results and their commands: docs/algorithms/iqn.md.
"""

from dataclasses import dataclass
from typing import Annotated

from thorndike.functional.distributional import implicit_quantiles
from thorndike.functional.value_loss import Munchausen
from thorndike.networks.cnn import CNNS
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.deep_q import Options, Priorities, deep_q
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of IQN, named as in Stable-Baselines3's DQN."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 5e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 100_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 1_000  # environment steps before the first update
    batch_size: Annotated[int, AtLeast(1)] = 32  # M: transitions of a minibatch
    train_freq: Annotated[int, AtLeast(1)] = 4  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    target_update_interval: Annotated[int, AtLeast(1)] = 1_000  # C: environment steps between updates of the target network
    tau: Annotated[float, Between(0, 1)] = 1.0  # how far the target moves to the network then
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    exploration_fraction: Annotated[float, MoreThan(0)] = 0.1  # share of the run over which epsilon falls
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # epsilon at the start
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # epsilon at the end
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    adam_eps: Annotated[float, MoreThan(0)] = 1e-8  # Adam's epsilon
    n_quantiles: Annotated[int, AtLeast(1)] = 16  # N and N': levels drawn for a transition
    double: bool = False  # choose the next action by the network, value it by the target
    dueling: bool = False  # separate streams for value and advantages
    n_step: Annotated[int, AtLeast(1)] = 1  # rewards summed before bootstrapping
    prioritized: bool = False  # draw transitions in proportion to a power of their last error
    prioritized_alpha: Annotated[float, Between(0, 1)] = 0.6  # alpha, omega in Hessel et al.: the power of the error
    prioritized_beta0: Annotated[float, Between(0, 1)] = 0.4  # beta at the start: how far importance weights undo it; 1 at the end
    munchausen: bool = False  # M-IQN: add the log-policy to the reward and act softly in the target
    munchausen_alpha: Annotated[float, Between(0, 1)] = 0.9  # alpha: how much of it
    munchausen_tau: Annotated[float, MoreThan(0)] = 0.03  # tau: temperature of the policy
    munchausen_clip: float = -1.0  # l_0: the log-policy's lowest value
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images

    def __post_init__(self) -> None:
        check(self)


def iqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """IQN for an environment with Discrete actions. Raises ``UserError`` for other action spaces, and for a ``network``: it has its own."""
    options = Options(
        distribution=implicit_quantiles(config.n_quantiles),
        implicit=True,
        double=config.double,
        dueling=config.dueling,
        n_step=config.n_step,
        priorities=Priorities(config.prioritized_alpha, config.prioritized_beta0) if config.prioritized else None,
        munchausen=Munchausen(config.munchausen_alpha, config.munchausen_tau, config.munchausen_clip) if config.munchausen else None,
    )
    return deep_q("iqn", config, options, spec, network)
