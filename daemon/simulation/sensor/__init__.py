"""Simulated pressure sensor: readings, imperfections and frame arrival times."""
