"""The simulated hand's mechanics: `simulated_hand` is its face, `plant` its integrator.

The rest are kernels on the records of `plant_state`: contacts, forces, equations, energy guard.
"""
