"""Perception: calibrate tactile frames, estimate contacts and filter them."""
