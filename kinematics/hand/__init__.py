"""Model two rotational fingers and the object between them: geometry, grasp state, external loads.

The mechanics are planar. The servo temperature estimator is also in this package.
"""
