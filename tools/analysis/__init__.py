"""Analysis of recordings: `analyse` computes contacts from frames, `plot` compares with the model.

Both use the daemon's estimator.
"""
