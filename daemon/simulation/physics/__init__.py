"""Simulate the mechanics of the hand.

The module `simulated_hand` is the interface, and `plant` is the integrator. The other modules
contain kernels that operate on the records in `plant_state`.
"""
