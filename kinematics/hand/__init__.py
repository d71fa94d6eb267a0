"""Two rotational fingers and the object between them: geometry, grasp state, external loads.

The mechanics is planar. Servo temperatures are also estimated here.
"""
