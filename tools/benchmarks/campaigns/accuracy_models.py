"""Frames of other contact models and of imperfect sensors, estimated as what they are not.

How far off the estimate is, and whether its χ² shows it: a fit's χ² a degree of freedom is beyond
what noise makes above the limit of `accuracy_trials.is_misfit`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.sensor.sensor_model import Imperfections, SensorModel
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.campaigns import accuracy_trials as trials
from softfinger.tools.benchmarks.campaigns.accuracy_trials import (
    LINEAR,
    MODULUS,
    PITCH,
    SIXTEEN_BITS,
    SIZE,
    TIP,
    Place,
)
from softfinger.tools.benchmarks.framework.report import Report, Row

FloatArray = NDArray[np.float64]

# d [m], θ [degrees]
CONTACTS = ((0.001, 0), (0.002, 0), (0.002, 15), (0.004, 0), (0.004, 15), (0.008, 0), (0.008, 30))
FLAW_CONTACTS = ((0.001, 0), (0.002, 15), (0.004, 15), (0.007, 30))
FLAW_NOISE = 0.002 * MODULUS
FLAWS: dict[str, dict[str, float]] = {
    "none": {},
    "blur 0.5 mm": {"blur": 0.5e-3},
    "blur 1 mm": {"blur": 1e-3},
    "crosstalk 5 %": {"crosstalk": 0.05},
    "hysteresis 10 %, unloading": {"hysteresis": 0.10},
    "creep 5 % in 10 s": {"creep": 0.05},
    "drift 300 Pa in 60 s": {"drift": 300.0},
    "gains spread by 5 %": {"gain_spread": 0.05},
    "1 % dead, not declared": {"dead": 0.01},
}
_FINE = 8  # points a cell's side in frames of other models


def mismatches(
    frames: int, noises: tuple[float, ...] = trials.NOISES, seed: int = 23
) -> list[Report]:
    """Each other model at each contact and noise, estimated as linear with the gain free."""
    bank = np.random.default_rng(seed).standard_normal((frames, SIZE, SIZE))
    rows = []
    for model, make in MODELS.items():
        for d, degrees in CONTACTS:
            place = Place(d, math.radians(degrees))
            clean = make(place.grid, d, place.theta)
            # All with the linear model's force.
            force = math.pi * MODULUS * d * d / math.cos(place.theta)
            clean *= force / (clean.sum() * PITCH * PITCH)
            for noise in noises:
                found = trials.run(trials.estimator(place, noise, True), clean, noise, bank)
                more = {"noise %": 100 * noise / MODULUS}
                rows.append(_row(model, place, found, more))
    return [Report("other models estimated as linear", rows)]


def flaws(frames: int, seed: int = 29) -> list[Report]:
    """Each imperfection at each contact, on estimators that know of none but the noise.

    The tip is pressed in straight, for hysteresis a third deeper first, and held for 20 s of which
    ``frames`` are estimated.
    """
    rows = []
    data = np.zeros((SIZE, SIZE), np.uint16)
    for name, options in FLAWS.items():
        for d, degrees in FLAW_CONTACTS:
            place = Place(d, math.radians(degrees), 0.0, (0.31, -0.17))
            imperfections = Imperfections(noise=FLAW_NOISE, **options)
            sensor = SensorModel(place.grid, TIP, LINEAR, SIXTEEN_BITS, imperfections, seed=seed)
            sensor.press(0.0, place.theta, 0.0, 0.0)
            sensor.press(1.33 * d if sensor.remembers else d, place.theta, 0.0, 0.5)
            made = [
                trials.estimator(place, FLAW_NOISE, free, SIXTEEN_BITS) for free in (True, False)
            ]
            found = np.zeros((2, frames, trials.COLUMNS))
            for k in range(frames):
                sensor.frame(d, place.theta, 0.0, data, 1.0 + 20.0 * k / frames)
                for each, estimator in zip(found, made, strict=True):
                    trials.keep(estimator.update(data, SIXTEEN_BITS.pascal_per_count), each[k])
            for gain, each in zip(("free", "known"), found, strict=True):
                rows.append(_row(name, place, each, {"gain is": gain}))
    return [Report("a sensor with", rows)]


def _row(name: str, place: Place, found: FloatArray, more: Row) -> Row:
    head = {"name": name, "d mm": 1e3 * place.d, "θ °": math.degrees(place.theta)} | more
    valid = found[found[:, trials.VALID] > 0.0]
    lost = {"not valid %": 100.0 * (1.0 - len(valid) / len(found))}
    if not len(valid):
        return head | lost
    flagged = trials.is_misfit(valid[:, trials.CHI2], valid[:, trials.CELLS])
    off = valid[:, : trials.TILT_Y].mean(axis=0) - (place.d, place.theta)
    return head | {
        "d off mm": 1e3 * float(off[0]),
        "± mm": 1e3 * float(np.median(np.sqrt(valid[:, trials.COVARIANCE]))),
        "θ off °": math.degrees(off[1]),
        "gain": float(valid[:, trials.GAIN].mean()),
        "χ²": float(np.median(valid[:, trials.CHI2])),
        "flagged %": 100.0 * float(flagged.mean()),
        **lost,
    }


def projected(
    shape: Callable[[FloatArray, float, float, float], FloatArray],
) -> Callable[[SensorGrid, float, float], FloatArray]:
    """Frames [any] of a pressure p(r², d, h, a) in the face's plane, brought down to the cells."""

    def frame(grid: SensorGrid, d: float, theta: float) -> FloatArray:
        h, a = TIP.radius - d, TIP.radius
        x = (np.arange(SIZE * _FINE) + 0.5) * PITCH / _FINE - 0.5 * SIZE * PITCH
        # In the plane, from where its normal meets it.
        along = (x[None, :] - h * math.sin(theta)) / math.cos(theta)
        fine = shape(along**2 + x[:, None] ** 2, d, h, a)
        return np.asarray(fine.reshape(SIZE, _FINE, SIZE, _FINE).mean(axis=(1, 3)))

    return frame


def radial(r2: FloatArray, d: float, h: float, a: float) -> FloatArray:
    """Springs that point at the tip's centre: E ε cos ψ a² dΩ over the plane, ψ from the normal."""
    length2 = h * h + r2
    strain = np.maximum(1.0 - np.sqrt(length2) / a, 0.0)
    return np.asarray(a * a * h * h * strain / length2**2)


def hertz(r2: FloatArray, d: float, h: float, a: float) -> FloatArray:
    """√(1 − r²/r_c²) with r_c² = a d."""
    return np.asarray(np.sqrt(np.maximum(1.0 - r2 / (a * d), 0.0)))


def _table_i(grid: SensorGrid, d: float, theta: float) -> FloatArray:
    return grid.pressure(TIP, Material.table_i(), d, theta)


MODELS: dict[str, Callable[[SensorGrid, float, float], FloatArray]] = {
    "radial springs": projected(radial),
    "Hertz": projected(hertz),
    "Table I's law": _table_i,
}
