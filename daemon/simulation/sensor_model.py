"""The simulated pressure sensor: a contact → the counts that a board would send.

Holds the sensor's imperfections (noise, quantisation, saturation, gain spread, dead cells) round
the forward model, and no time: hysteresis, drift, delay and lost frames are not here. Seeded: the
same calls give the same counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinematics.contact import Fingertip
from kinematics.kernels import kernel
from kinematics.material import Material
from kinematics.pressure import SensorGrid, render, render_scratch

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel
def sense(
    geometry: tuple[float, float, float, float, float],
    law: FloatArray,
    contact: tuple[float, float, float],
    sensitivity: FloatArray,
    normals: FloatArray,
    noise: float,
    full: int,
    pressure: FloatArray,
    scratch: tuple[FloatArray, IntArray, FloatArray],
    out: NDArray[np.uint16],
) -> None:
    """Render ``contact`` (d, n_x, n_y in the sensor's axes) and write its counts into ``out``.

    All arrays are [rows, cols]. ``sensitivity`` is counts a Pa of each cell, 0 for a dead one;
    ``normals`` are standard normal numbers, ``noise`` counts a unit of them; counts are rounded to
    the nearest and end at 0 and ``full``. ``pressure`` and
    ``scratch`` are scratch.
    """
    d, n_x, n_y = contact
    render(geometry, law, 1.0, d, n_x, n_y, scratch, pressure)
    rows, cols = out.shape
    for i in range(rows):
        for j in range(cols):
            gain = sensitivity[i, j]
            value = pressure[i, j] * gain + noise * normals[i, j]
            value = value if gain > 0.0 else 0.0
            value = min(max(value + 0.5, 0.0), full + 0.5)
            out[i, j] = np.uint16(value)


class SensorModel:
    """A pressure sensor under one simulated tip.

    ``noise`` [Pa] is a cell's standard deviation, ``gain_spread`` that of the cells' sensitivities
    round 1, ``dead`` the cells (row, col) that always read 0, ``bits`` the converter's, and
    ``threshold`` the smallest count that is sent: below it goes 0. Two models of equal arguments
    give equal frames. Raises ValueError for arguments out of their range.
    """

    def __init__(
        self,
        grid: SensorGrid,
        tip: Fingertip,
        material: Material,
        pascal_per_count: float,
        *,
        noise: float = 0.0,
        seed: int | Sequence[int] = 0,
        bits: int = 16,
        gain: float = 1.0,
        gain_spread: float = 0.0,
        dead: Sequence[tuple[int, int]] = (),
        threshold: int = 0,
    ) -> None:
        if not 1 <= bits <= 16:
            raise ValueError(f"bits must be 1 … 16, got {bits}")
        for name, value in (("pascal_per_count", pascal_per_count), ("gain", gain)):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive, got {value}")
        for name, value in (("noise", noise), ("gain_spread", gain_spread)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must not be negative, got {value}")
        self.grid = grid
        self._geometry = grid.geometry(tip)
        self._law = material.law
        self._generator = np.random.Generator(np.random.SFC64(seed))
        self._noise = noise / pascal_per_count
        self._full = 2**bits - 1
        self._threshold = threshold
        spread = self._generator.standard_normal(grid.shape)
        self._sensitivity = gain * np.maximum(1.0 + gain_spread * spread, 0.0) / pascal_per_count
        for row, col in dead:
            self._sensitivity[row, col] = 0.0
        self._normals = np.zeros(grid.shape)
        self._pressure = np.zeros(grid.shape)
        self._scratch = render_scratch(grid)

    @property
    def live(self) -> NDArray[np.bool_]:
        """Cells that read anything, bool [rows, cols]."""
        return self._sensitivity > 0.0

    def frame(self, d: float, tilt_x: float, tilt_y: float, out: NDArray[np.uint16]) -> None:
        """Write the next frame's counts into ``out``, uint16 [rows, cols] contiguous.

        ``d`` [m] ≤ 0 is no contact; tilts [rad] as for :meth:`SensorGrid.pressure`.
        """
        n_x, n_y = self.grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
        if self._noise > 0.0:
            self._generator.standard_normal(out=self._normals)
        sense(
            self._geometry,
            self._law,
            (float(d), n_x, n_y),
            self._sensitivity,
            self._normals,
            self._noise,
            self._full,
            self._pressure,
            self._scratch,
            out,
        )
        if self._threshold > 0:
            out[out < self._threshold] = 0
