"""Implement the daemon's terminal clients: `monitor`, `send` and `status`."""
