"""Perception: from tactile frames to contacts, with calibration, estimation and filtering."""
