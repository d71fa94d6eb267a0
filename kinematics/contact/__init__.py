"""One soft tip against a plane: material laws, closed forms, reference integrals, lookup tables.

What a tip and its material do belongs here; what a sensor under the tip reads of it doesn't.
"""
