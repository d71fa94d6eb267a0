"""Tactile sensors: the interface of every backend, boards on serial ports, recordings.

Which name in the settings is which backend stands in `daemon.backends`.
"""
