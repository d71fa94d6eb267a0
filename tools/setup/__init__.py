"""Implement the setup commands, such as `doctor`, `scan`, `keys`, `config` and `envelope`."""
