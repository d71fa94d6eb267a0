"""`calibrate`: its frames, steps and pictures."""
