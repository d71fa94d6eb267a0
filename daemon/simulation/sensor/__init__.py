"""Simulate the readings, imperfections and frame delays of the pressure sensor."""
