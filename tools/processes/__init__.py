"""Implement the commands `run`, `emulate` and `compile`, child processes and the event log."""
