"""Simulate the hand's mechanics: `simulated_hand` is the interface, `plant` is the integrator.

The other modules contain kernels on the `plant_state` records: contacts, forces, equations of
motion and energy guard.
"""
