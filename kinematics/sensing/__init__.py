"""Pressure sensor under a tip: the forward model, and counts to pressures.

Numbers alone: no files, no ports.
"""
