"""The mathematics of calibrating a pressure sensor under a soft tip. No files, no sensors.

In the order in which it is done: tare (what the cells read unloaded), equilibration (what makes
the cells alike), curve (alike readings → pressure), centre (where the tip stands on the sensor and
how that is turned), modulus (the tip's own law), relaxation (how its force falls in a hold). Each
returns its result with the residuals.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger import SoftfingerError
from softfinger.kinematics.calibration.press_fit import (
    Presses,
    Trend,
    depth_of_force,
    fit_place,
    golden_section,
    trend,
)
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

FloatArray = NDArray[np.float64]
Kind = Literal["power", "cubic"]

DEAD = 0.2  # of the median response: cells below are dead
_EXPONENTS = (0.3, 3.0)
_RESTLESS = 8.0  # times the usual noise
_FEW_CELLS = 4  # may be faulty
_TILT_MIN = math.radians(3.0)  # tilts that differ by less show no direction
_UPRIGHT = math.radians(0.5)
_PRESSED = 6.0  # times the noise: some cell reads more under a tip
_LAGS = 8  # cells over which noise may be correlated
_SEEN = 4.0  # standard errors
_ENDED = 4.0  # of noise: a zero below it is touched by the end at 0
_HELD = 2.0  # times the longest term to be found, at least, that a hold must last
_ROUNDS = 25  # in which strengths and press are found in turns


class CalibrationError(SoftfingerError, ValueError):
    """The data don't determine the result. The message says what is missing or wrong."""


@dataclass(frozen=True)
class Tare:
    """``zero``: mean count unloaded; ``noise``: standard deviation; both float64 [rows, cols].

    ``correlation`` [k, m] is that of two cells' noise by their distance in rows and columns, empty
    where the frames show none; ``drift`` [counts] the standard deviation of what all cells do
    together; ``excess`` [counts] the mean of what a reading is over the zero, none being below.
    """

    zero: FloatArray
    noise: FloatArray
    correlation: FloatArray
    drift: float
    excess: float


def tare(frames: ArrayLike) -> Tare:
    """Return the zero of each cell from unloaded frames [n, rows, cols].

    Raises CalibrationError when some cells vary far more than most: something presses meanwhile.
    """
    stack = _stack(frames, "tare")
    if len(stack) < 2:
        raise CalibrationError("tare: one frame is too few, expected at least two")
    noise = stack.std(axis=0, ddof=1)
    restless = np.count_nonzero(noise > _RESTLESS * max(float(np.median(noise)), 0.5))
    if restless >= _FEW_CELLS:
        raise CalibrationError(f"tare: {restless} cells don't rest; does something touch the tip?")
    zero = stack.mean(axis=0)
    excess = float(np.maximum(stack - zero, 0.0).mean())
    return Tare(zero, noise, *noise_correlation(stack), excess)


def noise_correlation(stack: FloatArray) -> tuple[FloatArray, float]:
    """Return ``correlation`` and ``drift`` of a :class:`Tare` from unloaded frames [n, rows, cols].

    What is within four standard errors of none counts as none.
    """
    n, rows, cols = stack.shape
    noise = stack - stack.mean(axis=0)
    std = noise.std(axis=0)
    rests = (std > 0.0) & (std <= _RESTLESS * np.median(std))  # not dead or faulty
    noise *= rests
    common = noise.sum(axis=(1, 2)) / max(np.count_nonzero(rests), 1)
    noise -= common[:, None, None] * rests
    own = float(noise.var())
    noise /= np.where(rests, std, 1.0)
    shape = rows + _LAGS, cols + _LAGS
    power = (np.abs(np.fft.fft2(noise, shape)) ** 2).sum(axis=0)
    products = np.fft.ifft2(power).real
    # Both signs of one of the lags: what the noise does along one diagonal and the other.
    both = 0.5 * (products + np.roll(products[:, ::-1], 1, axis=1))[:_LAGS, :_LAGS]
    pairs = (n - 1.0) * np.outer(rows - np.arange(_LAGS), cols - np.arange(_LAGS))
    if rows < _LAGS or cols < _LAGS or not both[0, 0] > 0.0:
        return np.empty((0, 0)), float(common.std(ddof=1))
    rho = both / pairs / (both[0, 0] / pairs[0, 0])
    rho[np.abs(rho) < _SEEN / np.sqrt(pairs)] = 0.0
    used = np.argwhere(rho != 0.0).max(axis=0) + 1
    rho = rho[: used[0], : used[1]]
    twice = np.where(np.arange(max(used)) > 0, 2.0, 1.0)
    together = float(twice[: used[0]] @ rho @ twice[: used[1]])
    own *= max(together, 0.0) / (rows * cols)
    drift = math.sqrt(max(float(common.var(ddof=1)) - own, 0.0))
    if drift < _SEEN * math.sqrt(own / n):
        drift = 0.0
    return (rho if rho.size > 1 else np.empty((0, 0))), drift


