"""The simulated hand: its physics, and its servos and tactile boards as bytes on ptys."""
