"""Analyse recordings: `analyse` computes contacts from frames, and `plot` compares with the model.

Both commands use the daemon's estimator.
"""
