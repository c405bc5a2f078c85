"""What a network learns beside policy and value where squares decide a game: whose each will be, and how many more (heads of the network).

Wu 2019, "Accelerating Self-Play Learning in Go" (arXiv:1902.10565), section 4.1: how a game ends on each square says far more than who has
won it. No search asks these heads; what they teach the tower is their use.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int8

from thorndike.errors import UserError
from thorndike.functional.policy_losses import weighted_mean
from thorndike.games.game import Game, Symmetry
from thorndike.games.packing import packing
from thorndike.networks.board import OWNERSHIP, SCORE, BoardHeads
from thorndike.networks.masking import POSITION
from thorndike.replay.self_play import Ending
from thorndike.types import Metrics, Rollout


class HeadWeights(NamedTuple):
    """Of the losses; a network has no head for a weight of 0."""

    ownership: float = 0.0
    score: float = 0.0

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads that a network has, by name."""
        return tuple(name for name, weight in ((OWNERSHIP, self.ownership), (SCORE, self.score)) if weight > 0)


NO_HEADS = HeadWeights()


class HeadTargets(NamedTuple):
    """What the heads are to say of positions ``[M]``."""

    ownership: Float[Array, "M H W"]
    """1 where a square will be the mover's, -1 the other's, 0 nobody's."""
    score: Float[Array, " M"]
    """By how many squares the mover wins, compensation included."""
    weight: Float[Array, " M"]
    """0 of games that were resigned, are not over, or were decided by something else."""


def check_heads(game: Game, weights: HeadWeights) -> None:
    """Raises ``UserError`` for heads in a game that does not say whose its squares are, or not of the squares that players see."""
    if not weights.heads:
        return
    if game.ownership is None:
        raise UserError(
            f"{game.id} is not decided by whose its squares are (go_9x9 and othello are): leave ownership_coef and score_coef at 0"
        )
    begun = jax.eval_shape(game.init, jax.random.key(0))
    said, seen = jax.eval_shape(game.ownership, begun).shape, game.observation_shape[:2]
    if said != seen:
        raise UserError(f"ownership of {game.id} has the shape {said}, but its observation is {seen[0]} by {seen[1]}: give it that shape")


def endings_of(game: Game, rollout: Rollout) -> Ending:
    """How the board looks after each move of a rollout, for the ring; of use where a game ended. Where it lies there is not known yet."""
    unpack, said = packing(game).unpack, game.ownership
    if said is None:
        raise UserError(f"{game.id} does not say whose its squares are")

    def ending(numbers: Array) -> tuple[Array, Array]:
        position = unpack(numbers)
        owner = said(position)
        # In Go a position may come again, which ends the game against whoever repeated it, whatever the squares say.
        decided = jnp.sign(jnp.sum(owner) - game.komi) == game.rewards(position)[0]
        return owner.astype(jnp.int8), decided & game.terminated(position)

    owner, counts = jax.vmap(jax.vmap(ending))(rollout.step.next_obs[POSITION])
    resigned = rollout.action >= game.num_actions
    return Ending(owner, counts & ~resigned, jnp.zeros(resigned.shape, jnp.int32))


def head_targets(game: Game, player: Int8[Array, " M"], ending: Ending) -> HeadTargets:
    """Endings of the games of sampled rows, as ``player``, who was to move in them, sees them."""
    sign = jnp.where(player == 0, 1.0, -1.0)
    ownership = sign[:, None, None] * ending.owner
    return HeadTargets(ownership, jnp.sum(ownership, axis=(1, 2)) - sign * game.komi, ending.counts.astype(jnp.float32))


def turned(targets: HeadTargets, part: slice, symmetry: Symmetry) -> HeadTargets:
    """Some of the rows as their boards are turned."""
    one = jax.vmap(lambda squares: symmetry.observation(squares[..., None])[..., 0])
    return targets._replace(ownership=targets.ownership.at[part].set(one(targets.ownership[part])))


def head_losses(said: BoardHeads, targets: HeadTargets, weights: HeadWeights) -> tuple[Float[Array, ""], Metrics]:
    """Cross-entropy of the squares, the mean over them, and Huber's loss of the score in units of the square root of their number."""
    loss, metrics = jnp.zeros(()), {}
    if said.ownership is not None:
        squares = optax.sigmoid_binary_cross_entropy(said.ownership, 0.5 * (targets.ownership + 1.0))
        metrics["train/ownership_loss"] = weighted_mean(jnp.mean(squares, axis=(1, 2)), targets.weight)
        loss += weights.ownership * metrics["train/ownership_loss"]
    if said.score is not None:
        side = math.sqrt(math.prod(targets.ownership.shape[1:]))
        metrics["train/score_loss"] = weighted_mean(optax.huber_loss(said.score, targets.score / side), targets.weight)
        loss += weights.score * metrics["train/score_loss"]
    return loss, metrics
