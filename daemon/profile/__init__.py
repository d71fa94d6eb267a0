"""Profiles: validated settings from TOML files, and the models that the settings describe.

This package does not act on the hand.
"""
