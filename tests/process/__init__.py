"""Tests with processes, pseudo-terminals or daemons in real time."""
