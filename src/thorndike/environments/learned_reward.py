"""A reward learnt from choices between clips, as a wrapper that any learner can take: it stands in place of the environment's own.

Christiano, Leike, Brown, Martic, Legg and Amodei 2017, "Deep Reinforcement Learning from Human Preferences" (arXiv:1706.03741), section
2.2. The wrapper comes first, nearest the environment: it looks at the observation that was acted on and the action as the environment has
them, so that it means the same whatever wrappers follow. Episode returns and evaluation are of the environment's own reward.

What was learnt are the wrapper's statistics. It is put there when a run begins (``api/learned_rewards.py``), is saved in checkpoints and
goes with the policy; the settings only say how large it is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, Shaped

from thorndike.environments.observation_views import as_numbers, joined, numbers_shape, shown_leaves, space_leaves
from thorndike.environments.wrappers import learn_nothing
from thorndike.errors import UserError
from thorndike.functional.normalization import Moments, empty_moments, normalize
from thorndike.networks.masking import without_mask
from thorndike.networks.network import Network
from thorndike.networks.reward_network import number_of_parameters, reward_network
from thorndike.types import Action, EnvSpec, Observation, Step, Wrapper

NAME = "learned_reward"


class LearnedReward(NamedTuple):
    """An ensemble of E networks; the reward is the mean of what they say, each brought to the same level and spread first."""

    params: Float[Array, "E P"]
    observations: tuple[Moments, ...]
    """Of every leaf of the observation: it is normalised by them."""
    actions: Moments
    level: Float[Array, " E"]
    spread: Float[Array, " E"]


def no_reward(spaces: tuple[gymnasium.Space, gymnasium.Space], members: int, hidden: Sequence[int]) -> LearnedReward:
    """One for these spaces, of observations and actions, that has learnt nothing: 0 for every step."""
    observation_space, action_space = spaces
    moments = tuple(empty_moments(numbers_shape(leaf)) for leaf in space_leaves(without_mask(observation_space)))
    actions = empty_moments(numbers_shape(action_space))
    length = number_of_parameters(*network_of(moments, actions, hidden))
    return LearnedReward(jnp.zeros((members, length), jnp.float32), moments, actions, jnp.zeros(members), jnp.ones(members))


def network_of(observations: tuple[Moments, ...], actions: Moments, hidden: Sequence[int]) -> tuple[Network, Array, Array]:
    """The network of each member, and an example of the rows that it takes."""
    obs, action = joined(tuple(own.mean[None] for own in observations)), joined((actions.mean[None],))
    return reward_network(obs, action, hidden), obs, action


def as_rows(
    held: LearnedReward, leaves: Sequence[Shaped[Array, "N ..."]], action: Shaped[Array, "N ..."]
) -> tuple[Float[Array, "N ..."], Float[Array, "N A"]]:
    """What the networks take, of observations (their leaves) and actions in the environment's units."""
    numbers = as_numbers(leaves, [own.mean.shape for own in held.observations], leading=1)
    seen = joined(tuple(normalize(row, own) for row, own in zip(numbers, held.observations, strict=True)))
    (act,) = as_numbers([jnp.asarray(action)], [held.actions.mean.shape], leading=1)
    return seen, joined((normalize(act, held.actions),))


def raw_rewards(
    held: LearnedReward, leaves: Sequence[Shaped[Array, "N ..."]], action: Shaped[Array, "N ..."], hidden: Sequence[int]
) -> Float[Array, "E N"]:
    """What each member says, on the scale on which sums decide choices."""
    network, _, _ = network_of(held.observations, held.actions, hidden)
    rows = as_rows(held, leaves, action)
    return jnp.asarray(jax.vmap(lambda own: network.apply(own, rows))(held.params))


def learned_reward(members: int = 3, net_arch: Sequence[int] = (64, 64)) -> Wrapper:
    """The reward of each step is what an ensemble of ``members`` networks has learnt that it is worth; of dead rows 0.

    Raises UserError for a size that cannot be.
    """
    hidden = tuple(int(width) for width in net_arch)
    if members < 1 or not hidden or min(hidden) < 1:
        raise UserError(f"learned_reward needs at least one member and one layer, each at least 1 wide, not {members} and {list(net_arch)}")

    def statistics(env_spec: EnvSpec) -> LearnedReward:
        return no_reward((env_spec.observation_space, env_spec.action_space), members, hidden)

    def step(held: LearnedReward, memory: PyTree, obs: Observation, action: Action, step: Step) -> tuple[PyTree, Step]:
        raw = raw_rewards(held, shown_leaves(obs), action, hidden)
        reward = jnp.mean((raw - held.level[:, None]) / held.spread[:, None], axis=0)
        return memory, step._replace(reward=jnp.where(step.valid, reward, 0.0))

    def init(held: LearnedReward, obs: Observation) -> tuple[PyTree, Observation]:
        del held
        return (), obs

    settings = {"name": NAME, "members": members, "net_arch": list(hidden)}
    return Wrapper(NAME, settings, lambda env_spec: env_spec, statistics, init, step, learn_nothing)
