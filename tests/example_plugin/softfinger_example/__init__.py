"""Provide minimal backends as a separate package."""
