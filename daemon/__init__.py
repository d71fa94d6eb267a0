"""Daemon and other code that depends on time, hardware or the network."""
