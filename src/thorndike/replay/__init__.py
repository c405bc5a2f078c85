"""Replay memories: pure functions over one pytree that lives in the learner's state."""
