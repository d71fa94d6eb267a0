"""Processes of a hand: `run`, `emulate` and `compile`, their child processes and their log."""
