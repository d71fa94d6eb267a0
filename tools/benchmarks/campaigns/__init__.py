"""The long campaigns of ``softfinger bench campaign``: `accuracy` and `faults`, by cases as data.

Each has ``measure(trials, only) -> list[Report]`` and ``known(only) -> bool``.
"""
