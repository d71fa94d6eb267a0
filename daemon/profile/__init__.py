"""Profiles: TOML files to checked settings, and settings to the models they describe.

Nothing here acts on the hand.
"""