@dataclass(frozen=True)
class Equilibration:
    """``gain`` float64 [rows, cols] makes all cells read alike, 0 for dead ones.

    ``spread`` is the cells' relative rms round the mean before, ``residual`` after.
    """

    gain: FloatArray
    spread: float
    residual: float


def equilibrate(loads: Sequence[ArrayLike], zero: FloatArray) -> Equilibration:
    """Return gains from frames [n, rows, cols] under each of several uniform pressures.

    Least squares of each cell's readings against the mean of all live ones. Cells that respond by
    less than a fifth of the median are dead. Raises CalibrationError when nothing presses.
    """
    if not loads:
        raise CalibrationError("equilibrate: no uniform pressure was given")
    readings = np.stack([_stack(load, "equilibrate").mean(axis=0) - zero for load in loads])
    response = readings.sum(axis=0)
    typical = float(np.median(response))
    if not typical > 0.0:
        raise CalibrationError("equilibrate: most cells read nothing above their zero")
    active = response > DEAD * typical
    target = np.array([reading[active].mean() for reading in readings])
    if (target <= 0.0).any():
        raise CalibrationError("equilibrate: a pressure reads nothing above the zero")
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.tensordot(target, readings, 1) / (readings**2).sum(axis=0)
    gain = np.where(active, gain, 0.0)
    relative = target[:, None]
    before = readings[:, active] / relative - 1.0
    after = readings[:, active] * gain[active] / relative - 1.0
    return Equilibration(gain, _rms(before), _rms(after))


@dataclass(frozen=True)
class SensorCurve:
    """``coefficients`` (exponent b, c_1, c_2, c_3) of p = c_1 x^b + c_2 x² + c_3 x³ [Pa].

    ``errors`` [n]: relative error of each known force; ``residual`` their rms.
    """

    kind: Kind
    coefficients: tuple[float, float, float, float]
    errors: FloatArray
    residual: float


def fit_curve(
    kind: Kind, readings: ArrayLike, force: ArrayLike, area: float, full: float
) -> SensorCurve:
    """Return the curve whose pressure over all cells makes the known forces.

    ``readings`` float64 [n, rows, cols]: x = (counts − zero)·gain, ≥ 0 and free of noise far from
    the contact (see :func:`cleared`); ``force`` [n] N; ``area`` of a cell [m²]; ``full`` the
    largest x there is, up to which a cubic has to rise. Least squares of the relative errors.
    Raises CalibrationError for too few forces or a curve that falls.
    """
    x = _stack(readings, "curve")
    x = x.reshape(len(x), -1)
    known = np.asarray(force, np.float64)
    if known.shape != (len(x),) or not (np.isfinite(known).all() and (known > 0.0).all()):
        raise CalibrationError("curve: each load needs its force, above 0")
    need = 2 if kind == "power" else 3
    if len(np.unique(known)) < need:
        raise CalibrationError(f"curve: a {kind} needs at least {need} different forces")
    if (x.max(axis=1) <= 0.0).any():
        raise CalibrationError("curve: a load reads nothing above the zero")
    if kind == "power":
        coefficients, errors = _power(x, known, area, full)
    else:
        coefficients, errors = _cubic(x, known, area, full)
    return SensorCurve(kind, coefficients, errors, _rms(errors))


