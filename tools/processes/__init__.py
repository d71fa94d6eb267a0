"""Implement the `run`, `emulate` and `compile` commands, child processes and the event log."""
