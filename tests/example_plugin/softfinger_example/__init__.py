"""Minimal backends in a package of their own."""
