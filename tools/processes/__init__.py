"""Implement `run`, `emulate` and `compile`, their child processes and the event log."""
