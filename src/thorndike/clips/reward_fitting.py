"""A reward learnt from choices between clips: an ensemble of networks whose sums over a clip decide, by Bradley-Terry.

Christiano, Leike, Brown, Martic, Legg and Amodei 2017 (arXiv:1706.03741), section 2.2.3: every member learns from a bootstrap of the
choices; those that its bootstrap leaves out, 1/e of them, are held out, and the weight of its L2 penalty is adapted until their loss is 1.1
to 1.5 times that of the others; a tenth of choices are taken to be random; what members say is normalised, then averaged. Deviations:

1. Every fit begins afresh, on all choices so far, so that a reward follows from its choices and seed alone; the paper's goes on.
2. Level and spread of a member are those over the steps of all clips, not running ones of what the policy earns.
3. Where some clips ended early their lengths tell the level of the reward, which is then kept, and only its spread is normalised. The paper
   lets no episode end early.
4. Optimiser, sizes of steps and minibatches are not in the paper.

Logs nothing; ``Report`` says how well the choices are met.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key

from thorndike.clips.segments import Choices, Segments
from thorndike.environments.learned_reward import LearnedReward, as_rows, network_of, no_reward, raw_rewards
from thorndike.environments.observation_views import as_numbers
from thorndike.errors import UserError
from thorndike.functional.descent import Optimized, descend, optimized
from thorndike.functional.normalization import Moments, moments_of
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.preference_losses import choice_loss
from thorndike.networks.network import Network
from thorndike.networks.reward_network import initial_members
from thorndike.settings import AtLeast, Between, MoreThan, check
from thorndike.statistics import wilson_interval

_ADAPTED_EVERY = 50
"""Gradient steps."""
_ADAPTED_BY = 1.5
_FEWEST = 2


@dataclass(frozen=True)
class Config:
    """Settings of a learnt reward."""

    members: Annotated[int, AtLeast(1)] = 3  # networks; they must be several to say what they do not know
    net_arch: tuple[int, ...] = (64, 64)  # hidden layers of each
    total_steps: Annotated[int, AtLeast(1)] = 1000  # gradient steps of a fit
    learning_rate: Annotated[float, MoreThan(0)] = 1e-3  # Adam's
    batch_size: Annotated[int, AtLeast(1)] = 32  # choices of a gradient step
    error_rate: Annotated[float, Between(0, 0.5)] = 0.1  # how often raters are taken to choose at random
    l2: Annotated[float, AtLeast(0)] = 1e-4  # what the weight of the sum of squared parameters begins with; 0: none, ever
    held_out_from: Annotated[float, AtLeast(1)] = 1.1  # times the training loss: below, the penalty is made smaller
    held_out_to: Annotated[float, AtLeast(1)] = 1.5  # above, it is made larger

    def __post_init__(self) -> None:
        check(self)


def config_of(settings: Mapping[str, object]) -> Config:
    """A Config with some settings. Raises ``UserError`` for what cannot be."""
    make: Callable[..., Config] = Config
    return make(**settings)


class Report(NamedTuple):
    """How well choices are met."""

    choices: int
    held_out: int
    """Choices that were no ties and that some member had not learnt from."""
    accuracy: float
    """Share of them that those members together get right."""
    accuracy_ci95: tuple[float, float]
    train_loss: tuple[float, ...]
    """Of each member."""
    held_out_loss: tuple[float, ...]
    l2: tuple[float, ...]
    """Where the weights of the penalties came to."""

    @property
    def near_chance(self) -> bool:
        """Whether guessing would explain it."""
        return self.accuracy_ci95[0] <= 0.5


class _Data(NamedTuple):
    """Clips ``[C, L, ...]`` as the networks take them, and choices between them."""

    rows: tuple[Array, Array]
    valid: Float[Array, "C L"]
    first: Int[Array, " N"]
    second: Int[Array, " N"]
    p_first: Float[Array, " N"]


class _Member(NamedTuple):
    """A member under way."""

    held: Optimized
    l2: Float[Array, ""]


class _Fitted(NamedTuple):
    """A member when it is done."""

    params: Float[Array, " P"]
    counts: Float[Array, " N"]
    """How often its bootstrap holds each choice."""
    train_loss: Float[Array, ""]
    held_out_loss: Float[Array, ""]
    l2: Float[Array, ""]


def fit_reward(
    segments: Segments, choices: Choices, spaces: tuple[gymnasium.Space, gymnasium.Space], config: Config, seed: int = 0
) -> tuple[LearnedReward, Report]:
    """The reward that these choices between these clips tell. Raises ``UserError`` for too few of them."""
    if choices.number < _FEWEST:
        raise UserError(f"{choices.number} choices are too few to learn a reward from: judge at least {_FEWEST} pairs of clips")
    blank = _normalised_inputs(segments, no_reward(spaces, config.members, config.net_arch))
    data = _data(blank, segments, choices)
    found = _fit_members(config, blank, data, jax.random.key(seed))
    if not bool(jnp.all(jnp.isfinite(found.params))):
        raise UserError(f"the reward's numbers are no longer finite: lower learning_rate, which is {config.learning_rate:g}")
    learnt = _levelled(blank._replace(params=found.params), segments, config)
    return learnt, _report(found, predicted_returns(learnt, segments, config.net_arch), choices)


@partial(jax.jit, static_argnames="config")
def _fit_members(config: Config, blank: LearnedReward, data: _Data, key: Key[Array, ""]) -> _Fitted:
    """All members, one after the other in one program: on a CPU products with an axis of members in front are slower."""
    network, obs, action = network_of(blank.observations, blank.actions, config.net_arch)
    key_members, key_fit = jax.random.split(key)
    begun = initial_members(network, obs, action, config.members, key_members)
    keys = jax.random.split(key_fit, config.members)
    found: _Fitted = jax.lax.map(lambda each: _fit_member(network, config, each[0], data, each[1]), (begun, keys))
    return found


def predicted_returns(held: LearnedReward, segments: Segments, hidden: tuple[int, ...]) -> Float[np.ndarray, "E C"]:
    """The sum of each clip's rewards by each member, on the scale on which it decides choices."""
    raw = _raw_of_steps(held, segments, hidden)
    return (raw * segments.valid[None]).sum(axis=2)


