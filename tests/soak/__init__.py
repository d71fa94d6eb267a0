"""Soaks: each module a program, of which the tests run a little."""
