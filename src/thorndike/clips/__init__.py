"""Clips of behaviour: recorded in pairs, chosen between by people or programs, and the reward that is learnt from the choices."""
