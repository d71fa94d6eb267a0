"""Daemon: all code that depends on time, hardware or the network."""
