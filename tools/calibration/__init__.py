"""Implement the `calibrate` command, including frame acquisition and plots."""
