"""Frames and pictures of `softfinger calibrate`."""
