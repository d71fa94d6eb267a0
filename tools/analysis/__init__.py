"""Analyse recordings: `analyse` computes contacts from frames, and `plot` compares recorded
contacts with the model.

Both commands use the daemon's estimator.
"""
