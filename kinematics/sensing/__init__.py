"""Forward model of the pressure sensor under a tip.

The modules operate on arrays only and do not access files or ports.
"""
