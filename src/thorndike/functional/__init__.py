"""Pure maths of learning from reward: no networks, no state, every function tested against a slow NumPy loop."""
