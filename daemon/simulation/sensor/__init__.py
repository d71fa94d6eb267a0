"""Simulate the pressure sensor: readings, imperfections and frame arrival times."""
