"""Implement the terminal clients `monitor`, `send` and `status`."""
