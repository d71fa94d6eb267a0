"""What each imperfection of a sensor does to the estimate: bias of d, tilt and gain, and χ².

Each by itself, on an estimator that knows of none of them but the noise. The tip is pressed in
straight, for hysteresis a third deeper first, and held for 20 s.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from softfinger.daemon.simulation.sensor.sensor_model import Imperfections, SensorModel
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.estimator_bounds import LINEAR, MODULUS, PITCH, SIZE, TIP

NOISE = 0.002 * MODULUS
PASCAL_PER_COUNT = 4.0
CONTACTS = ((0.001, 0.0), (0.002, 15.0), (0.004, 15.0), (0.007, 30.0))
FLAWS: dict[str, dict[str, float]] = {
    "none": {},
    "blur 0.5 mm": {"blur": 0.5e-3},
    "blur 1 mm": {"blur": 1e-3},
    "crosstalk 5 %": {"crosstalk": 0.05},
    "hysteresis 10 %, unloading": {"hysteresis": 0.10},
    "creep 5 % in 10 s": {"creep": 0.05},
    "drift 300 Pa in 60 s": {"drift": 300.0},
    "gains spread by 5 %": {"gain_spread": 0.05},
    "1 % dead, not told": {"dead": 0.01},
}


@dataclass(frozen=True)
class FlawRow:
    """One imperfection at one contact."""

    name: str
    d: float  # truth [m]
    theta: float  # truth [rad]
    free: bool  # gain free
    d_error: float  # mean [m]
    theta_error: float  # mean [rad]
    gain: float  # mean
    told: float  # mean of the reported standard deviation of d [m]
    misfits: float  # share of frames
    invalid: float  # share of frames

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def flaws(frames: int, seed: int = 29) -> list[FlawRow]:
    """Each imperfection at each contact, gain free and known; ``frames`` over the 20 s."""
    rows = []
    grid = SensorGrid(SIZE, SIZE, PITCH, (0.31 * PITCH, -0.17 * PITCH))
    data = np.zeros(grid.shape, np.uint16)
    for name, options in FLAWS.items():
        for d, degrees in CONTACTS:
            theta = math.radians(degrees)
            sensor = SensorModel(
                grid,
                TIP,
                LINEAR,
                PASCAL_PER_COUNT,
                Imperfections(noise=NOISE, **options),
                seed=seed,
            )
            made = [ContactEstimator(TIP, LINEAR, grid, NOISE, free_gain=f) for f in (True, False)]
            sensor.press(0.0, theta, 0.0, 0.0)
            sensor.press(1.33 * d if sensor.remembers else d, theta, 0.0, 0.5)
            found: list[list[tuple[float, ...]]] = [[], []]
            for k in range(frames):
                sensor.frame(d, theta, 0.0, data, 1.0 + 20.0 * k / frames)
                for each, estimator in zip(found, made, strict=True):
                    e = estimator.update(data, PASCAL_PER_COUNT)
                    if e.contact and e.valid:
                        each.append((e.d - d, e.tilt_x - theta, e.gain, e.d_std, e.misfit))
            for free, each in zip((True, False), found, strict=True):
                off, turned, gain, told, misfits = (
                    np.mean(each, axis=0).tolist() if each else [math.nan] * 5
                )
                invalid = 1.0 - len(each) / frames
                rows.append(
                    FlawRow(name, d, theta, free, off, turned, gain, told, misfits, invalid)
                )
    return rows
