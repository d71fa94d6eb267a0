"""Tests that use processes, pseudo-terminals or real-time daemons."""
