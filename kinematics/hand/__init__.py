"""Two rotational fingers and the object between them: geometry, grasp state, external loads.

Plane mechanics without time.
"""
