"""Backends of another package, as small as they can be."""
