"""Soak programs, one per module; the tests run short versions."""
