"""The estimator's errors: against the Cramér-Rao bound, and with frames of other contact models."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.estimator_kernels import OUTPUTS, run_frames

FloatArray = NDArray[np.float64]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LINEAR = Material.constant(MODULUS)
SIZE = 44
PITCH = 0.058 / SIZE
DEPTHS = (0.0005, 0.001, 0.002, 0.004, 0.008)  # m
TILTS = (0.0, 10.0, 20.0, 30.0)  # degrees
NOISES = (0.001, 0.002, 0.005, 0.01, 0.02)  # of the modulus
SMALL = 0.03  # σ_d over d: up to here the bound is small
MARGIN = math.radians(3.0)
_FINE = 8  # points a cell's side in frames of other models


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """(tilt_x, tilt_y) of a total tilt towards ``azimuth`` [rad]."""
    s = math.sin(theta)
    return math.asin(s * math.cos(azimuth)), math.asin(s * math.sin(azimuth))


def bound(
    grid: SensorGrid,
    material: Material,
    truth: tuple[float, float, float],
    noise: float,
    free: bool,
) -> FloatArray:
    """The Cramér-Rao covariance of (d, tilt_x, tilt_y[, gain]), by central differences."""
    steps = (1e-7, 1e-5, 1e-5, 1e-4)[: 4 if free else 3]
    columns = []
    for k, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            at = [*truth, 1.0]
            at[k] += sign * step
            ends.append(grid.pressure(TIP, material, at[0], at[1], at[2], at[3]))
        columns.append(((ends[0] - ends[1]) / (2.0 * step)).ravel())
    jacobian = np.stack(columns, axis=1)
    return np.asarray(np.linalg.inv(jacobian.T @ jacobian) * noise**2)


@dataclass(frozen=True)
class BoundRow:
    """RMS error over the bound at many contacts: of d and of the tilts, median and largest."""

    name: str
    contacts: int
    frames: int  # of each contact
    d_median: float
    d_worst: float
    tilt_median: float
    tilt_worst: float
    honest: float  # mean of errorᵀ Σ⁻¹ error over its length by the reported covariance
    lost: int  # frames that gave no valid estimate
    aim: float

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def against_the_bound(frames: int = 1000, seed: int = 8) -> list[BoundRow]:
    """Rows for gain free and gain known, where the bound is small and elsewhere."""
    random = np.random.default_rng(seed)
    bank = random.standard_normal((frames, SIZE, SIZE))
    out = np.empty((frames, OUTPUTS))
    rows = []
    for free in (True, False):
        ratios: dict[bool, list[tuple[float, float, float, int]]] = {True: [], False: []}
        for d in DEPTHS:
            for degrees in TILTS:
                for share in NOISES:
                    noise = share * MODULUS
                    centre = tuple((random.uniform(-0.5, 0.5, 2) * PITCH).tolist())
                    grid = SensorGrid(SIZE, SIZE, PITCH, centre)
                    theta = math.radians(degrees)
                    truth = (d, *tilts(theta, random.uniform(0.0, 2 * math.pi)))
                    covariance = bound(grid, LINEAR, truth, noise, free)
                    sigma = np.sqrt(np.diag(covariance))
                    clean = grid.pressure(TIP, LINEAR, *truth)
                    estimator = ContactEstimator(TIP, LINEAR, grid, noise, free_gain=free)
                    run_frames(estimator, clean + noise * bank, out, cold=False)
                    valid = out[:, 3] > 0.0
                    lost = int(np.count_nonzero(~valid))
                    limit = math.asin((TIP.radius - d) / TIP.radius)
                    small = bool(sigma[0] <= SMALL * d and theta <= limit - MARGIN)
                    reported = estimator(clean).covariance[:3, :3]
                    if not valid.any() or not reported[0, 0] > 0.0:  # too weak to be seen
                        ratios[small].append((math.nan, math.nan, math.nan, lost))
                        continue
                    error = out[valid, :3] - np.array(truth)
                    rms = np.sqrt(np.mean(error**2, axis=0))
                    weighed = np.einsum("ki,ij,kj->k", error, np.linalg.inv(reported), error)
                    tilt = math.hypot(*rms[1:]) / math.hypot(*sigma[1:3])
                    ratios[small].append(
                        (rms[0] / sigma[0], tilt, float(np.mean(weighed)) / 3.0, lost)
                    )
        for small, aim in ((True, 1.10), (False, 2.0)):
            values = np.array(ratios[small])
            if not len(values):
                continue
            rows.append(
                BoundRow(
                    f"gain {'free' if free else 'known'}, "
                    f"{'the bound is small' if small else 'elsewhere'}",
                    len(values),
                    frames,
                    *(float(np.nanmedian(values[:, 0])), float(np.nanmax(values[:, 0]))),
                    *(float(np.nanmedian(values[:, 1])), float(np.nanmax(values[:, 1]))),
                    float(np.nanmean(values[:, 2])),
                    int(values[:, 3].sum()),
                    aim,
                )
            )
    return rows


@dataclass(frozen=True)
class MismatchRow:
    """A frame of another model, without noise, estimated as the linear one."""

    name: str
    d: float  # truth [m]
    theta: float  # truth [rad]
    d_error: float
    theta_error: float
    gain: float
    explained: float
    valid: bool

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


OTHER_MODELS = ("radial springs", "Hertz", "Table I's law")


def frame_of(model: str, grid: SensorGrid, d: float, theta: float) -> FloatArray:
    """What ``grid`` would read of one of OTHER_MODELS, with the linear model's force [Pa]."""
    if model == "Table I's law":
        frame = grid.pressure(TIP, Material.table_i(), d, theta)
    else:
        frame = _projected(grid, _radial if model == "radial springs" else _hertz, d, theta)
    force = math.pi * MODULUS * d * d / math.cos(theta)
    return np.asarray(frame * (force / (frame.sum() * PITCH * PITCH)))


