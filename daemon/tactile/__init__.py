"""Tactile sensors: the interface of every backend, boards on serial ports, recordings, simulation.

Which name in the settings is which backend stands in `daemon.backends`.
"""
