"""Tests that run within one process, without pseudo-terminals or real-time daemons."""
