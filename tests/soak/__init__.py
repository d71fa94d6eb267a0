"""Soak programs, one per module, which the tests run for a short time."""
