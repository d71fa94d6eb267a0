"""Soak tests, one per module; the test suite runs short versions of them."""
