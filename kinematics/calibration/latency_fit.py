"""Measure the latency of tactile frames, i.e. the delay of the measured d after joint motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.servo_fit import time_grid

FloatArray = NDArray[np.float64]

_STEP = 1e-3  # step of the time grid, and of the first (coarse) search for the delay [s]
_DELAY_MIN, _DELAY_MAX = -0.02, 0.2  # range of latencies to search [s]
# Minimum closing speed in a ramp [m/s], and averaging time of the speed [s].
_CLOSING_SPEED_MIN, _RATE_TIME = 2e-3, 0.05
_RAMP_MARGIN = 0.2  # time added to both ends of a ramp [s]
_CLOSING_MIN = 8e-4  # minimum closing distance in a ramp [m]; equal to seven encoder counts
_FRAME_COUNT_MIN = 8  # minimum number of frames
_TIME_ERROR = 1e-3  # standard deviation of the time stamps of ticks, readings and frames [s]
# Apparent widening of a growing footprint; see `perception.frame_channels`.
_WIDENING, _SPREAD_MAX = 1.4, 0.1
_ITERATIONS = 3  # number of iterations that alternately estimate the first contact and the delay


class LatencyFit(NamedTuple):
    """Frame delay [s] in addition to the configured latency, and its standard deviation [s]."""

    delay: float
    std: float
    scale: float  # ratio of d from the frames to d from the joint angles
    residual: float  # rms residual of d [m]
    ramps: int


def fit_latency(
    frames: tuple[ArrayLike, ArrayLike, ArrayLike],
    joints: tuple[ArrayLike, ArrayLike],
    errors: tuple[float, float],
    latency: float,
    response: float = 0.0,
) -> LatencyFit:
    """Fit the frame delay to the ramps of a grip, in which the force rises or falls.

    The model for ramp k is

        d(t) = scale · closing(t − delay) + offset_k

    Cells with a response time measure the closing with a first-order lag. With such a lag, a
    growing footprint appears too wide, and the fit corrects d for this effect.

    Parameters
    ----------
    frames
        Times [s], d [m], and standard deviation of the noise of d [m].
    joints
        Times [s] and closing of the joints [m], measured from any origin.
    errors
        Standard deviation of the closing due to the encoders [m], and relative standard deviation
        of d from the frames.
    latency
        Latency already included in the frame times [s].
    response
        Time constant of the cells [s].

    Raises
    ------
    CalibrationError
        If the joints close by less than 0.8 mm in every ramp, if the latency exceeds 0.2 s, or if
        the data are longer than an hour.
    """
    t, d, std = (np.asarray(each, np.float64) for each in frames)
    read, closed = (np.asarray(each, np.float64) for each in joints)
    if t.size < _FRAME_COUNT_MIN or read.size < 2:
        raise CalibrationError(_too_little(0.0))
    grid = time_grid(read, _STEP)
    closing = np.interp(grid, read, closed - closed[0])
    rate = _rate(closing)
    ramps, widest = _ramps(t, grid, closing, rate)
    used = ramps.any(axis=1)
    if np.count_nonzero(used) < _FRAME_COUNT_MIN:
        raise CalibrationError(_too_little(widest))
    encoder, scale_error = errors
    data = _Ramps(t[used], d[used], np.hypot(std[used], encoder), ramps[used])
    touch = -math.inf
    for _ in range(_ITERATIONS if response > 0.0 else 1):
        shown, spread = _filtered_closing(np.maximum(closing, touch), response)
        fit, offset = _fit(data, grid, shown, spread, scale_error, latency)
        touch = -offset / fit.scale
    # At standstill, the encoder error is constant. Half of the error shifts the ramp.
    speed = float(np.abs(np.interp(data.t, grid, rate)).max())
    held = 0.5 * encoder / speed / math.sqrt(ramps.shape[1])
    return fit._replace(std=math.hypot(fit.std, held))


class _Ramps(NamedTuple):
    """Frames in the ramps: times, d, standard deviations, and a mask for each ramp."""

    t: FloatArray
    d: FloatArray
    std: FloatArray
    of: NDArray[np.bool_]


def _fit(
    data: _Ramps,
    grid: FloatArray,
    shown: FloatArray,
    spread: FloatArray,
    scale_error: float,
    latency: float,
) -> tuple[LatencyFit, float]:
    """Fit d to the filtered closing; return the fit and the offset of d [m]."""

    def solve(delay: float) -> tuple[FloatArray, FloatArray]:
        at = data.t - delay
        wide = np.minimum(np.interp(at, grid, spread) / data.d**2, _SPREAD_MAX)
        rows = np.column_stack([np.interp(at, grid, shown), data.of]) / data.std[:, None]
        rows = np.vstack([rows, [1.0 / scale_error, *np.zeros(data.of.shape[1])]])
        values = np.append(data.d / (1.0 + _WIDENING * wide) / data.std, 1.0 / scale_error)
        x = np.linalg.lstsq(rows, values, rcond=None)[0]
        return x, values - rows @ x

    delays = np.arange(_DELAY_MIN, _DELAY_MAX, _STEP) - latency
    costs = np.array([float(np.sum(np.square(solve(delay)[1]))) for delay in delays])
    best = int(np.argmin(costs))
    if best == delays.size - 1:
        raise CalibrationError(
            f"found a latency of at least {_DELAY_MAX * 1e3:g} ms, which cannot be measured; check "
            "the board's rate and baud rate"
        )
    near = slice(max(best - 5, 0), best + 6)
    bend, slope, _ = np.polyfit(delays[near] - delays[best], costs[near], 2)
    delay, bend = float(delays[best]), max(float(bend), 1e-9)
    if 0 < best < delays.size - 1:
        delay -= 0.5 * float(slope) / bend
    x, off = solve(delay)
    off = off[:-1]
    excess = max(float(off @ off) / max(off.size - x.size - 1, 1), 1.0)
    alike = float(np.clip(off[1:] @ off[:-1] / (off @ off), 0.0, 0.9))
    std = math.sqrt(excess * (1.0 + alike) / (1.0 - alike) / bend)
    residual = float(np.sqrt(np.mean(np.square(off * data.std))))
    result = LatencyFit(
        delay, math.hypot(std, _TIME_ERROR), float(x[0]), residual, data.of.shape[1]
    )
    return result, float(np.median(x[1:]))


def _too_little(widest: float) -> str:
    return (
        f"d (computed from the joints) changed by {widest * 1e3:.1f} mm, expected a change of at "
        f"least {_CLOSING_MIN * 1e3:g} mm while both tips are in contact"
    )


def _filtered_closing(closing: FloatArray, response: float) -> tuple[FloatArray, FloatArray]:
    """Return the exponentially weighted mean [m] and variance [m²] of ``closing``."""
    if response == 0.0:
        return closing, np.zeros_like(closing)
    share = -math.expm1(-_STEP / response)
    mean, spread = np.empty_like(closing), np.empty_like(closing)
    last, variance = float(closing[0]), 0.0
    for k, value in enumerate(closing.tolist()):
        behind = value - last
        last += share * behind
        variance = (1.0 - share) * (variance + share * behind * behind)
        mean[k], spread[k] = last, variance
    return mean, spread


def _rate(closing: FloatArray) -> FloatArray:
    """Return the smoothed closing speed [m/s]."""
    around = np.full(round(_RATE_TIME / _STEP) | 1, 1.0)
    smooth = np.convolve(np.pad(closing, around.size // 2, mode="edge"), around, "valid")
    return np.asarray(np.gradient(smooth / around.size, _STEP))


def _ramps(
    t: FloatArray, grid: FloatArray, closing: FloatArray, rate: FloatArray
) -> tuple[NDArray[np.bool_], float]:
    """Return a mask [n, ramps] of the frames in each ramp, and the maximum closing [m]."""
    window = np.ones(2 * round(_RAMP_MARGIN / _STEP) + 1)
    near = np.convolve(np.abs(rate) > _CLOSING_SPEED_MIN, window, "same") > 0.5
    # Index of the ramp at each time of the grid, or 0 outside the ramps.
    number = np.cumsum(near & ~np.append(False, near[:-1])) * near
    index = np.clip(np.searchsorted(grid, t), 0, grid.size - 1)
    widths = {
        k: float(np.ptp(closing[index[number[index] == k]]))
        for k in np.unique(number[index])
        if k > 0
    }
    wide = [k for k, width in widths.items() if width > _CLOSING_MIN]
    return np.equal.outer(number[index], wide), max(widths.values(), default=0.0)