def mismatches() -> list[MismatchRow]:
    """Frames of radial springs, of Hertz and of Table I's law, estimated as linear."""
    grid = SensorGrid(SIZE, SIZE, PITCH)
    rows = []
    for name in OTHER_MODELS:
        for d, degrees in ((0.002, 0.0), (0.004, 0.0), (0.004, 15.0), (0.008, 30.0)):
            theta = math.radians(degrees)
            frame = frame_of(name, grid, d, theta)
            noise = 0.002 * MODULUS
            found = ContactEstimator(TIP, LINEAR, grid, noise, free_gain=True)(frame)
            rows.append(
                MismatchRow(
                    name,
                    d,
                    theta,
                    found.d - d,
                    found.tilt_x - theta,
                    found.gain,
                    found.explained,
                    found.valid,
                )
            )
    return rows


def _projected(grid: SensorGrid, shape: Any, d: float, theta: float) -> FloatArray:
    """Pressure over the face's plane, p(r), brought straight down to the sensor's cells [any]."""
    h, a = TIP.radius - d, TIP.radius
    n = SIZE * _FINE
    x = (np.arange(n) + 0.5) * PITCH / _FINE - 0.5 * SIZE * PITCH
    dx = x[None, :] - h * math.sin(theta)
    along = dx / math.cos(theta)  # in the plane, from where its normal meets it
    r2 = along**2 + x[:, None] ** 2
    fine = shape(r2, d, h, a)
    return np.asarray(fine.reshape(SIZE, _FINE, SIZE, _FINE).mean(axis=(1, 3)))


def _radial(r2: FloatArray, d: float, h: float, a: float) -> FloatArray:
    """Springs that point at the tip's centre: E ε cos ψ a² dΩ over the plane, ψ from the normal."""
    length2 = h * h + r2
    strain = np.maximum(1.0 - np.sqrt(length2) / a, 0.0)
    return np.asarray(a * a * h * h * strain / length2**2)


def _hertz(r2: FloatArray, d: float, h: float, a: float) -> FloatArray:
    """√(1 − r²/r_c²) with r_c² = a d."""
    return np.asarray(np.sqrt(np.maximum(1.0 - r2 / (a * d), 0.0)))
