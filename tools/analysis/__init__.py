"""Analyse recordings: `analyse` computes contacts, and `plot` compares recordings with the model.

Both commands use the daemon's estimator.
"""
