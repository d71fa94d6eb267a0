"""Tests within one process, without other processes, pseudo-terminals or real-time daemons."""
