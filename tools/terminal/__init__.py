"""Terminal clients of the running daemon: `monitor`, `send` and `status`."""
