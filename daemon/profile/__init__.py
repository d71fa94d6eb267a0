"""Load validated settings from TOML profiles, and create the models that the settings describe.

This package never communicates with the hand.
"""
