"""The five MinAtar games, compiled: equal to the package minatar 1.0.15 step by step."""
