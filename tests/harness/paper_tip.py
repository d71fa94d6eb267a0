"""Define the paper's tip and sensor, which most tests use.

The tip has a radius of 20 mm and a modulus of 0.304 MPa. The sensor has 44 × 44 cells on a 58 mm
square.
"""

import math
from typing import Any

import numpy as np

from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

A = 0.020  # m
E = 0.304e6  # Pa
TIP = Fingertip(A)
LINEAR = Material.constant(E)
MEASURED = Material.table_i()
PITCH = 0.058 / 44  # m
GRID = SensorGrid(44, 44, PITCH)
NOISE = 0.002 * E  # Pa

# d [mm], θ [°], F [N], U [mJ] for a constant modulus.
CHECKPOINTS = (
    (2, 0, 3.8201766667652, 2.5467844445101),
    (2, 15, 3.9549379080604, 2.7296353408105),
    (2, 30, 4.4111600538176, 3.3957125926802),
    (4, 0, 15.280706667061, 20.374275556081),
    (4, 15, 15.819751632242, 21.837082726484),
    (4, 30, 17.64464021527, 27.165700741441),
    (6, 15, 35.594441172543, 73.700154201884),
    (6, 30, 39.700440484359, 91.684240002365),
    (8, 0, 61.122826668243, 162.99420444865),
    (8, 15, 63.279006528966, 174.69666181187),
    (8, 30, 70.578560861082, 217.32560593153),
)


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """Return (tilt_x, tilt_y) for a tilt of ``theta`` [rad] towards ``azimuth`` [rad]."""
    return (
        math.asin(math.sin(theta) * math.cos(azimuth)),
        math.asin(math.sin(theta) * math.sin(azimuth)),
    )


def dense(
    grid: SensorGrid, material: Material, contact: Any, pieces: int = 16, margin: int = 6
) -> np.ndarray[Any, Any]:
    """Return the mean blurred pressure of each cell, from ``pieces``² samples per cell."""
    from scipy.ndimage import gaussian_filter  # SciPy is slow to import, and few tests need it.

    d, tilt_x, tilt_y = contact
    axes = []
    for cells, pitch, centre in zip((grid.cols, grid.rows), grid.pitches, grid.centre, strict=True):
        count = (cells + 2 * margin) * pieces
        axes.append((np.arange(count) + 0.5 - 0.5 * count) * pitch / pieces - centre)
    x, y = axes[0][None, :], axes[1][:, None]
    n_x, n_y = grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
    face = (A - d - n_x * x - n_y * y) / math.sqrt(1.0 - n_x**2 - n_y**2)
    inside = x * x + y * y < A * A
    height = np.sqrt(np.where(inside, A * A - x * x - y * y, 1.0))
    strain = np.where(inside, 1.0 - np.maximum(face, 0.0) / height, 0.0)
    pressure = material.stress(np.clip(strain, 0.0, 1.0))
    widths = [grid.blur / pitch * pieces for pitch in grid.pitches[::-1]]
    pressure = gaussian_filter(pressure, widths, truncate=6.0)
    edge = margin * pieces
    kept = pressure[edge:-edge, edge:-edge]
    return np.asarray(kept.reshape(grid.rows, pieces, grid.cols, pieces).mean(axis=(1, 3)))


def fisher(
    grid: SensorGrid, material: Material, truth: Any, noise: float, free_gain: bool
) -> np.ndarray[Any, Any]:
    """Return the inverse of the Fisher information of (d, tilt_x, tilt_y[, gain])."""
    columns = []
    for k, step in enumerate((1e-7, 1e-5, 1e-5, 1e-4)[: 4 if free_gain else 3]):
        ends = []
        for sign in (1.0, -1.0):
            at = list(truth)
            at[k] += sign * step
            ends.append(grid.pressure(TIP, material, *at[:3], gain=at[3]))
        columns.append(((ends[0] - ends[1]) / (2 * step)).ravel())
    jacobian = np.stack(columns, axis=1)
    return np.linalg.inv(jacobian.T @ jacobian) * noise**2


def errors(estimate: Any, truth: Any) -> np.ndarray[Any, Any]:
    """Return the errors of d, both tilts and the gain."""
    return np.array([estimate.d, estimate.tilt_x, estimate.tilt_y, estimate.gain]) - np.array(truth)


def board(pascal_per_count: float = 1.0, **range_: int) -> TactileSettings:
    """Return the board settings of the paper's sensor; frames have 16 bits by default."""
    return TactileSettings(pascal_per_count=pascal_per_count, **range_)


def flawed(**flaws: float) -> SimulationSettings:
    """Return settings for a simulated sensor that has only the given defects."""
    named = {"noise": 0.0, **flaws}
    return SimulationSettings(**{f"tactile_{name}": value for name, value in named.items()})
