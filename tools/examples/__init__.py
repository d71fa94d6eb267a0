"""Example programs to copy; each is self-contained and uses the public client and kinematics."""
