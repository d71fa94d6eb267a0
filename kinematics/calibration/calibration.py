"""Calibrate a pressure sensor under a soft tip, and the relaxation of the tip.

The steps are, in order:

1. tare: zero offset and noise of each cell without a load,
2. equilibration: gains that equalise the response of all cells,
3. curve: conversion from equilibrated readings to pressure,
4. relaxation: decrease in tip force during a hold.

`press_fit` determines the model and the position of the tip. Each step returns its result together
with the residuals.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger import SoftfingerError

FloatArray = NDArray[np.float64]
Kind = Literal["power", "cubic"]

DEAD_RESPONSE = 0.2  # A cell is dead if its response is below this fraction of the median.
_EXPONENTS = (0.3, 3.0)
_UNREST_SIGMA = 8.0  # A cell is unsteady if its noise exceeds this multiple of the median.
# A tare fails if at least this many cells are unsteady. A smaller number of unsteady cells may be
# due to faulty cells.
_UNREST_CELL_COUNT = 4
_LAG_MAX = 8  # maximum lag of the noise correlation, in cells
_SIGNIFICANT_SIGMA = 4.0  # A result is significant if it exceeds this number of standard errors.
# If a zero offset exceeds this number of noise standard deviations, clipping at 0 is negligible.
_CLIPPED_SIGMA = 4.0
_HOLD_RATIO_MIN = 2.0  # minimum hold time, as a multiple of the longest time constant
_GOLDEN_RATIO = 0.5 * (math.sqrt(5.0) - 1.0)
_ITERATIONS = 25  # number of iterations that alternate between F∞ and the strengths


class CalibrationError(SoftfingerError, ValueError):
    """Error raised if the data do not determine a result."""


@dataclass(frozen=True)
class Tare:
    """Result of `tare`; ``correlation`` is empty if no correlation is significant."""

    zero: FloatArray  # mean of the unloaded counts [rows, cols]
    noise: FloatArray  # standard deviation of the unloaded counts [rows, cols]
    # Element [k, m] is the noise correlation of two cells that are k rows and m columns apart.
    correlation: FloatArray
    drift: float  # standard deviation of a drift that is common to all cells [counts]
    excess: float  # mean of max(reading − zero, 0) [counts]


def tare(frames: ArrayLike) -> Tare:
    """Determine the zero offset and noise of each cell from unloaded frames [n, rows, cols].

    Raises CalibrationError if several cells vary much more than the other cells, which indicates a
    contact.
    """
    stack = stack_of(frames, "tare")
    if len(stack) < 2:
        raise CalibrationError("tare: found one frame, expected at least two")
    noise = stack.std(axis=0, ddof=1)
    restless = np.count_nonzero(noise > _UNREST_SIGMA * max(float(np.median(noise)), 0.5))
    if restless >= _UNREST_CELL_COUNT:
        raise CalibrationError(
            f"tare: the readings of {restless} cells are changing, expected constant readings; "
            "check that the tip is not in contact"
        )
    zero = stack.mean(axis=0)
    excess = float(np.maximum(stack - zero, 0.0).mean())
    return Tare(zero, noise, *noise_correlation(stack), excess)


def noise_correlation(stack: FloatArray) -> tuple[FloatArray, float]:
    """Return ``correlation`` and ``drift`` of a :class:`Tare` from unloaded frames [n, rows, cols].

    Correlations within four standard errors of zero are set to zero.
    """
    n, *shape = stack.shape
    noise = stack - stack.mean(axis=0)
    std = noise.std(axis=0)
    rests = std > 0.0  # True for usable cells
    if np.count_nonzero(rests) < 2:
        return np.empty((0, 0)), 0.0
    rests &= std <= _UNREST_SIGMA * np.median(std[rests])
    cells = np.count_nonzero(rests)
    noise *= rests
    common = noise.sum(axis=(1, 2)) / cells
    noise -= common[:, None, None] * rests
    spread = float((noise**2).sum()) / ((n - 1) * cells)
    if not spread > 0.0:
        return np.empty((0, 0)), float(common.std(ddof=1))
    lags = min(_LAG_MAX, *shape)
    pairs = np.rint(_lagged_products(rests[None], lags))
    weight = (n - 1.0) * np.maximum(pairs, 1.0)
    raw = _lagged_products(noise / np.where(rests, std, 1.0), lags) / weight
    raw /= raw[0, 0]
    level = np.where(pairs > 0.0, _SIGNIFICANT_SIGMA / np.sqrt(weight), math.inf)
    level[0, 0] = 0.0
    twice = np.where(np.arange(lags) > 0, 2.0, 1.0)
    # Subtracting the mean of all cells decreases the correlations. ``share`` is the variance of
    # this mean without drift, divided by the variance of a cell.
    share = 1.0 / cells
    for _ in range(2):
        rho = raw + share * (1.0 - raw)
        rho[np.abs(rho) < level] = 0.0
        share = max(float(twice @ (rho * pairs) @ twice), 0.0) / cells**2
    own = spread * share / (1.0 - share)
    used = np.argwhere(rho != 0.0).max(axis=0) + 1
    rho = rho[: used[0], : used[1]]
    excess = float(common.var(ddof=1)) - own
    drift = math.sqrt(excess) if excess > _SIGNIFICANT_SIGMA * own * math.sqrt(2.0 / n) else 0.0
    return (rho if rho.size > 1 else np.empty((0, 0))), drift


def _lagged_products(stack: FloatArray | NDArray[np.bool_], lags: int) -> FloatArray:
    """Sum the products of two cells of [n, rows, cols] over all pairs at each lag, [lags, lags].

    The result is averaged over both signs of the column lag.
    """
    shape = [size + lags for size in stack.shape[1:]]
    products = np.fft.ifft2((np.abs(np.fft.fft2(stack, shape)) ** 2).sum(axis=0)).real
    return 0.5 * (products + np.roll(products[:, ::-1], 1, axis=1))[:lags, :lags]


@dataclass(frozen=True)
class Equilibration:
    """Result of `equilibrate`: gains that equalise the response of all cells."""

    gain: FloatArray  # [rows, cols]; 0 for dead cells
    spread: float  # relative rms deviation of the cells from their mean, without the gains
    residual: float  # the same deviation, with the gains


def equilibrate(loads: Sequence[ArrayLike], zero: FloatArray) -> Equilibration:
    """Determine the gains of the cells from frames [n, rows, cols] at several uniform pressures.

    Each gain is the least-squares fit of a cell's readings to the mean of all working cells. Cells
    with less than a fifth of the median response are considered dead. Raises CalibrationError if
    the frames do not contain a pressure that exceeds the noise.
    """
    if not loads:
        raise CalibrationError("equilibrate: expected at least one uniform pressure")
    stacks = [stack_of(load, "equilibrate") for load in loads]
    readings = np.stack([stack.mean(axis=0) - zero for stack in stacks])
    response = readings.sum(axis=0)
    error = np.sqrt(np.sum([stack.var(axis=0) / len(stack) for stack in stacks], axis=0))
    typical = float(np.median(response))
    if not typical > _SIGNIFICANT_SIGMA * float(np.median(error)):
        raise CalibrationError(
            "equilibrate: the readings of most cells do not exceed the zero offsets and the noise: "
            "apply more pressure, or record more frames"
        )
    active = response > DEAD_RESPONSE * typical
    target = np.array([reading[active].mean() for reading in readings])
    if (target <= 0.0).any():
        raise CalibrationError(
            "equilibrate: one of the pressures gives no reading above the zero offset"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.tensordot(target, readings, 1) / (readings**2).sum(axis=0)
    gain = np.where(active, gain, 0.0)
    relative = target[:, None]
    before = readings[:, active] / relative - 1.0
    after = readings[:, active] * gain[active] / relative - 1.0
    return Equilibration(gain, rms(before), rms(after))


@dataclass(frozen=True)
class SensorCurve:
    """Result of `fit_curve`: the pressure p = c_1 x^b + c_2 x² + c_3 x³ [Pa]."""

    kind: Kind
    coefficients: tuple[float, float, float, float]  # b, c_1, c_2, c_3
    errors: FloatArray  # relative errors at the known forces [n]
    residual: float  # rms of the errors


def fit_curve(
    kind: Kind, readings: ArrayLike, force: ArrayLike, area: float, full: float
) -> SensorCurve:
    """Fit the pressure curve of the cells to known forces.

    The fitted force is the pressure times the cell area, summed over all cells. The fit minimises
    the squared relative errors.

    Parameters
    ----------
    readings
        x = (counts − zero)·gain, float64 [n, rows, cols]. The readings must be non-negative and
        free of noise far from the contact, see :func:`above_zero`.
    force
        Known forces [n] [N].
    area
        Cell area [m²].
    full
        Maximum possible value of the reading x. A cubic curve must be increasing up to this value.

    Raises
    ------
    CalibrationError
        If there are too few forces, or if the curve decreases.
    """
    x = stack_of(readings, "curve")
    x = x.reshape(len(x), -1)
    known = np.asarray(force, np.float64)
    if known.shape != (len(x),) or not (np.isfinite(known).all() and (known > 0.0).all()):
        raise CalibrationError("curve: expected a force above 0 for each load")
    need = 2 if kind == "power" else 3
    if len(np.unique(known)) < need:
        raise CalibrationError(f"curve: a {kind} requires at least {need} different forces")
    if (x.max(axis=1) <= 0.0).any():
        raise CalibrationError("curve: one of the loads gives no reading above the zero offset")
    if kind == "power":
        coefficients, errors = _power(x, known, area, full)
    else:
        coefficients, errors = _cubic(x, known, area, full)
    return SensorCurve(kind, coefficients, errors, rms(errors))


def _cubic(
    x: FloatArray, force: FloatArray, area: float, full: float
) -> tuple[tuple[float, float, float, float], FloatArray]:
    u = x / full
    rows = np.stack([(u**j).sum(axis=1) * area / force for j in (1, 2, 3)], axis=1)
    c, _, rank, _ = np.linalg.lstsq(rows, np.ones(len(force)), rcond=1e-10)
    if rank < 3:
        raise CalibrationError("curve: the loads are too similar for a cubic; use a power law")
    at = np.linspace(0.0, 1.0, 201)
    if (c[0] + 2 * c[1] * at + 3 * c[2] * at**2 <= 0.0).any():
        raise CalibrationError(
            "curve: the cubic through these loads does not increase monotonically; use a power law"
        )
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

    # Search a coarse grid, then refine the best point with a golden-section search.
    grid = np.linspace(*_EXPONENTS, 28)
    best = int(np.argmin([cost(float(b)) for b in grid]))
    low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
    exponent = golden_section(cost, low, high, 1e-9)
    if not _EXPONENTS[0] + 0.02 < exponent < _EXPONENTS[1] - 0.02:
        raise CalibrationError(
            f"curve: these loads require an exponent outside the range {_EXPONENTS}"
        )
    factor, errors = fit(exponent)
    return (exponent, factor / full**exponent, 0.0, 0.0), errors


def golden_section(cost: Callable[[float], float], low: float, high: float, within: float) -> float:
    """Minimise ``cost`` on [low, high] by golden-section search, to the tolerance ``within``."""
    left, right = high - _GOLDEN_RATIO * (high - low), low + _GOLDEN_RATIO * (high - low)
    at_left, at_right = cost(left), cost(right)
    while high - low > within:
        if at_left < at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN_RATIO * (high - low)
            at_left = cost(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN_RATIO * (high - low)
            at_right = cost(right)
    return 0.5 * (low + high)


def above_zero(readings: FloatArray, noise: float, frames: int) -> FloatArray:
    """Set mean readings [rows, cols] below 4 σ to 0; ``frames`` is the number of frames averaged.

    Clipped noise has a positive mean. Summed over all cells, this mean may be as large as the force
    of a contact.
    """
    level = 4.0 * noise / math.sqrt(frames)
    return np.where(readings > level, readings, 0.0)


def without_clipping(means: FloatArray, zero: FloatArray, noise: float) -> FloatArray:
    """Correct the mean counts of many frames for the bias of noise that is clipped at 0.

    ``zero`` and ``noise`` are the mean and the standard deviation of the tare counts. For
    max(x + n, 0) with Gaussian n, the mean, the standard deviation and their ratio all increase
    with x. The ratio therefore determines the standard deviation of n.
    """
    z = np.linspace(-3.0, 6.0, 1801)
    above = 0.5 * (1.0 + np.array([math.erf(each) for each in z / math.sqrt(2.0)]))
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    ended = z * above + density
    std = np.sqrt((z * z + 1.0) * above + z * density - ended * ended)
    level = float(np.median(zero))
    if not 0.0 < level < _CLIPPED_SIGMA * noise:
        return means - zero
    sigma = level / float(np.interp(level / noise, ended / std, ended))

    def whole(counts: FloatArray) -> FloatArray:
        near = np.minimum(counts / sigma, z[-1])
        return np.where(counts < z[-1] * sigma, sigma * np.interp(near, ended, z), counts)

    return whole(means) - whole(zero)


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Result of `fit_relaxation`: F = c F∞ (1 + Σ r_i (1 − h_i/F∞)), ḣ_i = (F∞ − h_i)/τ_i."""

    strengths: tuple[float, ...]  # r_i
    residual: float  # rms relative error of F during the hold
    elastic: float  # the same error for a fit without relaxation
    model: FloatArray  # F [N], measured during the press and fitted during the hold


