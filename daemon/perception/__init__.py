"""Perception, from tactile frames to contacts: calibration, estimate, and filter between frames."""
