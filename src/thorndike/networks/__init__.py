"""Networks as ``init``/``apply`` pairs. Flax Linen is used here and nowhere else."""
