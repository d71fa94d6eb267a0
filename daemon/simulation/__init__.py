"""Simulated hand: physics, and emulated servos and tactile boards on ptys."""
