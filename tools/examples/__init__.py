"""Self-contained example programs to copy, which use the public client and kinematics."""
