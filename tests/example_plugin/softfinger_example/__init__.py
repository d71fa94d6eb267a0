"""Minimal backends in a separate package."""