def _cubic(
    x: FloatArray, force: FloatArray, area: float, full: float
) -> tuple[tuple[float, float, float, float], FloatArray]:
    u = x / full
    rows = np.stack([(u**j).sum(axis=1) * area / force for j in (1, 2, 3)], axis=1)
    c, _, rank, _ = np.linalg.lstsq(rows, np.ones(len(force)), rcond=1e-10)
    if rank < 3:
        raise CalibrationError("curve: the loads are too alike for a cubic; try a power")
    at = np.linspace(0.0, 1.0, 201)
    if (c[0] + 2 * c[1] * at + 3 * c[2] * at**2 <= 0.0).any():
        raise CalibrationError("curve: the cubic through these loads falls; try a power")
    scaled = (1.0, float(c[0] / full), float(c[1] / full**2), float(c[2] / full**3))
    return scaled, rows @ c - 1.0


def _power(
    x: FloatArray, force: FloatArray, area: float, full: float
) -> tuple[tuple[float, float, float, float], FloatArray]:
    u = x / full

    def fit(exponent: float) -> tuple[float, FloatArray]:
        row = np.where(u > 0.0, u, 0.0) ** exponent
        ratio = row.sum(axis=1) * area / force
        factor = float(ratio.sum() / (ratio @ ratio))
        return factor, factor * ratio - 1.0

    def cost(exponent: float) -> float:
        errors = fit(exponent)[1]
        return float(errors @ errors)

    # The best of a coarse grid, then golden section round it.
    grid = np.linspace(*_EXPONENTS, 28)
    best = int(np.argmin([cost(float(b)) for b in grid]))
    low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
    exponent = golden_section(cost, low, high, 1e-9)
    if not _EXPONENTS[0] + 0.02 < exponent < _EXPONENTS[1] - 0.02:
        raise CalibrationError(f"curve: these loads want an exponent beyond {_EXPONENTS}")
    factor, errors = fit(exponent)
    return (exponent, factor / full**exponent, 0.0, 0.0), errors


def cleared(readings: FloatArray, noise: FloatArray, frames: int) -> FloatArray:
    """Set those of the mean readings [rows, cols] of so many frames to 0 that are within 4 σ of it.

    Clipped noise has a positive mean, which over all the cells would weigh as much as a contact.
    """
    level = 4.0 * noise / math.sqrt(frames)
    return np.where(readings > level, readings, 0.0)


def without_end(means: FloatArray, zero: FloatArray, noise: float) -> FloatArray:
    """Return the mean counts of many frames as they would be if noise did not end at 0.

    ``zero`` and ``noise`` are a tare's mean counts and their standard deviation. Of max(x + n, 0)
    with Gaussian n both rise with x, and so does their ratio, which tells what n is.
    """
    z = np.linspace(-3.0, 6.0, 1801)
    above = 0.5 * (1.0 + np.array([math.erf(each) for each in z / math.sqrt(2.0)]))
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    ended = z * above + density
    std = np.sqrt((z * z + 1.0) * above + z * density - ended * ended)
    level = float(np.median(zero))
    if not 0.0 < level < _ENDED * noise:
        return means - zero
    sigma = level / float(np.interp(level / noise, ended / std, ended))

    def whole(counts: FloatArray) -> FloatArray:
        near = np.minimum(counts / sigma, z[-1])
        return np.where(counts < z[-1] * sigma, sigma * np.interp(near, ended, z), counts)

    return whole(means) - whole(zero)


@dataclass(frozen=True)
class Centre:
    """The tip's centre in the sensor's axes (x, y) [m], and the sensor's rotation [rad].

    ``rotation`` is None where no press was tilted. ``residual`` is what the last step changed [m],
    ``std`` the centre's standard deviation in x and in y [m].
    """

    centre: tuple[float, float]
    rotation: float | None
    residual: float
    std: float


