"""Deep deterministic policy gradient (DDPG): TD3 without its three tricks.

Lillicrap et al. 2016, "Continuous control with deep reinforcement learning" (arXiv:1509.02971). One critic, the policy updated with it each
time, no noise on the target's actions. Deviations:

1. Normal noise explores, not the Ornstein-Uhlenbeck process; ``noise_color=2`` (red) is near it.
2. One learning rate for both networks, no weight decay, no batch normalisation, as in Stable-Baselines3.
3. A step cut by a time limit bootstraps from the observation it was cut at.
4. Several environments step side by side; ``train_freq`` counts the steps of all of them together.

Logs what TD3 logs. Results and their commands: docs/algorithms/ddpg.md.
"""

from dataclasses import dataclass
from typing import Annotated

from thorndike.algorithms.td3 import Parts, climb, deterministic_actor_critic
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.hindsight import STRATEGIES
from thorndike.replay.off_policy import off_policy
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of DDPG, named and preset as in Stable-Baselines3."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    action_noise: Annotated[float, AtLeast(0)] = 0.1  # sigma: deviation of the exploration noise
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


def ddpg(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """DDPG for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    parts = Parts(
        tau=config.tau,
        n_critics=1,
        policy_delay=1,
        target_policy_noise=0.0,
        target_noise_clip=0.0,
        action_noise=config.action_noise,
        objective=climb,
    )
    return off_policy(deterministic_actor_critic("ddpg", config, parts, spec, network), config, spec)
