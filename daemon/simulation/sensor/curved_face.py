"""The pressure on a grid under a soft tip from a curved face: a cylinder, as a disc has it.

The plane face's model is `sensing.pressure_grid`. The springs are the same: over each point of the
base a vertical one as long as the hemisphere is high there, pressed down to the face.

A tip that takes the face for a plane, as the estimator does, finds a narrower footprint and takes
it for a smaller d: 0.72 of the true one for R = a, 0.83 for R = 2a, θ 1 % to 12 % too small,
the more the deeper, and a gain above 1 that makes up for it in the force.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.contact.material import stress_at
from softfinger.kinematics.sensing.footprint import (
    Face,
    Grid,
    cols_touched,
    rows_touched,
    set_extremes,
    set_face,
)

FloatArray = NDArray[np.float64]

_POINTS = 4  # of a cell's side: within 5e-4 of the modulus up to d = a/5, 2e-3 near the rim


class CurvedContact(Record):
    """A cylinder's face on a grid of cells."""

    d: float  # how deep it is in the hemisphere along the normal [m]
    n_x: float  # the normal leads from the tip's centre to the axis, a − d + R away
    n_y: float
    across_x: float  # unit vector at right angles to the axis in the base's plane
    across_y: float
    curvature: float  # curvature 1/R [1/m]
    grid: Grid
    face: Face


@kernel
def render_curved(contacts: Records[CurvedContact], law: FloatArray, out: FloatArray) -> None:
    """Write the pressure [Pa] of a cylinder's face on each cell into ``out`` [rows, cols].

    ``law`` is the material's. With p the way across the axis

        z = c_z − √(R² − (p − c_p)²),    ε = 1 − z/√(a² − x² − y²)

    The mean over a cell is that of points spread evenly in it.
    """
    contact = contacts[0]
    grid = contact.grid
    face = contact.face
    a = grid.radius
    d = contact.d
    n_x = contact.n_x
    n_y = contact.n_y
    curvature = contact.curvature
    across_x = contact.across_x
    across_y = contact.across_y
    pitch_x = grid.pitch_x
    pitch_y = grid.pitch_y
    out[:] = 0.0
    if not (d > 0.0 and curvature > 0.0 and n_x * n_x + n_y * n_y < 1.0):
        return
    # The cylinder lies behind its tangent plane, so it presses on no more cells than that.
    set_face(face, a, min(d, a), n_x, n_y)
    set_extremes(face, a)
    if not face.low < face.high:
        return
    first_row, last_row = rows_touched(face, grid)
    first_col, last_col = cols_touched(face, grid)
    roundness = 1.0 / curvature
    away = a - d + roundness
    c_p = away * (n_x * across_x + n_y * across_y)
    c_z = away * math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    weight = 1.0 / (_POINTS * _POINTS)
    step_x = pitch_x / _POINTS
    step_y = pitch_y / _POINTS
    for i in range(first_row, last_row):
        y_cell = grid.y + i * pitch_y + 0.5 * step_y
        for j in range(first_col, last_col):
            x_cell = grid.x + j * pitch_x + 0.5 * step_x
            total = 0.0
            for k in range(_POINTS):
                y = y_cell + k * step_y
                rim = a * a - y * y
                for m in range(_POINTS):
                    x = x_cell + m * step_x
                    square = rim - x * x
                    if square <= 0.0:
                        continue
                    off = x * across_x + y * across_y - c_p
                    under = roundness * roundness - off * off
                    if under <= 0.0:
                        continue
                    z = max(c_z - math.sqrt(under), 0.0)
                    if z * z < square:
                        total += stress_at(law, 1.0 - z / math.sqrt(square))
            out[i, j] = weight * total
