"""Define the shapes of the simulated object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.daemon.backends import backend
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.simulation.physics.plant_state import CORNERS, DISC, NO_OBJECT, POLYGON

__all__ = ["Shape", "polygon"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """Outline of an object whose centre of mass is at the origin. Lengths are in m."""

    kind: int  # shape constant from plant_state
    corners: FloatArray  # corners [n, 2], counter-clockwise; a disc uses its bounding square
    roundness: float  # radius of a disc, or 0 for other shapes
    gyration: float  # radius of gyration
    mean_radius: float  # mean distance of the shape's points from the centre

    @property
    def extent(self) -> float:
        """Maximum distance of an outline point from the centre."""
        return self.roundness or float(np.hypot(*self.corners.T).max())

    @property
    def half_width(self) -> float:
        """Half of the object's width at the height of its centre."""
        x, y = np.vstack((self.corners, self.corners[:1])).T
        across = [
            x[k] - y[k] * (x[k + 1] - x[k]) / (y[k + 1] - y[k])
            for k in range(len(self.corners))
            if y[k] * y[k + 1] <= 0.0 and y[k] != y[k + 1]
        ]
        return float(0.5 * (max(across) - min(across)))

    def edges(self) -> FloatArray:
        """Return the edges [n, 5]: start point (x, y), outward normal (x, y) and length."""
        edge = np.roll(self.corners, -1, axis=0) - self.corners
        length = np.hypot(*edge.T)
        normal = np.stack((edge[:, 1], -edge[:, 0]), axis=1) / length[:, None]
        return np.column_stack((self.corners, normal, length))


def shape_of(settings: Settings) -> Shape:
    """Create the configured shape with the function that `daemon.backends` registers."""
    simulation = settings.simulation
    found = backend("shapes", simulation.object_shape)
    shape: Shape = found.load()(simulation, *found.options(settings.plugins.tables))
    return shape


def polygon(corners: ArrayLike, kind: int = POLYGON) -> Shape:
    """Create a convex polygon from 3 to 8 ``corners`` [n, 2] in m, in counter-clockwise order.

    The function shifts the corners so that the centre of mass is at the origin. The area integrals
    are closed-form sums over the triangles that the edges form with the centre. Raises ValueError
    if the outline is not a convex polygon with 3 to 8 corners.
    """
    points = np.array(corners, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not 3 <= len(points) <= CORNERS:
        raise ValueError(f"corners: found shape {points.shape}, expected 3 to {CORNERS} pairs")
    if not np.isfinite(points).all():
        raise ValueError("corners: found a number that is not finite, expected finite numbers")
    along = np.roll(points, -1, axis=0) - points
    turns = _cross(along, np.roll(along, -1, axis=0))
    whole = np.arctan2(turns, (along * np.roll(along, -1, axis=0)).sum(axis=1)).sum()
    if not ((turns > 0.0).all() and whole < 3.0 * math.pi):
        raise ValueError(
            "corners: expected the corners of a convex polygon in counter-clockwise order"
        )
    areas = _cross(points, np.roll(points, -1, axis=0))
    points -= ((points + np.roll(points, -1, axis=0)) * areas[:, None]).sum(axis=0) / (
        3.0 * areas.sum()
    )
    length = np.hypot(*along.T)
    height = _cross(points, along) / length  # distance of the centre from each edge
    begin = (points * along).sum(axis=1) / length / height
    end = begin + length / height
    area = (0.5 * height**2 * (end - begin)).sum()
    mean = (height**3 * (_secants(end) - _secants(begin))).sum() / (6.0 * area)
    squared = (height**4 * (end - begin + (end**3 - begin**3) / 3.0)).sum() / (4.0 * area)
    return Shape(kind, points, 0.0, math.sqrt(squared), float(mean))


def rectangle(simulation: SimulationSettings) -> Shape:
    """Create a box with the configured width and height."""
    return polygon(_trapezoid(simulation, 0.0))


def wedge(simulation: SimulationSettings) -> Shape:
    """Create a wedge whose faces are tilted by half the configured taper.

    The width is measured at mid-height. Raises ValueError if the faces would meet.
    """
    leaning = 0.5 * simulation.object_height * math.tan(0.5 * simulation.object_taper)
    width = simulation.object_width
    if 2.0 * abs(leaning) >= width:
        raise ValueError(
            f"simulation.object_width: found {width:g} m, expected more than "
            f"{2.0 * abs(leaning):.3g} m: with this object_taper and object_height, the faces "
            "of a narrower wedge would meet"
        )
    return polygon(_trapezoid(simulation, leaning))


def disc(simulation: SimulationSettings) -> Shape:
    """Create a disc with the configured radius."""
    radius = simulation.object_radius
    square = radius * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    return Shape(DISC, square, radius, radius * math.sqrt(0.5), radius * 2.0 / 3.0)


def nothing(simulation: SimulationSettings) -> Shape:
    """Create the rectangular placeholder for a scene without an object."""
    return polygon(_trapezoid(simulation, 0.0), NO_OBJECT)


def _trapezoid(simulation: SimulationSettings, leaning: float) -> FloatArray:
    half, height = 0.5 * simulation.object_width, 0.5 * simulation.object_height
    low, high = half + leaning, half - leaning
    return np.array([(-low, -height), (low, -height), (high, height), (-high, height)])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    product: FloatArray = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return product


def _secants(t: FloatArray) -> FloatArray:
    """Return twice the integral of sec³ from 0 to the angle whose tangent is ``t``."""
    integral: FloatArray = t * np.sqrt(1.0 + t * t) + np.arcsinh(t)
    return integral
