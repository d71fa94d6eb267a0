"""The shapes of the simulated object: outline, inertia, and what friction under it needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.backends import SHAPES
from softfinger.daemon.profile.settings import SimulationSettings
from softfinger.daemon.simulation.physics.plant_state import (
    DISC,
    NO_OBJECT,
    POLYGON,
    RECTANGLE,
)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """One object's outline, round its centre of mass. Lengths are m."""

    kind: int  # by plant_state's numbers
    corners: FloatArray  # (4, 2), counter-clockwise; of a disc: those of the square round it
    roundness: float  # radius of a disc, else 0
    gyration: float  # radius of gyration
    lever: float  # mean distance of its points from the centre: what spinning friction acts on

    @property
    def extent(self) -> float:
        """The farthest point's distance from the centre."""
        return self.roundness or float(np.hypot(*self.corners.T).max())

    @property
    def half_width(self) -> float:
        """Half the width at the height of the centre."""
        (left, bottom), (right, top) = self.corners.min(axis=0), self.corners.max(axis=0)
        if self.kind != POLYGON:
            return float(0.5 * (right - left))
        low, high = self.corners[1, 0], self.corners[2, 0]
        return float(low + (high - low) * -bottom / (top - bottom))

    def edges(self) -> FloatArray:
        """The four edges, float64 [4, 5]: start x, y, outward normal x, y, length."""
        way = np.roll(self.corners, -1, axis=0) - self.corners
        length = np.hypot(*way.T)
        normal = np.stack((way[:, 1], -way[:, 0]), axis=1) / length[:, None]
        return np.column_stack((self.corners, normal, length))


def shape_of(simulation: SimulationSettings) -> Shape:
    """The object of the settings, made by the function that `daemon.backends` names for it."""
    shape: Shape = SHAPES[simulation.object_shape].load()(simulation)
    return shape


def rectangle(simulation: SimulationSettings) -> Shape:
    """A box of the settings' width and height."""
    return _polygon(RECTANGLE, simulation, 0.0)


def wedge(simulation: SimulationSettings) -> Shape:
    """Faces that lean by half the taper each, with the settings' width at half the height.

    Raises ValueError where they meet; `profile.validation` finds that in profiles.
    """
    leaning = 0.5 * simulation.object_height * math.tan(0.5 * simulation.object_taper)
    width = simulation.object_width
    if 2.0 * abs(leaning) >= width:
        raise ValueError(
            f"a wedge's faces meet: found simulation.object_width {width:g} m, expected above "
            f"{2.0 * abs(leaning):.3g} m at its object_taper and object_height"
        )
    return _polygon(POLYGON, simulation, leaning)


def disc(simulation: SimulationSettings) -> Shape:
    """A disc of the settings' radius."""
    radius = simulation.object_radius
    square = _trapezoid(radius, radius, radius)
    return Shape(DISC, square, radius, radius * math.sqrt(0.5), radius * 2.0 / 3.0)


def nothing(simulation: SimulationSettings) -> Shape:
    """No object; its outline is the rectangle's."""
    return _polygon(NO_OBJECT, simulation, 0.0)


def _polygon(kind: int, simulation: SimulationSettings, leaning: float) -> Shape:
    half, height = 0.5 * simulation.object_width, simulation.object_height
    corners = _trapezoid(half + leaning, half - leaning, 0.5 * height)
    lever, squared = _mean_distances(corners)
    return Shape(kind, corners, 0.0, math.sqrt(squared), lever)


def _trapezoid(low: float, high: float, half_height: float) -> FloatArray:
    """Corners round the centre of mass, for half widths at the bottom and at the top."""
    centre = half_height * (high - low) / (3.0 * (low + high))
    bottom, top = -half_height - centre, half_height - centre
    return np.array([[-low, bottom], [low, bottom], [high, top], [-high, top]])


def _mean_distances(corners: FloatArray) -> tuple[float, float]:
    """Mean distance [m] and mean squared distance [m²] of a trapezoid's points from the centre."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    share = 0.5 * (nodes + 1.0)
    half = corners[1, 0] + share * (corners[2, 0] - corners[1, 0])
    y = corners[0, 1] + share * (corners[2, 1] - corners[0, 1])
    x = half[:, None] * share
    weight = weights[:, None] * weights * half[:, None]
    squared = x * x + y[:, None] ** 2
    mean = (weight * np.sqrt(squared)).sum() / weight.sum()
    return float(mean), float((weight * squared).sum() / weight.sum())
