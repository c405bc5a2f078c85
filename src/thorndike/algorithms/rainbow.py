"""Rainbow: deep Q-learning with six improvements at once.

Hessel et al. 2018, "Rainbow: Combining Improvements in Deep Reinforcement Learning" (arXiv:1710.02298): double, dueling, n-step,
prioritised replay, noisy layers and the categorical distribution of returns (C51). It is their composition: each is a part that ``dqn``
has too, alone or with others. Deviations from the paper, beside those of algorithms/dqn.py:

1. ``noisy = false`` explores by epsilon instead, and ``distribution = quantile`` learns quantiles in place of C51's atoms, as many
   studies of small problems do.
2. Numbers fit small problems: the paper's learning rate is 6.25e-5, its target moves every 32,000 frames, learning starts at 80,000.
3. New noise is drawn once a minibatch for each network; the network that chooses the next action has that of the one that learns.

Logs what DQN logs. Results and their commands: docs/algorithms/rainbow.md.
"""

from dataclasses import dataclass
from typing import Annotated

from thorndike.errors import UserError
from thorndike.functional.distributional import Support, return_distribution
from thorndike.networks.cnn import CNNS
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.deep_q import Options, Priorities, deep_q
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of Rainbow, named as in Stable-Baselines3's DQN."""

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
    n_step: Annotated[int, AtLeast(1)] = 3  # n: rewards summed before bootstrapping
    distribution: Annotated[str, OneOf("c51", "quantile")] = "c51"  # of returns: probabilities of atoms, or values at quantiles
    atoms: Annotated[int, AtLeast(2)] = 51  # N_atoms: returns, or quantiles, that describe an action
    v_min: float = -10.0  # the smallest atom
    v_max: float = 10.0  # the largest
    prioritized_alpha: Annotated[float, Between(0, 1)] = 0.5  # alpha, omega in Hessel et al.: the power of the error
    prioritized_beta0: Annotated[float, Between(0, 1)] = 0.4  # beta at the start: how far importance weights undo it; 1 at the end
    noisy: bool = True  # explore by noise on the weights, in place of epsilon
    noisy_sigma: Annotated[float, AtLeast(0)] = 0.5  # sigma_0: the noise at the start
    exploration_fraction: Annotated[float, MoreThan(0)] = 0.1  # without noise: share of the run over which epsilon falls
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # epsilon at the start
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # epsilon at the end
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    adam_eps: Annotated[float, MoreThan(0)] = 1.5e-4  # Adam's epsilon
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images

    def __post_init__(self) -> None:
        check(self)
        if self.v_min >= self.v_max:
            raise UserError(f"rainbow: v_min must lie below v_max; got {self.v_min} and {self.v_max}")


def rainbow(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """Rainbow for an environment with Discrete actions. Raises ``UserError`` for other action spaces."""
    options = Options(
        distribution=return_distribution(config.distribution, Support(config.v_min, config.v_max, config.atoms), config.atoms),
        double=True,
        dueling=True,
        n_step=config.n_step,
        priorities=Priorities(config.prioritized_alpha, config.prioritized_beta0),
        noisy_sigma=config.noisy_sigma if config.noisy else None,
    )
    return deep_q("rainbow", config, options, spec, network)
