"""Hexagonal object shape."""

import numpy as np

from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.simulation.physics.shapes import Shape, polygon


def hexagon(simulation: SimulationSettings) -> Shape:
    """Return a regular hexagon of width ``object_width`` across flats, with two vertical sides."""
    angle = np.radians(np.arange(-30, 330, 60))
    reach = simulation.object_width / np.sqrt(3.0)
    return polygon(reach * np.column_stack((np.cos(angle), np.sin(angle))))
