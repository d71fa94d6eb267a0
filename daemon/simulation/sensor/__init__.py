"""The simulated pressure sensor: what it reads, its flaws, when its frames arrive."""
