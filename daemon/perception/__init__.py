"""Calibrate tactile frames, estimate the contacts and filter the estimates."""
