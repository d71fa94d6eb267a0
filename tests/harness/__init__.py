"""Helpers shared by tests: hands, servo buses, daemons and terminals."""
