"""Simulated hand: its physics, and emulated servos and tactile boards on pseudo-terminals."""
