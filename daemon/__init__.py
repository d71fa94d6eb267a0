"""The daemon: everything that touches time or the world."""
