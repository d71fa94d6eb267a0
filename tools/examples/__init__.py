"""Self-contained example programs for users to copy; they use the public client and kinematics."""
