"""The simulated hand's mechanics: contacts, object, joints, solver. Kernels on the plant's
state."""