def follow(t: FloatArray, lasting: FloatArray, time: float) -> FloatArray:
    """Integrate ḣ = (F∞ − h)/τ from h = 0; ``lasting`` contains F∞ at the times ``t``."""
    out = np.zeros_like(lasting)
    for k in range(1, t.size):
        step = (t[k] - t[k - 1]) / time
        slope = (lasting[k] - lasting[k - 1]) / step if step > 0.0 else 0.0
        start = out[k - 1] - lasting[k - 1] + slope
        out[k] = lasting[k] - slope + start * np.exp(-step)
    return out


def fit_relaxation(t: ArrayLike, force: ArrayLike, times: tuple[float, ...]) -> Relaxation:
    """Fit non-negative relaxation strengths to the force during a press and the subsequent hold.

    F∞ is constant during the hold. During the press, F∞ is computed from F and the strengths. The
    fit therefore updates F∞ and the strengths alternately.

    Parameters
    ----------
    t, force
        Time [s] and force [N]. The press may have any speed and depth. The press must begin without
        contact, because the fit does not include earlier relaxation.
    times
        Time constants τ_i [s]. If a time constant is shorter than two frame periods, its strength
        cannot be determined and is set to 0.

    Raises
    ------
    CalibrationError
        If the hold is too short, or if the tip is released.
    """
    at, load = np.asarray(t, np.float64), np.asarray(force, np.float64)
    if at.size < 8 or not load.max() > 0.0:
        raise CalibrationError("relaxation: expected at least eight frames of a held press")
    noise = float(np.std(np.diff(load[at.size // 2 :]))) / math.sqrt(2.0)
    held = int(np.argmax(load >= load.max() - _SIGNIFICANT_SIGMA * noise))  # start of the hold
    told = [k for k, time in enumerate(times) if time > 2.0 * (at[-1] - at[0]) / (at.size - 1)]
    if told and at[-1] - at[held] < _HOLD_RATIO_MIN * max(times[k] for k in told):
        raise CalibrationError(
            f"relaxation: the press was held for {at[-1] - at[held]:.1f} s, expected at least "
            f"{_HOLD_RATIO_MIN * max(times):g} s ({_HOLD_RATIO_MIN:g} times the longest time in "
            "tip.relaxation_times)"
        )
    # A strength is at most 1, so a held tip keeps at least this fraction of its force.
    if not load[held:].min() > load.max() / (1 + len(times)):
        raise CalibrationError(
            f"relaxation: the force fell to {load[held:].min() / load.max():.0%} of its maximum, "
            "expected a single press that is held until the last frame"
        )
    lasting = np.maximum(load, 0.0)
    lasting[held:] = load[-1]
    for _ in range(_ITERATIONS):
        memory = np.array([follow(at, lasting, times[k]) for k in told]).reshape(-1, at.size)
        columns = np.stack([lasting, *(lasting - memory)], axis=1)[held:]
        fits = []
        # Try every subset of the terms. Keep the best subset with non-negative strengths.
        for chosen in itertools.product((False, True), repeat=len(told)):
            used = np.flatnonzero((True, *chosen))
            found = np.linalg.lstsq(columns[:, used], load[held:], rcond=None)[0]
            if (found >= 0.0).all():
                strengths = np.zeros(len(told))
                strengths[used[1:] - 1] = found[1:] / found[0]
                model = columns[:, used] @ found
                fits.append((rms(model / load[held:] - 1.0), found[0], strengths, model))
        error, scale, strengths, model = min(fits, key=lambda fit: fit[0])
        passed = np.maximum(load, 0.0) / scale + strengths @ memory
        lasting[:held] = (passed / (1.0 + strengths.sum()))[:held]
    whole = np.zeros(len(times))
    whole[told] = strengths
    return Relaxation(tuple(whole.tolist()), error, fits[0][0], np.append(load[:held], model))


def stack_of(frames: ArrayLike, step: str) -> FloatArray:
    stack = np.asarray(frames, np.float64)
    if stack.ndim != 3 or not len(stack):
        raise CalibrationError(f"{step}: found shape {stack.shape}, expected [n, rows, cols]")
    if not np.isfinite(stack).all():
        raise CalibrationError(f"{step}: found readings that are not finite")
    return stack


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
