"""A hexagonal nut."""

import numpy as np

from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.simulation.physics.shapes import Shape, polygon


def hexagon(simulation: SimulationSettings) -> Shape:
    """A regular hexagon that is ``object_width`` across its flats, two of them upright."""
    angle = np.radians(np.arange(-30, 330, 60))
    reach = simulation.object_width / np.sqrt(3.0)
    return polygon(reach * np.column_stack((np.cos(angle), np.sin(angle))))
