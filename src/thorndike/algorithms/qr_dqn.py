"""QR-DQN: deep Q-learning of the return's whole distribution, as its values at fixed quantiles.

Dabney, Rowland, Bellemare and Munos 2018, "Distributional Reinforcement Learning with Quantile Regression" (arXiv:1710.10044), algorithm 1.
It is DQN (algorithms/dqn.py, with its deviations) with another kind of output and loss; ``dqn`` with ``distribution=quantile`` is the same
learner. Deviations from the paper:

1. The loss is summed over the predicted quantiles and averaged over the target's, with kappa = 1 (the paper's QR-DQN-1).
2. Fewer quantiles by default: 32 in place of 200, which small problems do not need.

Logs what DQN logs. Results and their commands: docs/algorithms/qr_dqn.md.
"""

from dataclasses import dataclass
from typing import Annotated

from thorndike.functional.distributional import quantiles
from thorndike.networks.cnn import CNNS
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.deep_q import Options, Priorities, deep_q
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of QR-DQN, named as in Stable-Baselines3 and its contributed package."""

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
    n_quantiles: Annotated[int, AtLeast(1)] = 32  # N: quantiles of each action's return
    double: bool = False  # choose the next action by the network, value it by the target
    dueling: bool = False  # separate streams for value and advantages
    n_step: Annotated[int, AtLeast(1)] = 1  # rewards summed before bootstrapping
    prioritized: bool = False  # draw transitions in proportion to a power of their last error
    prioritized_alpha: Annotated[float, Between(0, 1)] = 0.6  # alpha, omega in Hessel et al.: the power of the error
    prioritized_beta0: Annotated[float, Between(0, 1)] = 0.4  # beta at the start: how far importance weights undo it; 1 at the end
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images

    def __post_init__(self) -> None:
        check(self)


def qr_dqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """QR-DQN for an environment with Discrete actions. Raises ``UserError`` for other action spaces."""
    options = Options(
        distribution=quantiles(config.n_quantiles),
        double=config.double,
        dueling=config.dueling,
        n_step=config.n_step,
        priorities=Priorities(config.prioritized_alpha, config.prioritized_beta0) if config.prioritized else None,
    )
    return deep_q("qr_dqn", config, options, spec, network)
