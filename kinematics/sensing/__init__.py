"""What a pressure sensor under a tip reads: the forward model, and counts to pressures.

Numbers alone: no files, no ports.
"""
