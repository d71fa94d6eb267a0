"""The forward model: what a pressure grid of given cells under a soft tip would read.

Holds the sensor's geometry (`SensorGrid`) and the rendering of a contact on it. Every cell reads
the pressure averaged over its area; sensor imperfections (noise, counts, dead cells) are not here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.footprint import FloatArray, Grid
from softfinger.kinematics.sensing.solid_pressure import SolidPressure, images
from softfinger.kinematics.sensing.springs_pressure import SpringsPressure, count_for

_PITCH_MAX = 0.1  # m; a greater one is in millimetres
_FINE = 150.0  # points of the forward model to the tip's radius, or more


@dataclass(frozen=True)
class SensorGrid:
    """Rows × cols cells of a pressure sensor under a tip; rows run along y, columns along x.

    ``pitch`` [m] is one number or (x, y). ``centre`` [m] is the tip's centre in the sensor's axes,
    counted from the middle of the grid. ``rotation`` [rad] turns the sensor's axes against the
    finger's, counter-clockwise seen along +z. ``blur`` [m] is the standard deviation with which
    the elastomer over the cells spreads a point's pressure. Raises ValueError for values that make
    no grid.
    """

    rows: int
    cols: int
    pitch: float | tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    blur: float = 0.0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1:
            raise ValueError(f"a grid needs rows and columns, got {self.rows} × {self.cols}")
        if not all(0.0 < p <= _PITCH_MAX for p in self.pitches):
            raise ValueError(f"pitch must be in metres, up to {_PITCH_MAX:g}, got {self.pitch}")
        if not all(math.isfinite(c) for c in (*self.centre, self.rotation)):
            raise ValueError("centre and rotation must be finite")
        if (
            not 0.0
            <= self.blur
            <= 0.5 * min(self.rows * self.pitches[1], self.cols * self.pitches[0])
        ):
            raise ValueError(f"blur must be 0 to half the grid's shorter side, got {self.blur}")

    @property
    def pitches(self) -> tuple[float, float]:
        """Cell size (x, y) [m]."""
        if isinstance(self.pitch, tuple):
            return self.pitch
        return self.pitch, self.pitch

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    def on(self, tip: Fingertip) -> Grid:
        """Return the cells as kernels take them, counted from this tip's centre."""
        pitch_x, pitch_y = self.pitches
        x = -0.5 * self.cols * pitch_x - self.centre[0]
        y = -0.5 * self.rows * pitch_y - self.centre[1]
        # In the order of the fields; at once, as setting each takes ten times as long.
        fields = (tip.radius, x, y, pitch_x, pitch_y, self.rows, self.cols)
        return Grid(np.array([fields], Grid.dtype))

    def to_sensor(self, n_x: float, n_y: float) -> tuple[float, float]:
        """Rotate a vector's components from the finger's axes to the sensor's."""
        if self.rotation == 0.0:
            return n_x, n_y
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return c * n_x + s * n_y, c * n_y - s * n_x

    def pressure(
        self,
        tip: Fingertip,
        material: Material,
        d: float,
        tilt_x: float = 0.0,
        tilt_y: float = 0.0,
        gain: float = 1.0,
        out: FloatArray | None = None,
    ) -> FloatArray:
        """Return the pressure [Pa] averaged over each cell, float64 [rows, cols].

        ``d`` [m] is the displacement, the tilts [rad] give the object's normal
        (sin tilt_x, sin tilt_y, …). Accurate to 1e-5 of the modulus, cut cells included, to 1e-4
        from 30° on and 1e-3 where the outline all but meets the rim. A solid tip's is as exact as
        `solid_data` say, and ends where they do. ``out`` is written and returned if given. Raises
        ValueError for a d that is not finite or exceeds the radius, and for tilts whose normal
        would point into the tip.
        """
        n_x, n_y = normal(d, tilt_x, tilt_y, tip.radius)
        if out is None:
            out = np.empty(self.shape)
        elif out.shape != self.shape or out.dtype != np.float64 or not out.flags.c_contiguous:
            raise ValueError(f"out must be a contiguous float64 array of shape {self.shape}")
        contact = (d, *self.to_sensor(n_x, n_y))
        if tip.physics == "solid":
            SolidPressure(tip, material, self.images(tip))(contact, gain, out)
        else:
            _springs(replace(self, rotation=0.0), tip, material)(contact, gain, out)
        return out

    def images(self, tip: Fingertip) -> FloatArray:
        """Return cells' means of a solid tip's modes and shear [·, cells], see `solid_pressure`."""
        return _images(replace(self, rotation=0.0), tip)


@lru_cache(maxsize=16)  # two fingers' grids, and those that an uncertain place makes of them
def _images(grid: SensorGrid, tip: Fingertip) -> FloatArray:
    return images(tip, grid.on(tip), grid.blur)


@lru_cache(maxsize=16)
def _springs(grid: SensorGrid, tip: Fingertip, material: Material) -> SpringsPressure:
    cells = grid.on(tip)
    return SpringsPressure(cells, material, grid.blur, count_for(cells, _FINE))


def normal(d: float, tilt_x: float, tilt_y: float, radius: float) -> tuple[float, float]:
    """Return (n_x, n_y) of tilts [rad]. Raises ValueError for tilts of no contact."""
    if not (math.isfinite(d) and math.isfinite(tilt_x) and math.isfinite(tilt_y)):
        raise ValueError(f"d and tilts must be finite, got {d}, {tilt_x}, {tilt_y}")
    if d > radius:
        raise ValueError(f"d = {d} m is more than the tip's radius {radius} m")
    n_x, n_y = math.sin(tilt_x), math.sin(tilt_y)
    if abs(tilt_x) >= 0.5 * math.pi or abs(tilt_y) >= 0.5 * math.pi or n_x**2 + n_y**2 >= 1.0:
        raise ValueError(f"tilts {tilt_x}, {tilt_y} rad don't make a normal out of the tip")
    return n_x, n_y
