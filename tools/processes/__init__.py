"""Processes beside the daemon: monitor, recorder, kernel compilation, log of events."""
