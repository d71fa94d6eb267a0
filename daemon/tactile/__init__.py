"""Provide the tactile backends for serial boards and for recordings.

`daemon.backends` maps the backend names in the settings to the backend classes.
"""
