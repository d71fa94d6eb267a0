"""The simulated pressure sensor: what it reads of a contact, its flaws, when its frames arrive."""
