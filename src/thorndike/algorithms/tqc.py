"""Truncated quantile critics (TQC): SAC whose critics give quantiles of the return, the highest of which are left out of the target.

Kuznetsov, Shvechikov, Grishin, Vetrov 2020, "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics" (arXiv:2005.04269). All else is sac.py, with its deviations. Two critics by default, as in sb3-contrib, not the paper's five.

Logs what SAC logs. Results and their commands: docs/algorithms/tqc.md.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import jax.numpy as jnp

from thorndike.algorithms.sac import Parts, soft_actor_critic
from thorndike.errors import UserError
from thorndike.functional.critic_losses import lowest_atoms, quantile_errors
from thorndike.functional.soft_policy import temperature
from thorndike.networks.continuous import state_dependent
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import ACTIVATIONS
from thorndike.replay.hindsight import STRATEGIES
from thorndike.settings import AtLeast, Between, OneOf, check
from thorndike.types import Algorithm, EnvSpec


@dataclass(frozen=True)
class Config:
    """Settings of TQC, named and preset as in sb3-contrib."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4  # Adam's step size, or a schedule such as linear(1e-3, 0)
    buffer_size: Annotated[int, AtLeast(1)] = 1_000_000  # N: transitions kept
    learning_starts: Annotated[int, AtLeast(0)] = 100  # environment steps of uniform actions before the first update
    batch_size: Annotated[int, AtLeast(1)] = 256  # M: transitions of a minibatch
    tau: Annotated[float, Between(0, 1)] = 0.005  # how far the targets move to the critics at each update
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    train_freq: Annotated[int, AtLeast(1)] = 1  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 1  # updates in a round; -1: one an environment step
    ent_coef: float | Literal["auto"] = "auto"  # alpha: the temperature, or auto to learn it
    ent_coef_init: Annotated[float, AtLeast(1e-8)] = 1.0  # what a learnt alpha starts at
    target_entropy: float | Literal["auto"] = "auto"  # what a learnt alpha aims at; auto: minus the number of action dimensions
    n_quantiles: Annotated[int, AtLeast(1)] = 25  # M: quantiles a critic gives
    top_quantiles_to_drop_per_net: Annotated[int, AtLeast(0)] = 2  # d: of each critic's number, the highest left out of the target
    n_critics: Annotated[int, AtLeast(1)] = 2  # K: critics of the ensemble
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
        if self.top_quantiles_to_drop_per_net >= self.n_quantiles:
            raise UserError(
                f"tqc: top_quantiles_to_drop_per_net {self.top_quantiles_to_drop_per_net} leaves none of the {self.n_quantiles} n_quantiles"
            )


def tqc(config: Config, spec: EnvSpec, network: NetworkBuilder | None = None) -> Algorithm:
    """TQC for an environment with Box actions. Raises ``UserError`` for other action spaces."""
    parts = Parts(
        exploration=state_dependent(config.use_sde, config.sde_sample_freq, config.log_std_init, config.noise_color),
        heat=temperature(config.ent_coef, config.target_entropy, spec.action_space),
        ent_coef_init=config.ent_coef_init,
        tau=config.tau,
        n_critics=config.n_critics,
        n_target_critics=config.n_critics,
        policy_delay=1,
        layer_norm=config.layer_norm,
        outputs=config.n_quantiles,
        pessimism=partial(lowest_atoms, drop=config.top_quantiles_to_drop_per_net * config.n_critics),
        errors=quantile_errors,
        objective=lambda values: jnp.mean(values, axis=(0, 2)),
    )
    return soft_actor_critic("tqc", config, parts, spec, network)