def _raw_of_steps(held: LearnedReward, segments: Segments, hidden: tuple[int, ...]) -> Float[np.ndarray, "E C L"]:
    leaves, action = tuple(_steps(leaf) for leaf in segments.obs), _steps(segments.action)
    raw = _compiled_rewards(held, leaves, action, tuple(hidden))
    return np.asarray(raw).reshape(len(raw), *segments.valid.shape)


_compiled_rewards = partial(jax.jit, static_argnames="hidden")(raw_rewards)


def _normalised_inputs(segments: Segments, blank: LearnedReward) -> LearnedReward:
    """With the moments of the clips' observations and actions."""

    def moments(x: np.ndarray, like: Moments) -> Moments:
        (numbers,) = as_numbers([jnp.asarray(_steps(x))], [like.mean.shape], leading=1)
        return moments_of(numbers, segments.valid.reshape(-1))

    observations = tuple(moments(leaf, own) for leaf, own in zip(segments.obs, blank.observations, strict=True))
    return blank._replace(observations=observations, actions=moments(segments.action, blank.actions))


def _data(blank: LearnedReward, segments: Segments, choices: Choices) -> _Data:
    clips, length = segments.valid.shape
    rows = as_rows(blank, [jnp.asarray(_steps(leaf)) for leaf in segments.obs], jnp.asarray(_steps(segments.action)))
    both = jax.tree.map(lambda x: x.reshape(clips, length, *x.shape[1:]), rows)
    return _Data(
        both, jnp.asarray(segments.valid, jnp.float32), *(jnp.asarray(x) for x in (choices.first, choices.second, choices.p_first))
    )


