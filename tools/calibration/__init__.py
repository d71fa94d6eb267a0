"""Frames, steps and pictures of `softfinger calibrate`."""
