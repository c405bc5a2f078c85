"""Deep Q-network (DQN), with every improvement of the family as a part to switch on.

Mnih et al. 2015, "Human-level control through deep reinforcement learning" (Nature 518). Parts: double (van Hasselt et al. 2016,
arXiv:1509.06461), dueling (Wang et al. 2016, arXiv:1511.06581), n-step and all of Rainbow (Hessel et al. 2018, arXiv:1710.02298),
prioritised replay (Schaul et al. 2016, arXiv:1511.05952), noisy layers (Fortunato et al. 2018, arXiv:1706.10295), distributions of
returns (functional/distributional.py), Munchausen (Vieillard et al. 2020, arXiv:2007.14430), memory (Kapturowski et al. 2019, R2D2),
periodic resets (Nikishin et al. 2022, arXiv:2205.07802), Boltzmann exploration (Sutton 1990), hindsight (Andrychowicz et al. 2017,
arXiv:1707.01495). Deviations from Mnih:

1. Adam with gradients clipped by their global norm, in place of RMSProp (as in Stable-Baselines3).
2. A step cut by a time limit bootstraps from the observation it was cut at.
3. Several environments step side by side; ``train_freq`` and ``target_update_interval`` count steps of all of them together.
4. ``learning_starts``, ``target_update_interval`` and ``reset_every`` take effect at the end of the iteration they fall in.
5. Noisy layers draw new noise at every step for all environments together, and once a minibatch for each of the two networks.
6. A reset renews the whole network, not its last layers, and none comes within ``reset_every`` steps of the end.

Logs ``train/loss``, ``train/q_mean``, ``train/grad_norm``, ``train/learning_rate``, ``rollout/exploration_rate``. Results and their
commands: docs/algorithms/dqn.md.
"""

from dataclasses import dataclass
from typing import Annotated

from thorndike.errors import UserError
from thorndike.functional.distributional import DISTRIBUTIONS, Support, return_distribution
from thorndike.functional.value_loss import Munchausen
from thorndike.networks.cnn import CNNS
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.recurrent import MEMORIES
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.deep_q import Memory, Options, Priorities, deep_q
from thorndike.replay.hindsight import STRATEGIES, Hindsight
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of DQN, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 100_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 1_000  # environment steps before the first update
    batch_size: Annotated[int, AtLeast(1)] = 32  # M: transitions of a minibatch
    train_freq: Annotated[int, AtLeast(1)] = 4  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    target_update_interval: Annotated[int, AtLeast(1)] = 10_000  # C: environment steps between updates of the target network
    tau: Annotated[float, Between(0, 1)] = 1.0  # how far the target moves to the network then
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    exploration_fraction: Annotated[float, MoreThan(0)] = 0.1  # share of the run over which epsilon falls
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # epsilon at the start
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # epsilon at the end
    exploration: Annotated[str, OneOf("epsilon", "boltzmann")] = "epsilon"  # explore by random actions, or by the values' exponentials
    temperature: Annotated[float | str, MoreThan(0)] = "linear(1, 0.01)"  # of boltzmann: values are divided by it
    max_grad_norm: Annotated[float, MoreThan(0)] = 10.0  # global norm the gradient is clipped to
    adam_eps: Annotated[float, MoreThan(0)] = 1e-8  # Adam's epsilon
    double: bool = False  # choose the next action by the network, value it by the target
    dueling: bool = False  # separate streams for value and advantages
    n_step: Annotated[int, AtLeast(1)] = 1  # rewards summed before bootstrapping
    prioritized: bool = False  # draw transitions in proportion to a power of their last error
    prioritized_alpha: Annotated[float, Between(0, 1)] = 0.6  # alpha: that power
    prioritized_beta0: Annotated[float, Between(0, 1)] = 0.4  # beta at the start: how far importance weights undo it; 1 at the end
    noisy: bool = False  # explore by noise on the weights, in place of epsilon
    noisy_sigma: Annotated[float, AtLeast(0)] = 0.5  # sigma_0: the noise at the start
    distribution: Annotated[str, OneOf(*DISTRIBUTIONS)] = "none"  # of returns: what is learnt beyond their mean
    atoms: Annotated[int, AtLeast(2)] = 51  # N: returns that c51 gives a probability each
    v_min: float = -10.0  # the smallest of them
    v_max: float = 10.0  # the largest
    quantiles: Annotated[int, AtLeast(1)] = 32  # N: quantiles that are learnt, or drawn at random (implicit)
    munchausen: bool = False  # add the log-policy to the reward and act softly in the target
    munchausen_alpha: Annotated[float, Between(0, 1)] = 0.9  # alpha: how much of it
    munchausen_tau: Annotated[float, MoreThan(0)] = 0.03  # tau: temperature of the policy
    munchausen_clip: float = -1.0  # l_0: the log-policy's lowest value
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    reset_every: Annotated[int, AtLeast(0)] = 0  # environment steps between new beginnings of the network; 0: never
    memory: Annotated[str, OneOf(*MEMORIES)] = "none"  # recurrent memory of the network
    memory_size: Annotated[int, AtLeast(1)] = 64  # its width
    sequence_length: Annotated[int, AtLeast(2)] = 16  # with memory: steps of a sampled sequence; a minibatch holds batch_size in all
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images

    def __post_init__(self) -> None:
        check(self)
        if self.distribution == "c51" and self.v_min >= self.v_max:
            raise UserError(f"dqn: c51 needs v_min below v_max; got {self.v_min} and {self.v_max}")
        if self.distribution == "c51" and self.munchausen:
            raise UserError("dqn: munchausen moves the returns of each action differently, which c51 cannot: set distribution to quantile")


def dqn(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """DQN for an environment with Discrete actions. Raises ``UserError`` for other action spaces, and parts that do not go together."""
    support = Support(config.v_min, config.v_max, config.atoms)
    options = Options(
        distribution=return_distribution(config.distribution, support, config.quantiles),
        implicit=config.distribution == "implicit",
        double=config.double,
        dueling=config.dueling,
        n_step=config.n_step,
        priorities=Priorities(config.prioritized_alpha, config.prioritized_beta0) if config.prioritized else None,
        noisy_sigma=config.noisy_sigma if config.noisy else None,
        munchausen=Munchausen(config.munchausen_alpha, config.munchausen_tau, config.munchausen_clip) if config.munchausen else None,
        memory=None if config.memory == "none" else Memory(config.memory, config.memory_size, config.sequence_length),
        hindsight=None if config.goal_selection_strategy == "none" else Hindsight(config.goal_selection_strategy, config.n_sampled_goal),
        reset_every=config.reset_every,
        temperature=config.temperature if config.exploration == "boltzmann" else None,
    )
    return deep_q("dqn", config, options, spec, network)
