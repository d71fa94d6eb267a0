"""Forward model of a pressure grid under a soft tip.

`SensorGrid` describes the geometry of the sensor and renders the pressure of a contact on it. Each
cell reads the pressure averaged over its area. Sensor imperfections (noise, quantisation, dead
cells) are not included.
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

_PITCH_MAX = 0.1  # m; a larger value was probably given in millimetres
_POINTS_PER_RADIUS = 150.0  # smallest number of sample points per tip radius


@dataclass(frozen=True)
class SensorGrid:
    """Grid of rows × cols pressure cells under a tip; row indices grow along y, columns along x.

    Parameters
    ----------
    rows, cols
        Number of cells along y and x.
    pitch
        Cell size [m], one number or (x, y).
    centre
        Position of the tip's centre in the sensor's axes [m], from the middle of the grid.
    rotation
        Rotation of the sensor's axes relative to the finger's [rad], counter-clockwise seen along
        +z.
    blur
        Standard deviation with which the elastomer over the cells spreads pressure [m].

    Raises
    ------
    ValueError
        If a value is out of range.
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
        """Shape of a frame, (rows, cols)."""
        return self.rows, self.cols

    def on(self, tip: Fingertip) -> Grid:
        """Return the grid as a record for kernels, with lengths from the tip's centre."""
        pitch_x, pitch_y = self.pitches
        x = -0.5 * self.cols * pitch_x - self.centre[0]
        y = -0.5 * self.rows * pitch_y - self.centre[1]
        # In the order of the record's fields; setting them one by one takes ten times as long.
        fields = (tip.radius, x, y, pitch_x, pitch_y, self.rows, self.cols)
        return Grid(np.array([fields], Grid.dtype))

    def to_sensor(self, n_x: float, n_y: float) -> tuple[float, float]:
        """Rotate vector components from the finger's axes to the sensor's axes."""
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
        """Return the pressure [Pa] of a contact, averaged over each cell.

        The error for a spring tip is at most 1e-5 of the modulus, including cells at the outline,
        1e-4 above 30° and 1e-3 where the outline almost reaches the rim. A solid tip is as accurate
        as `solid_data`, and contacts beyond its data are clamped.

        Parameters
        ----------
        tip, material
            The tip and its stress-strain law.
        d
            Displacement [m].
        tilt_x, tilt_y
            Tilts [rad] of the object's normal (sin tilt_x, sin tilt_y, …).
        gain
            Factor on all pressures.
        out
            Array to write to and return; a new one if None.

        Returns
        -------
        ndarray
            Pressures, float64 [rows, cols].

        Raises
        ------
        ValueError
            If d is not finite or exceeds the radius, or if the normal would point into the tip.
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
        """Return the images of a solid tip's modes and shear [·, cells]; see `solid_pressure`."""
        return _images(replace(self, rotation=0.0), tip)


@lru_cache(maxsize=16)  # the grids of two fingers and their shifted copies for the error budget
def _images(grid: SensorGrid, tip: Fingertip) -> FloatArray:
    return images(tip, grid.on(tip), grid.blur)


@lru_cache(maxsize=16)
def _springs(grid: SensorGrid, tip: Fingertip, material: Material) -> SpringsPressure:
    cells = grid.on(tip)
    return SpringsPressure(cells, material, grid.blur, count_for(cells, _POINTS_PER_RADIUS))


def normal(d: float, tilt_x: float, tilt_y: float, radius: float) -> tuple[float, float]:
    """Return (n_x, n_y) for tilts [rad]. Raises ValueError if d or the tilts are out of range."""
    if not (math.isfinite(d) and math.isfinite(tilt_x) and math.isfinite(tilt_y)):
        raise ValueError(f"d and tilts must be finite, got {d}, {tilt_x}, {tilt_y}")
    if d > radius:
        raise ValueError(f"d = {d} m is more than the tip's radius {radius} m")
    n_x, n_y = math.sin(tilt_x), math.sin(tilt_y)
    if abs(tilt_x) >= 0.5 * math.pi or abs(tilt_y) >= 0.5 * math.pi or n_x**2 + n_y**2 >= 1.0:
        raise ValueError(f"tilts {tilt_x}, {tilt_y} rad don't make a normal out of the tip")
    return n_x, n_y
