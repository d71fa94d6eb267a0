"""`calibrate`: its frames and steps."""
