"""The geometry of a contact's footprint on the picture of a tactile frame.

A picture's coordinates are cells: x along the columns, y along the rows, from the corner of the
first cell. The footprint of displacement d and outward normal n, in the sensor's axes, is an
ellipse with centre h·(n_x, n_y), h = a − d, semi-axes ρ n_z along the tilt and ρ across it,
ρ² = 2ad − d²; the centroid of pressure stands at (a − d/3)·(n_x, n_y), free of the material only
where the modulus is constant (of a measured law it is a close estimate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.terminal.feed import number

FloatArray = NDArray[np.float64]

_TURN = np.linspace(0.0, 2.0 * np.pi, 61)


@dataclass(frozen=True)
class Footprint:
    """A contact on the picture of a frame. ``outline`` [n, 2] is closed, ``centroid`` is [2]."""

    outline: FloatArray
    centroid: FloatArray


def grid_of(frame: dict[str, Any]) -> SensorGrid | None:
    """The grid of a ``hand/tactile``, None where its fields make none."""
    rows, cols = frame.get("rows"), frame.get("cols")
    pitch = number(frame, "pitch")
    if type(rows) is not int or type(cols) is not int:
        return None
    more = [number(frame, key) for key in ("pitch_y", "centre_x", "centre_y", "rotation")]
    pitch_y, x, y, rotation = (value if math.isfinite(value) else 0.0 for value in more)
    try:
        return SensorGrid(rows, cols, (pitch, pitch_y or pitch), (x, y), rotation)
    except ValueError:
        return None


def footprint(
    grid: SensorGrid, radius: float, d: float, tilt_x: float, tilt_y: float
) -> Footprint | None:
    """The footprint of a contact on ``grid``'s picture; None for numbers of no contact.

    ``radius`` and ``d`` [m], tilts [rad] in the finger's axes.
    """
    if not 0.0 < d < radius or not math.isfinite(tilt_x) or not math.isfinite(tilt_y):
        return None
    n_x, n_y = grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
    sine = math.hypot(n_x, n_y)
    if sine >= 1.0:
        return None
    along_x, along_y = (n_x / sine, n_y / sine) if sine > 0.0 else (1.0, 0.0)
    across = math.sqrt(2.0 * radius * d - d * d)
    along = across * math.sqrt(1.0 - sine * sine)
    u, v = along * np.cos(_TURN), across * np.sin(_TURN)
    depth = radius - d
    x = depth * n_x + u * along_x - v * along_y
    y = depth * n_y + u * along_y + v * along_x
    arm = radius - d / 3.0
    centroid = on_picture(grid, np.array([[arm * n_x, arm * n_y]]))[0]
    return Footprint(on_picture(grid, np.column_stack((x, y))), centroid)


def tip_circle(grid: SensorGrid, radius: float) -> FloatArray:
    """The tip's rim on the picture, [n, 2]."""
    return on_picture(grid, radius * np.column_stack((np.cos(_TURN), np.sin(_TURN))))


def on_picture(grid: SensorGrid, points: FloatArray) -> FloatArray:
    """Points [n, 2] m in the sensor's axes, from the tip's centre → cells on the picture."""
    middle = np.array([0.5 * grid.cols, 0.5 * grid.rows])
    cells: FloatArray = (points + np.array(grid.centre)) / np.array(grid.pitches) + middle
    return cells