def fit_centre(
    frames: ArrayLike,
    theta: ArrayLike,
    tip: Fingertip,
    material: Material,
    grid: SensorGrid,
    noise: float,
    active: NDArray[np.bool_] | None = None,
) -> Centre:
    """Return centre and rotation from presses of known tilt θ [n] in the finger's plane [rad].

    ``frames`` [n, rows, cols] Pa. Whole frames are fitted; a springs' modulus need not be known.
    Raises CalibrationError when a frame shows no contact, and for tilts that are all alike but not
    upright.
    """
    stack = _stack(frames, "centre")
    s = np.sin(np.asarray(theta, np.float64))
    if s.shape != (len(stack),):
        raise CalibrationError("centre: each press needs its tilt, 0 for upright ones")
    tilted = float(np.ptp(s)) > math.sin(_TILT_MIN)
    if not tilted and float(np.abs(s).max()) > math.sin(_UPRIGHT):
        raise CalibrationError(
            f"centre: the tilts differ by less than {math.degrees(_TILT_MIN):g}°, so that tilt "
            "can't be separated from place; press upright alone, or upright and tilted further"
        )
    for k, frame in enumerate(stack):
        if not frame.max() > _PRESSED * noise:
            raise CalibrationError(f"centre: press {k + 1} is no clean contact")
    used = np.broadcast_to(True if active is None else active, stack.shape)
    force = (stack * used).sum(axis=(1, 2)) * math.prod(grid.pitches)
    presses = Presses(stack, depth_of_force(tip, material, force), np.arcsin(s), noise, used)
    found, residual, std = fit_place(presses, tip, material, grid, tilted)
    # A press is as upright as it can be told to be: how far a turn moves the centroid.
    lever = (0.5 if tip.physics == "solid" else 1.0) * tip.radius
    std = math.hypot(std, lever * _UPRIGHT / math.sqrt(3.0 * len(s)))
    return Centre(found.centre, found.rotation if tilted else None, residual, std)


@dataclass(frozen=True)
class Modulus:
    """E [Pa] of the tip's F(d − d₀, θ); ``offset`` d₀ [m]; ``errors`` [n] relative, of the force.

    ``trend``: E of each load alone.
    """

    modulus: float
    offset: float
    errors: FloatArray
    residual: float
    trend: Trend


