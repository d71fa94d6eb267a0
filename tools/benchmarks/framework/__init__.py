"""What all measurements share: tables of rows, times in turns, seeded trials, rigs, the picture.

Nothing here knows a single measurement.
"""
