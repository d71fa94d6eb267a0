"""Tactile backends: common interface, boards on serial ports, and recordings.

`daemon.backends` maps the backend names in the settings to the backend classes.
"""
