"""Analyse recordings: `analyse` computes contacts, and `plot` compares them with the model.

Both commands use the daemon's estimator.
"""
