"""Randomised ensembled double Q-learning (REDQ): SAC with many critics, a random pair of which forms each target, and many updates a step.

Chen, Wang, Zhou, Ross 2021, "Randomized Ensembled Double Q-Learning: Learning Fast Without a Model" (arXiv:2101.05982). The policy climbs
the mean of all critics, once a round of updates. All else is sac.py, with its deviations. With ``layer_norm`` it is near DroQ (Hiraoka et
al. 2022, arXiv:2110.02034), without its dropout.

Logs what SAC logs. Results and their commands: docs/algorithms/redq.md.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import jax.numpy as jnp

from thorndike.algorithms.sac import Parts, soft_actor_critic
from thorndike.errors import UserError
from thorndike.functional.critic_losses import lowest, squared_errors
from thorndike.functional.soft_policy import temperature
from thorndike.networks.continuous import state_dependent
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.hindsight import STRATEGIES
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of REDQ, named as in Stable-Baselines3, with the paper's numbers."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 20  # G: updates in a round; -1: one an environment step
    ent_coef: float | Literal["auto"] = "auto"  # alpha: the temperature, or auto to learn it
    ent_coef_init: Annotated[float, AtLeast(1e-8)] = 1.0  # what a learnt alpha starts at
    target_entropy: float | Literal["auto"] = "auto"  # what a learnt alpha aims at; auto: minus the number of action dimensions
    n_critics: Annotated[int, AtLeast(1)] = 10  # N: critics of the ensemble
    n_target_critics: Annotated[int, AtLeast(1)] = 2  # M: how many of them, drawn at random each update, the target is the minimum of
    policy_delay: Annotated[int, AtLeast(1)] = 20  # updates of the critics for each one of the policy
    layer_norm: bool = False  # normalise the critics' hidden layers
    noise_color: Annotated[float, AtLeast(0)] = 0.0  # exploration noise over time: 0 white, 1 pink, 2 red
    use_sde: bool = False  # gSDE: explore by noise that depends on the state, and is held
    sde_sample_freq: Annotated[int, AtLeast(-1)] = -1  # steps it is held for; -1: train_freq
    log_std_init: float = -3.0  # with use_sde: log standard deviation of a feature's noise at the start
    goal_selection_strategy: Annotated[str, OneOf(*STRATEGIES)] = "none"  # HER: where replay finds other goals; for goal environments
    n_sampled_goal: Annotated[int, AtLeast(1)] = 4  # k: transitions with another goal for each one with its own
    net_arch: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    activation: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"  # after each hidden layer

    def __post_init__(self) -> None:
        check(self)
        if self.n_target_critics > self.n_critics:
            raise UserError(f"redq: n_target_critics {self.n_target_critics} is more than the n_critics {self.n_critics}")


def redq(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """REDQ for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    parts = Parts(
        exploration=state_dependent(config.use_sde, config.sde_sample_freq, config.log_std_init, config.noise_color),
        heat=temperature(config.ent_coef, config.target_entropy, spec.action_space),
        ent_coef_init=config.ent_coef_init,
        tau=config.tau,
        n_critics=config.n_critics,
        n_target_critics=config.n_target_critics,
        policy_delay=config.policy_delay,
        layer_norm=config.layer_norm,
        outputs=1,
        pessimism=lowest,
        errors=squared_errors,
        objective=lambda values: jnp.mean(values[..., 0], axis=0),
    )
    return soft_actor_critic("redq", config, parts, spec, network)
