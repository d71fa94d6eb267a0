"""Simulated pressure sensor: readings, imperfections, and arrival times of frames."""
