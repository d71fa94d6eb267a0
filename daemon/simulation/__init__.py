"""Simulate the hand's physics, and emulate its servos and tactile boards on pseudo-terminals."""
