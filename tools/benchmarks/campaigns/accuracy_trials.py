"""Trials of the estimator: many frames of one contact, and the Cramér-Rao bound there.

Holds the contacts of the envelope, the bound with cells left out, and the loop that adds noise,
counts as a board would, and estimates by the calls that the daemon makes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.sensor.sensor_model import Board
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimate, ContactEstimator, Readings
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

FloatArray = NDArray[np.float64]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LINEAR = Material.constant(MODULUS)
SIZE = 44
PITCH = 0.058 / SIZE
NOISES = tuple(share * MODULUS for share in (0.001, 0.002, 0.005, 0.01, 0.02))  # Pa, of a cell

# Columns of a trial's frames.
D, TILT_X, TILT_Y, GAIN, CONTACT, VALID, CHI2, CELLS = range(8)
COVARIANCE = 8
COLUMNS = COVARIANCE + 16

_SMALL = 0.03  # σ_d over d: up to here the bound is small
_MARGIN = math.radians(3.0)  # short of the rim
_GOLDEN = 0.6180339887498949
_SILVER = 0.7548776662466927  # with its square: points that fill a square evenly
_STEPS = (1e-7, 1e-5, 1e-5, 1e-4)


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """(tilt_x, tilt_y) of a total tilt towards ``azimuth`` [rad]."""
    s = math.sin(theta)
    return math.asin(s * math.cos(azimuth)), math.asin(s * math.sin(azimuth))


SIXTEEN_BITS = Board(pascal_per_count=4.0)
# 8 bits up to 204 kPa; the envelope's largest pressure is 188 kPa, at 8 mm and 30°.
EIGHT_BITS = Board(pascal_per_count=800.0, full_count=255, threshold=3)


@dataclass(frozen=True)
class Place:
    """A contact of the envelope: m, rad, and the tip's centre in cells off the grid's."""

    d: float
    theta: float
    azimuth: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)

    @property
    def truth(self) -> tuple[float, float, float, float]:
        """(d, tilt_x, tilt_y, gain)."""
        return (self.d, *tilts(self.theta, self.azimuth), 1.0)

    @property
    def grid(self) -> SensorGrid:
        """The 44 × 44 cells under it."""
        return SensorGrid(SIZE, SIZE, PITCH, (self.offset[0] * PITCH, self.offset[1] * PITCH))

    @property
    def inside(self) -> bool:
        """Three degrees or more short of the rim."""
        return self.theta <= math.asin((TIP.radius - self.d) / TIP.radius) - _MARGIN

    def __str__(self) -> str:
        return (
            f"d {self.d * 1e3:g} mm, θ {math.degrees(self.theta):g}° towards "
            f"{math.degrees(self.azimuth):.0f}°, {self.offset[0]:+.2f} {self.offset[1]:+.2f} cells"
        )


def places(depths: tuple[float, ...], degrees: tuple[float, ...], around: int) -> Iterator[Place]:
    """For each d [m] and θ [degrees] ``around`` azimuths, evenly round, each with its offset.

    Azimuths and offsets differ from one (d, θ) to the next, so that together they fill the circle
    and the cell evenly; no azimuth is left out that a sensor's symmetry might hide.
    """
    number = 0
    for d in depths:
        for theta in degrees:
            turned = number * _GOLDEN % 1.0
            for k in range(around):
                number += 1
                yield Place(
                    d,
                    math.radians(theta),
                    2.0 * math.pi * (k + turned) / around,
                    (number * _SILVER % 1.0 - 0.5, number * _SILVER**2 % 1.0 - 0.5),
                )


def jacobian(place: Place) -> FloatArray:
    """∂ pressure/∂(d, tilt_x, tilt_y, gain) [cells, 4], by central differences."""
    columns = []
    for k, step in enumerate(_STEPS):
        ends = []
        for sign in (1.0, -1.0):
            at = list(place.truth)
            at[k] += sign * step
            ends.append(place.grid.pressure(TIP, LINEAR, at[0], at[1], at[2], at[3]))
        columns.append(((ends[0] - ends[1]) / (2.0 * step)).ravel())
    return np.stack(columns, axis=1)


def bound(
    slopes: FloatArray, noise: float, free: bool, live: NDArray[np.bool_] | None = None
) -> FloatArray:
    """The Cramér-Rao covariance of (d, tilt_x, tilt_y[, gain]) from the ``live`` cells."""
    used = slopes if live is None else slopes[live.ravel()]
    used = used[:, : 4 if free else 3]
    return np.asarray(np.linalg.inv(used.T @ used) * noise**2)


def is_small(place: Place, covariance: FloatArray) -> bool:
    """Whether the bound is small there and the rim is not near."""
    return bool(math.sqrt(covariance[0, 0]) <= _SMALL * place.d and place.inside)


def is_misfit(chi2: FloatArray, cells: FloatArray) -> NDArray[np.bool_]:
    """As :attr:`ContactEstimate.misfit`, of many."""
    spread = 2.0 / (9.0 * np.maximum(cells - 4.0, 1.0))
    return np.asarray(chi2 > (1.0 - spread + 5.0 * np.sqrt(spread)) ** 3)


def estimator(
    place: Place, noise: float, free: bool, board: Board | None = None, **more: Any
) -> ContactEstimator:
    """An estimator as the daemon would make it for that board."""
    return ContactEstimator(
        TIP,
        LINEAR,
        place.grid,
        noise,
        free_gain=free,
        readings=readings(board),
        **more,
    )


def readings(board: Board | None) -> Readings:
    """How a board's readings end; None: float frames."""
    return Readings() if board is None else Readings(board.full_count, board.threshold)


def keep(e: ContactEstimate, row: FloatArray) -> None:
    """Write an estimate into a row of COLUMNS."""
    valid = e.contact and e.valid
    row[:COVARIANCE] = e.d, e.tilt_x, e.tilt_y, e.gain, e.contact, valid, e.chi2, e.cells
    if valid:
        row[COVARIANCE:] = e.covariance.ravel()


def run(
    made: ContactEstimator,
    clean: FloatArray,
    noise: float,
    bank: FloatArray,
    board: Board | None = None,
) -> FloatArray:
    """Estimate ``clean`` + ``noise`` · each of ``bank`` [n, rows, cols]; float64 [n, COLUMNS]."""
    out = np.zeros((len(bank), COLUMNS))
    scale = 1.0 if board is None else board.pascal_per_count
    frame = np.zeros(clean.shape, np.float64 if board is None else np.uint16)
    for normals, row in zip(bank, out, strict=True):
        if board is None:
            _add(clean, noise, normals, frame)
        else:
            _count(clean, noise, normals, scale, board.threshold, board.full_count, frame)
        keep(made.update(frame, scale), row)
    return out


@kernel
def _add(clean: FloatArray, noise: float, normals: FloatArray, frame: FloatArray) -> None:
    rows, cols = frame.shape
    for i in range(rows):
        for j in range(cols):
            frame[i, j] = clean[i, j] + noise * normals[i, j]


@kernel
def _count(
    clean: FloatArray,
    noise: float,
    normals: FloatArray,
    scale: float,
    threshold: int,
    full: int,
    frame: NDArray[np.uint16],
) -> None:
    rows, cols = frame.shape
    for i in range(rows):
        for j in range(cols):
            value = (clean[i, j] + noise * normals[i, j]) / scale
            value = min(max(value + 0.5, 0.0), full + 0.5)
            frame[i, j] = np.uint16(value if value >= threshold else 0.0)
