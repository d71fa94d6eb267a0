"""One soft tip against a plane: material laws, closed forms, reference integrals, lookup tables.

The package covers the tip and its material. The sensor under the tip is in `kinematics.sensing`.
"""
