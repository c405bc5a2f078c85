"""Environments: compiled ones in ``native/``, host ones in ``host/``, and probes that tell whether a learner is right."""
