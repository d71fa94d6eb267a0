"""Load profiles: validated settings from TOML files, and the models that the settings describe.

This package never communicates with the hand.
"""
