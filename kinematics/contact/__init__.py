"""Contact of one soft tip with a plane: material laws, closed forms, integrals, lookup tables.

The package covers the tip and its material. `kinematics.sensing` models the sensor under the tip.
"""
