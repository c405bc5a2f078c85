"""TD3+BC: TD3 on a dataset, with a term that keeps the policy near the dataset's actions.

Fujimoto and Gu 2021, "A Minimalist Approach to Offline Reinforcement Learning" (arXiv:2106.06860). Deviations:

1. Observations are not normalised by the dataset's mean and deviation.
2. A step cut by a time limit bootstraps from the observation it was cut at.

Logs ``train/actor_loss``, ``critic_loss``, ``q_mean``, ``actor_grad_norm``, ``critic_grad_norm``, ``learning_rate``. Results and their
commands: docs/algorithms/td3_bc.md.
"""

from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.algorithms.td3 import Parts, deterministic_actor_critic
from thorndike.functional.offline_losses import cloning_scale
from thorndike.functional.policy_losses import weighted_mean
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.offline import offline
from thorndike.replay.uniform import Transitions
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Number


@dataclass(frozen=True)
class Config:
    """Settings of TD3+BC, the paper's."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # updates of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update of the policy
    alpha: Annotated[float, AtLeast(0)] = 2.5  # what values, scaled to 1, weigh beside the squared error of actions; 0 clones
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
    policy_delay: Annotated[int, AtLeast(1)] = 2  # d: updates of the critics for each one of the policy
    target_policy_noise: Annotated[float, AtLeast(0)] = 0.2  # sigma~: deviation of the noise on the target's actions, in [-1, 1]
    target_noise_clip: Annotated[float, AtLeast(0)] = 0.5  # c: what that noise is clipped to
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)


def cloning_objective(q: Float[Array, " M"], action: Float[Array, "M D"], batch: Transitions, alpha: Number) -> Float[Array, ""]:
    """``-lambda Q(s, pi(s)) + |pi(s) - a|^2`` with ``lambda = alpha / E|Q|``: the paper, eq. 3 and 5."""
    distance = jnp.mean(jnp.square(action - batch.action), axis=-1)
    return weighted_mean(distance - cloning_scale(q, alpha, batch.weight) * q, batch.weight)


def td3_bc(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """TD3+BC for Box actions. Raises ``UserError`` for other action spaces."""
    parts = Parts(
        tau=config.tau,
        n_critics=config.n_critics,
        policy_delay=config.policy_delay,
        target_policy_noise=config.target_policy_noise,
        target_noise_clip=config.target_noise_clip,
        action_noise=0.0,
        objective=lambda q, action, batch: cloning_objective(q, action, batch, config.alpha),
    )
    return offline(deterministic_actor_critic("td3_bc", config, parts, spec, network), config, spec, config.gamma)
