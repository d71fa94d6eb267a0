"""Tests that start processes, pseudo-terminals or whole daemons in real time."""