def fit_modulus(d: ArrayLike, theta: ArrayLike, force: ArrayLike, tip: Fingertip) -> Modulus:
    """Fit a constant modulus of ``tip``, and the run's own zero of d, to a compression run.

    By least relative squares. ``d`` [m], ``theta`` [rad], ``force`` [N] by the sensor, all [n].
    Raises CalibrationError for too few points, and for a force that does not rise with d.
    """
    depth, tilt, load = (np.asarray(each, np.float64) for each in (d, theta, force))
    if not depth.shape == tilt.shape == load.shape:
        raise CalibrationError("modulus: each frame needs its d and its force")
    used = (depth > 0.0) & (load > 0.0)
    if np.count_nonzero(used) < 3 or np.ptp(depth[used]) <= 0.0:
        raise CalibrationError("modulus: expected at least three frames of different d, pressed")
    depth, tilt, load = depth[used], tilt[used], load[used]
    if not np.polyfit(depth, load, 1)[0] > 0.0:
        raise CalibrationError("modulus: the force does not rise with d")
    unit, offset, modulus = ContactTable.build(tip, Material.constant(1.0)), 0.0, 0.0
    for _ in range(30):
        c = unit(np.maximum(depth - offset, 1e-9), tilt)
        columns = np.stack([c.force, -c.force_d], axis=1) / load[:, None]
        modulus, shift = np.linalg.lstsq(columns, np.ones(len(load)), rcond=None)[0].tolist()
        step = float(np.clip(shift / modulus, -5e-4, 5e-4))
        offset += step
        if abs(step) < 1e-9:
            break
    fitted = modulus * unit(np.maximum(depth - offset, 1e-9), tilt).force
    errors = fitted / load - 1.0
    alone = trend(depth, modulus / (1.0 + errors), load)
    return Modulus(modulus, offset, errors, _rms(errors), alone)


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Strengths r of F = c F∞ (1 + Σ r_i (1 − h_i/F∞)), ḣ_i = (F∞ − h_i)/τ_i.

    ``residual`` is the r.m.s. of F's relative errors in the hold, ``elastic`` that without any r.
    """

    strengths: tuple[float, ...]
    residual: float
    elastic: float
    model: FloatArray  # F by the fit [N], in the press as measured


def follow(t: FloatArray, lasting: FloatArray, time: float) -> FloatArray:
    """Return h of ḣ = (F∞ − h)/τ, 0 at first, for a ``lasting`` F∞ straight between the ``t``."""
    out = np.zeros_like(lasting)
    for k in range(1, t.size):
        step = (t[k] - t[k - 1]) / time
        slope = (lasting[k] - lasting[k - 1]) / step if step > 0.0 else 0.0
        start = out[k - 1] - lasting[k - 1] + slope
        out[k] = lasting[k] - slope + start * np.exp(-step)
    return out


def fit_relaxation(t: ArrayLike, force: ArrayLike, times: tuple[float, ...]) -> Relaxation:
    """Fit the strengths, none below 0, to the ``force`` [N] over ``t`` [s] of a press and its hold.

    ``times`` [s] are the terms'. The press is as fast and as deep as it likes; it begins clear of
    the tip, or what relaxed before is not found. What F∞ is in the press follows from F and the
    strengths, so both are found in turns; in the hold it is constant. A term shorter than two
    frames can't be told and is left 0. Raises CalibrationError for too short a hold.
    """
    at, load = np.asarray(t, np.float64), np.asarray(force, np.float64)
    if at.size < 8 or not load.max() > 0.0:
        raise CalibrationError("relaxation: expected at least eight frames of one press and hold")
    noise = float(np.std(np.diff(load[at.size // 2 :]))) / math.sqrt(2.0)
    held = int(np.argmax(load >= load.max() - _SEEN * noise))  # the deepest: from there it falls
    told = [k for k, time in enumerate(times) if time > 2.0 * (at[-1] - at[0]) / (at.size - 1)]
    if told and at[-1] - at[held] < _HELD * max(times[k] for k in told):
        raise CalibrationError(
            f"relaxation: found {at[-1] - at[held]:.1f} s of hold, expected at least {_HELD:g} "
            f"times the longest of tip.relaxation_times, {max(times):g} s"
        )
    lasting = np.maximum(load, 0.0)
    lasting[held:] = load[-1]
    for _ in range(_ROUNDS):
        memory = np.array([follow(at, lasting, times[k]) for k in told]).reshape(-1, at.size)
        columns = np.stack([lasting, *(lasting - memory)], axis=1)[held:]
        fits = []
        # Of so few terms each choice is tried: the best of those whose strengths are all above 0.
        for chosen in itertools.product((False, True), repeat=len(told)):
            used = np.flatnonzero((True, *chosen))
            found = np.linalg.lstsq(columns[:, used], load[held:], rcond=None)[0]
            if (found >= 0.0).all():
                strengths = np.zeros(len(told))
                strengths[used[1:] - 1] = found[1:] / found[0]
                model = columns[:, used] @ found
                fits.append((_rms(model / load[held:] - 1.0), found[0], strengths, model))
        error, scale, strengths, model = min(fits, key=lambda fit: fit[0])
        passed = np.maximum(load, 0.0) / scale + strengths @ memory
        lasting[:held] = (passed / (1.0 + strengths.sum()))[:held]
    whole = np.zeros(len(times))
    whole[told] = strengths
    return Relaxation(tuple(whole.tolist()), error, fits[0][0], np.append(load[:held], model))


def _stack(frames: ArrayLike, step: str) -> FloatArray:
    stack = np.asarray(frames, np.float64)
    if stack.ndim != 3 or not len(stack):
        raise CalibrationError(f"{step}: expected frames [n, rows, cols], got {stack.shape}")
    if not np.isfinite(stack).all():
        raise CalibrationError(f"{step}: readings that are not finite")
    return stack


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
