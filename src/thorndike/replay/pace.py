"""How an off-policy learner alternates between stepping, storing and learning, in whole iterations."""

from typing import NamedTuple

from thorndike.errors import UserError


class Pace(NamedTuple):
    """What one iteration does."""

    rollout_length: int
    """Steps each environment makes."""
    gradient_steps: int
    """Updates after them."""
    ring_steps: int
    """Steps of each environment that the replay holds."""
    warmup_iterations: int
    """Iterations that only store."""


def pace(
    algorithm: str, buffer_size: int, learning_starts: int, train_freq: int, gradient_steps: int, num_envs: int, follow: int = 1
) -> Pace:
    """From the settings, which count the steps of all environments together; ``gradient_steps`` of -1 is one update an environment step.

    A sample needs ``follow`` more steps after its own. Raises ``UserError`` for 0 gradient steps or a buffer that holds no sample.
    """
    rollout_length = max(1, train_freq // num_envs)
    per_iteration = rollout_length * num_envs
    blocks = max(1, buffer_size // per_iteration)
    enough_for_a_sample = -(-(follow + 1) // rollout_length)
    if gradient_steps == 0:
        raise UserError(f"{algorithm}: gradient_steps is at least 1, or -1 for one update an environment step; got 0")
    if blocks < enough_for_a_sample:
        raise UserError(f"{algorithm}: buffer_size {buffer_size} holds fewer than the {follow + 1} steps of a sample; make it larger")
    warmup = max(enough_for_a_sample, -(-learning_starts // per_iteration))
    return Pace(rollout_length, per_iteration if gradient_steps < 0 else gradient_steps, blocks * rollout_length, warmup)
