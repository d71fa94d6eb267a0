"""Implement ``softfinger bench``; each measurement has its own module.

Several measurements share the modules `measuring` and `rigs`.
"""
