"""Mechanics of the simulated hand: `simulated_hand` is the interface, `plant` the integrator.

The other modules are kernels on the records of `plant_state`: contacts, forces, equations of motion
and energy guard.
"""
