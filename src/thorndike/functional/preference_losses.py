"""Losses of learning from preferences: reward models from pairs and rankings, policies by direct preference optimisation (DPO)."""

from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from thorndike.functional.policy_losses import weighted_mean
from thorndike.types import Number

DpoLoss: TypeAlias = Literal["sigmoid", "robust", "ipo"]


def bradley_terry_loss(
    first: Float[Array, "*B"], second: Float[Array, "*B"], p_first: Float[Array, "*B"], weight: Float[Array, "*B"]
) -> Float[Array, ""]:
    """Cross-entropy of ``p_first``, the probability that the first of a pair is preferred, with ``sigmoid(first - second)``.

    Bradley and Terry 1952; a certain label is 1 or 0, a tie 0.5, a label from raters of known reliability anything between.
    """
    margin = first - second
    return -weighted_mean(p_first * jax.nn.log_sigmoid(margin) + (1.0 - p_first) * jax.nn.log_sigmoid(-margin), weight)


def choice_loss(
    first: Float[Array, "*B"], second: Float[Array, "*B"], p_first: Float[Array, "*B"], weight: Float[Array, "*B"], error_rate: Number = 0.0
) -> Float[Array, ""]:
    """Cross-entropy of choices between two clips, whose predicted rewards sum to ``first`` and ``second``.

    ``P(first) = (1 - e) sigmoid(first - second) + e / 2``: by Bradley-Terry, but in a share ``error_rate`` of cases at random.
    Christiano et al. 2017 (arXiv:1706.03741), section 2.2.3.
    """
    margin, certain, by_chance = first - second, jnp.log1p(-error_rate), jnp.log(0.5 * error_rate)
    chosen = jnp.logaddexp(certain + jax.nn.log_sigmoid(margin), by_chance)
    left = jnp.logaddexp(certain + jax.nn.log_sigmoid(-margin), by_chance)
    return -weighted_mean(p_first * chosen + (1.0 - p_first) * left, weight)


def centring_penalty(first: Float[Array, "*B"], second: Float[Array, "*B"], weight: Float[Array, "*B"]) -> Float[Array, ""]:
    """Mean of ``(r_first + r_second)^2``: preferences say nothing of the rewards' level, this draws it to 0. Eisenstein et al. 2023."""
    return weighted_mean(jnp.square(first + second), weight)


def plackett_luce_loss(scores: Float[Array, "B K"], valid: Bool[Array, "B K"], weight: Float[Array, " B"]) -> Float[Array, ""]:
    """Negative log-likelihood of rankings, best first: each is chosen among itself and those after it. Plackett 1975; Luce 1959.

    ``valid``: rankings of fewer than K are filled up at the end. With two it is the Bradley-Terry loss of a certain label.
    """
    shown = jnp.where(valid, scores, -jnp.inf)
    remaining = jax.lax.cumlogsumexp(shown, axis=1, reverse=True)
    chosen = jnp.where(valid, scores - jnp.where(valid, remaining, 0.0), 0.0)
    return -weighted_mean(jnp.sum(chosen, axis=1), weight)


def ranked_pairs(valid: Bool[Array, "B K"]) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"], Float[Array, "B pairs"]]:
    """All ``K (K - 1) / 2`` pairs of rankings, best first: the better ones' places, the others', and weights that sum to 1 a ranking.

    They stay one batch element, as Ouyang et al. 2022 (arXiv:2203.02155), section 3.5, found: apart they over-fit in one epoch.
    """
    better, worse = jnp.triu_indices(valid.shape[1], k=1)
    both = (valid[:, better] & valid[:, worse]).astype(jnp.float32)
    return better, worse, both / jnp.maximum(jnp.sum(both, axis=1, keepdims=True), 1.0)


def dpo_loss(
    margin: Float[Array, "*B"], weight: Float[Array, "*B"], beta: Number, kind: DpoLoss = "sigmoid", label_smoothing: Number = 0.0
) -> Float[Array, ""]:
    """The loss of a margin: ``log pi(chosen) / pi_ref(chosen) - log pi(rejected) / pi_ref(rejected)``, sums over the tokens.

    ``sigmoid``: Rafailov et al. 2023 (arXiv:2305.18290), eq. 7; with ``label_smoothing`` e, the share of wrong labels, it is cDPO (Mitchell
    2023). ``robust`` divides out what e does on average (Chowdhury et al. 2024, arXiv:2403.00409). ``ipo``: the squared distance of the
    margin to ``1 / (2 beta)`` (Azar et al. 2023, arXiv:2310.12036, eq. 17), which takes no label smoothing.
    """
    if kind == "ipo":
        return weighted_mean(jnp.square(margin - 0.5 / beta), weight)
    right, wrong = -jax.nn.log_sigmoid(beta * margin), -jax.nn.log_sigmoid(-beta * margin)
    if kind == "robust":
        return weighted_mean(((1.0 - label_smoothing) * right - label_smoothing * wrong) / (1.0 - 2.0 * label_smoothing), weight)
    return weighted_mean((1.0 - label_smoothing) * right + label_smoothing * wrong, weight)
