"""Forward model of the pressure sensor under a tip.

The modules compute with arrays only and use no files or ports.
"""
