"""``evaluate_offline``: what a policy is worth, from episodes that others made, and whether these can tell at all."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thorndike.api.loading import LoadedPolicy, load
from thorndike.errors import UserError
from thorndike.statistics.off_policy import (
    Estimate,
    Logged,
    bootstrapped_mean,
    bootstrapped_weighted,
    doubly_robust,
    effective_sample_size,
    padded,
    per_decision,
)
from thorndike.suggestions import did_you_mean
from thorndike.training.datasets import Dataset, read_dataset
from thorndike.training.fitted_q import FittedValues, Intended, agreement, fitted_values, intentions
from thorndike.training.policy import Policy

METHODS = ("pdis", "wis", "dr", "fqe")
"""Per-decision importance sampling, the same with weights that add up to 1, doubly robust, fitted Q evaluation."""
ENOUGH, LEAST_AGREEMENT = 10.0, 0.02
"""The effective sample size below which importance weights say nothing, and the agreement below which a fitted value is a guess."""


class OfflineEvaluation(NamedTuple):
    """What was found. Values are discounted returns from the dataset's first observations."""

    run: Path | None
    dataset: Path
    environment: str
    episodes: int
    gamma: float
    effective_episodes: float | None
    """None where the probabilities of the actions are not known."""
    agreement: float
    """How much of what the policy does the data speak of, from 0 to 1."""
    behavior: Estimate
    """The discounted return of the policy that made the data."""
    estimates: dict[str, Estimate]
    refused: dict[str, str]
    """Method -> why these data cannot support it."""


def evaluate_offline(
    run: str | Path | LoadedPolicy,
    data: str | Path | Dataset,
    *,
    methods: Sequence[str] | None = None,
    gamma: float = 0.99,
    deterministic: bool = True,
    steps: int = 10_000,
    seed: int = 0,
) -> OfflineEvaluation:
    """The discounted return of a trained policy, by every method that the data support (or by ``methods``, each of which must be).

    ``deterministic`` asks for the policy's best actions, as in evaluation. ``steps`` are minibatches of the fitted values. Raises
    ``UserError``, in one line, where the data cannot support the claim.
    """
    for name in methods or ():
        if name not in METHODS:
            raise UserError(f"there is no method '{name}'{did_you_mean(name, METHODS)}; those there are: {', '.join(METHODS)}")
    if not 0.0 <= gamma < 1.0:
        raise UserError(f"gamma is at least 0 and below 1: a time limit cuts episodes, and what lies behind it counts; got {gamma}")
    loaded = run if isinstance(run, LoadedPolicy) else load(run)
    recorded = data if isinstance(data, Dataset) else read_dataset(data)
    policy = loaded.policy
    check_spaces(policy, recorded)
    intended = intentions(policy, recorded.obs, deterministic, seed)
    agreed = agreement(recorded, intended)
    logged = _logged(recorded, intended)
    effective = None if logged is None else effective_sample_size(logged, gamma)
    refused = {name: why for name in methods or METHODS if (why := refusal(name, recorded, effective, agreed))}
    if refused and (methods is not None or len(refused) == len(METHODS)):
        raise UserError(next(iter(refused.values())))
    chosen = [name for name in methods or METHODS if name not in refused]
    fitted = fitted_values(policy, recorded, gamma, deterministic, steps, seed) if {"dr", "fqe"} & set(chosen) else None
    made = padded(recorded.reward.astype(np.float64), recorded.lengths, 0.0)
    behavior = bootstrapped_mean((made * gamma ** np.arange(made.shape[1])).sum(1), seed)
    estimates = {name: _estimate(name, recorded, logged, fitted, gamma, seed) for name in chosen}
    size, origin = len(recorded.lengths), recorded.origin.environment
    return OfflineEvaluation(loaded.run, recorded.path, origin, size, gamma, effective, agreed, behavior, estimates, refused)


def refusal(method: str, data: Dataset, effective: float | None, agreed: float) -> str | None:
    """Why a dataset cannot support a method, in one line; None if it can."""
    if method == "fqe":
        if agreed >= LEAST_AGREEMENT:
            return None
        return (
            f"{data.path} hardly holds what this policy does (agreement {agreed:.3f}, at least {LEAST_AGREEMENT} is needed): "
            "record more of it, or with a share of random actions"
        )
    if effective is None:
        return f"{data.path} does not hold the probabilities of its actions, which {method} needs: ask for fqe alone, --methods fqe"
    if effective >= ENOUGH:
        return None
    return (
        f"{len(data.lengths)} episodes of {data.path} are worth {effective:.2g} of this policy, {method} needs {ENOUGH:g}: "
        "record more, with actions nearer to its own, or take a smaller gamma, or --methods fqe"
    )


def check_spaces(policy: Policy, data: Dataset) -> None:
    """Raises ``UserError`` unless a policy and a dataset speak of the same observations and actions."""
    for what in ("observation_space", "action_space"):
        ours, theirs = getattr(policy.spec, what), getattr(data.origin, what)
        if ours != theirs:
            raise UserError(f"the policy's {what} is {ours}, that of {data.path} is {theirs}: give data of its own environment")


def _logged(data: Dataset, intended: Intended) -> Logged | None:
    """The episodes with their ratios, where the probabilities are known."""
    if data.probability is None or intended.action is not None:
        return None
    taken = np.asarray(intended.probability, np.float64)[np.arange(len(data.action)), data.action]
    steps = np.asarray(data.reward, np.float64), taken / data.probability, np.ones(len(taken))
    return Logged(*(padded(flat, data.lengths, filler) for flat, filler in zip(steps, (0.0, 1.0, 0.0), strict=True)))


def _estimate(method: str, data: Dataset, logged: Logged | None, fitted: FittedValues | None, gamma: float, seed: int) -> Estimate:
    if method == "fqe" and fitted is not None:
        return bootstrapped_mean(fitted.v[data.starts], seed)
    if logged is None:
        raise UserError(f"{data.path} does not hold the probabilities of its actions")
    if method == "pdis":
        return bootstrapped_mean(per_decision(logged, gamma), seed)
    if method == "wis" or fitted is None:
        return bootstrapped_weighted(logged, gamma, seed)
    last = data.starts + data.lengths - 1
    tail = np.where(data.terminated[last], 0.0, fitted.v_next[last])
    q, v = (padded(flat, data.lengths, 0.0) for flat in (fitted.q, fitted.v))
    return bootstrapped_mean(doubly_robust(logged, q, v, tail, gamma), seed)