def _fit_member(network: Network, config: Config, begun: Float[Array, " P"], data: _Data, key: Key[Array, ""]) -> _Fitted:
    """A member's whole fit, in stretches of steps after each of which its penalty is adapted."""
    adam = optax.scale_by_adam()
    number = data.first.shape[0]
    key_boot, key_steps = jax.random.split(key)
    bootstrap = jax.random.randint(key_boot, (number,), 0, number)
    counts = jnp.zeros(number).at[bootstrap].add(1.0)
    losses = partial(_losses, network, data, counts, config.error_rate)

    def one(member: _Member, key: Key[Array, ""]) -> tuple[_Member, None]:
        chosen = bootstrap[jax.random.randint(key, (config.batch_size,), 0, number)]

        def loss(params: Float[Array, " P"]) -> Float[Array, ""]:
            first, second = (_returns(network, params, data, side[chosen]) for side in (data.first, data.second))
            fit = choice_loss(first, second, data.p_first[chosen], jnp.ones(config.batch_size), config.error_rate)
            return fit + member.l2 * jnp.sum(jnp.square(params))

        held, _ = descend(adam, config.learning_rate, member.held, jax.grad(loss)(member.held.params))
        return member._replace(held=held), None

    def stretch(member: _Member, keys: Key[Array, " K"]) -> tuple[_Member, None]:
        member, _ = jax.lax.scan(one, member, keys)
        train, held_out = losses(member.held.params)
        up, down = held_out > config.held_out_to * train, held_out < config.held_out_from * train
        return member._replace(l2=member.l2 * jnp.where(up, _ADAPTED_BY, jnp.where(down, 1.0 / _ADAPTED_BY, 1.0))), None

    stretches = max(1, config.total_steps // _ADAPTED_EVERY)
    keys = jax.random.split(key_steps, (stretches, max(1, config.total_steps // stretches)))
    member, _ = jax.lax.scan(stretch, _Member(optimized(begun, adam), jnp.float32(config.l2)), keys)
    return _Fitted(member.held.params, counts, *losses(member.held.params), member.l2)


def _returns(network: Network, params: Float[Array, " P"], data: _Data, clips: Int[Array, " M"]) -> Float[Array, " M"]:
    """The predicted returns of some clips."""
    rows, valid = jax.tree.map(lambda x: x[clips].reshape(-1, *x.shape[2:]), data.rows), data.valid[clips]
    return jnp.sum(jnp.asarray(network.apply(params, rows)).reshape(valid.shape) * valid, axis=1)


def _losses(
    network: Network, data: _Data, counts: Float[Array, " N"], error_rate: float, params: Float[Array, " P"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Of the choices that a member learns from, and of those that it does not."""
    every = _returns(network, params, data, jnp.arange(data.valid.shape[0]))
    of = partial(choice_loss, every[data.first], every[data.second], data.p_first, error_rate=error_rate)
    return of(weight=counts), of(weight=(counts == 0).astype(jnp.float32))


def _levelled(learnt: LearnedReward, segments: Segments, config: Config) -> LearnedReward:
    """With the level and the spread of each member over the steps of the clips."""
    raw, weight = jnp.asarray(_raw_of_steps(learnt, segments, config.net_arch)), jnp.asarray(segments.valid, jnp.float32)
    mean = jax.vmap(lambda own: weighted_mean(own, weight))(raw)
    level = mean if segments.all_whole else jnp.zeros_like(mean)
    square = jax.vmap(lambda own, level: weighted_mean(jnp.square(own - level), weight))(raw, level)
    return learnt._replace(level=level, spread=jnp.sqrt(jnp.maximum(square, 1e-12)))


def _report(found: _Fitted, sums: Float[np.ndarray, "E C"], choices: Choices) -> Report:
    left_out = np.asarray(found.counts) == 0
    margin = ((sums[:, choices.first] - sums[:, choices.second]) * left_out).sum(axis=0)
    judged = left_out.any(axis=0) & (choices.p_first != 0.5)
    right = ((margin > 0) == (choices.p_first > 0.5))[judged]
    number = len(right)
    return Report(
        choices=choices.number,
        held_out=number,
        accuracy=float(right.mean()) if number else 0.5,
        accuracy_ci95=wilson_interval(int(right.sum()), number) if number else (0.0, 1.0),
        train_loss=_numbers(found.train_loss),
        held_out_loss=_numbers(found.held_out_loss),
        l2=_numbers(found.l2),
    )


def _numbers(x: Array) -> tuple[float, ...]:
    return tuple(map(float, x))


def _steps(x: np.ndarray) -> np.ndarray:
    """Clips ``[C, L, ...]`` as steps ``[C * L, ...]``."""
    return x.reshape(-1, *x.shape[2:])
