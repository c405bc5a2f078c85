"""What PPO, GRPO and RLOO are to the loop that feeds them: the texts come from outside, with their scores."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float, Key, PyTree

from thorndike.language.decoder import Params
from thorndike.language.lora import LowRank
from thorndike.language.rollouts import Distance, Rollout
from thorndike.types import Metrics


class PolicyLearner(NamedTuple):
    """A learner from rewards of whole texts."""

    init: Callable[[Key[Array, ""]], PyTree]
    """key -> State."""
    params: Callable[[PyTree], Params]
    """State -> the policy's parameters, an adapter merged into them."""
    update: Callable[[PyTree, Rollout, Distance, Float[Array, " B"], Key[Array, ""]], tuple[PyTree, Metrics]]
    """State (which is used up), texts, their distance to the reference, their scores, key -> State, metrics. One compiled program."""
    adapter: Callable[[PyTree], LowRank | None]
    """State -> the adapter that is learnt; None where all parameters are."""
    samples: int
    """Completions of each prompt, side by side in a rollout."""
