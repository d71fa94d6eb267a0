"""Tactile backends: their common interface, boards on serial ports, and recordings.

`daemon.backends` maps the names in the settings to them.
"""
