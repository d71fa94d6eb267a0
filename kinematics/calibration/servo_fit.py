"""Fit a servo's friction to motion in free air, and its heating to a hold of several minutes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.hand.servo_heat import (
    COPPER,
    ROOM_TEMPERATURE,
    HeatLaw,
    convection_factor,
)

FloatArray = NDArray[np.float64]

# Friction
_DURATION_MAX = 3600.0  # maximum recording time [s]
_GRID_STEP = 0.01  # step of the time grid for motion and torque [s]
_WINDOW = 6  # half width of the window for velocity and acceleration, in steps
_GAP_MAX = 0.035  # maximum gap that is interpolated [s]
# Static friction has mostly vanished above this speed [rad/s]. For the XL330, a speed of 0.12 rad/s
# is sufficient.
_SLIDING_SPEED = 0.2
# A joint is stationary below this speed [rad/s], which is one encoder count (1.5 mrad) in 0.08 s.
_REST_SPEED = 0.02
# Minimum rotation at break-away [rad]. The value is three encoder counts, or ten times the elastic
# deflection of the gears.
_BREAK_AWAY_DISTANCE = 5e-3
# Maximum goal velocity at break-away [rad/s], and number of steps over which the velocity is
# averaged. The limit keeps the inertial torque small.
_BREAK_AWAY_RATE = 0.1, 20
_MOTION_TIME_MIN = 0.5  # minimum motion time in each direction [s]
_CORRELATION_TIME = 0.2  # correlation time of the residuals [s]
_BREAK_AWAY_COUNT_MIN = 3  # minimum number of break-aways to average
# Prior mean and standard deviation of the viscous friction [N·m·s/rad]. Values identified for
# similar servos range from 0.015 to 0.051 (model M4 of Rhoban's BAM, arXiv 2410.08650).
_VISCOUS_PRIOR = 0.02, 0.02
_INERTIA_ERROR = 0.5  # relative standard deviation of the configured inertia


class FrictionFit(NamedTuple):
    """Friction of one joint [N·m] with standard deviations."""

    coulomb: float
    coulomb_std: float
    viscous: float  # [N·m·s/rad]
    viscous_std: float
    stiction: float  # break-away friction; NaN if fewer than three slow starts were recorded
    stiction_std: float


def fit_friction(
    t: ArrayLike,
    q: ArrayLike,
    goal: ArrayLike,
    torque: ArrayLike,
    inertia: float,
    step: float,
) -> FrictionFit:
    """Fit the friction of a joint to reciprocating motion in free air by least squares.

    While the joint moves, the motor torque is

        torque = F sign(q̇) + b q̇ + J q̈ + c0 + c1 q + c2 q²

    where F is the Coulomb friction and b ≥ 0 is the viscous friction. The polynomial in q models
    the torques that do not depend on the direction of motion. These torques are due to weight,
    cables and the current offset. The break-away friction is the maximum torque when a joint at
    standstill starts to follow a slowly moving goal.

    Parameters
    ----------
    t, q, goal, torque
        Time [s], joint angle and goal angle [rad], motor torque [N·m].
    inertia
        J [kg·m²], known to within 50 %.
    step
        Torque resolution [N·m].

    Raises
    ------
    CalibrationError
        If the joint moves for less than 0.5 s in either direction, if the samples are 35 ms or more
        apart, or if the data are longer than an hour.
    """
    at, angle, led, given = (np.asarray(each, np.float64) for each in (t, q, goal, torque))
    grid = time_grid(at, _GRID_STEP)
    if grid.size <= 2 * _WINDOW:
        raise CalibrationError(_too_little(0.0, 0.0))
    shown, push = np.interp(grid, at, angle), np.interp(grid, at, given)
    place, rate, acceleration = _motion(shown)
    after = np.clip(np.searchsorted(at, grid, "right"), 1, at.size - 1)
    whole = at[after] - at[after - 1] < _GAP_MAX
    # Use a sample only if the direction of motion is constant throughout its smoothing window.
    closes, opens = (_throughout(whole & (sign * rate > _SLIDING_SPEED)) for sign in (1.0, -1.0))
    seconds = [float(np.count_nonzero(each)) * _GRID_STEP for each in (closes, opens)]
    if (interval := float(np.median(np.diff(at)))) >= _GAP_MAX:
        raise CalibrationError(
            f"found a state every {interval * 1e3:.0f} ms, expected less than "
            f"{_GAP_MAX * 1e3:.0f} ms between states: increase stream.state_rate"
        )
    if min(seconds) < _MOTION_TIME_MIN:
        raise CalibrationError(_too_little(*seconds))
    used = closes | opens
    x = place - place[used].mean()
    columns = np.stack([np.sign(rate), rate, acceleration, x**0, x, x * x], axis=1)
    found, std = _least_squares(columns[used], push[used], inertia, step)
    breaks = _break_aways(shown, rate, push - columns[:, 3:] @ found[3:], np.interp(grid, at, led))
    stiction, stiction_std = (
        breaks.mean(axis=0) if len(breaks) >= _BREAK_AWAY_COUNT_MIN else (math.nan, math.nan)
    )
    return FrictionFit(
        max(float(found[0]), 0.0),
        float(std[0]),
        float(found[1]),
        float(std[1]),
        float(stiction),
        math.hypot(float(stiction_std), step / math.sqrt(12.0)),
    )


def time_grid(t: FloatArray, step: float) -> FloatArray:
    """Return times from the first to the last of ``t`` [s] at intervals of ``step`` [s].

    Raises CalibrationError if the data are longer than an hour, which limits the memory use.
    """
    first, last = (t[0], t[-1]) if t.size else (0.0, 0.0)
    if last - first > _DURATION_MAX:
        raise CalibrationError(
            f"found {last - first:.0f} s of data, expected at most {_DURATION_MAX:g} s"
        )
    return np.arange(first, last, step)


def _too_little(closing: float, opening: float) -> str:
    return (
        f"found {closing:.1f} s of closing motion and {opening:.1f} s of opening motion, expected "
        f"at least {_MOTION_TIME_MIN:g} s of each; the joint must move faster than "
        f"{_SLIDING_SPEED:g} rad/s and without contact"
    )


def _motion(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return angle, velocity and acceleration from a parabola fitted around each instant."""
    offsets = _GRID_STEP * np.arange(-_WINDOW, _WINDOW + 1)
    fits = np.linalg.pinv(np.stack([offsets**0, offsets, 0.5 * offsets**2], axis=1))
    padded = np.pad(q, _WINDOW, mode="edge")
    place, rate, acceleration = (np.convolve(padded, fit[::-1], "valid") for fit in fits)
    return place, rate, acceleration


def _throughout(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of the instants around which ``holds`` is True throughout the window."""
    size = 2 * _WINDOW + 1
    return np.convolve(np.pad(holds, _WINDOW), np.ones(size), "valid") > size - 0.5


def _least_squares(
    columns: FloatArray, values: FloatArray, inertia: float, step: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least-squares solution with priors, and its standard deviations."""
    prior = np.array([0.0, _VISCOUS_PRIOR[0], inertia, 0.0, 0.0, 0.0])
    weight = np.diag(
        [0.0, _VISCOUS_PRIOR[1] ** -2, (_INERTIA_ERROR * inertia) ** -2, 0.0, 0.0, 0.0]
    )
    rounding = step * step / 12.0
    variance = rounding
    for _ in range(2):  # The second pass uses the noise estimate from the first pass.
        per_sample = _GRID_STEP / _CORRELATION_TIME / variance
        covariance = np.linalg.inv(per_sample * columns.T @ columns + weight)
        found = covariance @ (per_sample * columns.T @ values + weight @ prior)
        variance = max(float(np.mean((values - columns @ found) ** 2)), rounding)
    std = np.sqrt(np.diag(covariance))
    if found[1] < 0.0:  # b cannot be negative, so use the solution for b = 0
        found = found - covariance[:, 1] * (found[1] / covariance[1, 1])
    # At a constant current, the quantisation error is constant, so averaging does not reduce it.
    std[0] = math.hypot(float(std[0]), math.sqrt(rounding))
    return found, std


def _break_aways(q: FloatArray, rate: FloatArray, push: FloatArray, goal: FloatArray) -> FloatArray:
    """Return the torque and its standard deviation for each slow start from standstill, [n, 2].

    The goal and the torque increase in whole counts. The break-away torque is therefore between the
    maximum torque and the torque one step earlier.
    """
    found = []
    speed, steps = _BREAK_AWAY_RATE
    rests = _throughout(np.abs(rate) < _REST_SPEED)
    for last in np.flatnonzero(rests[:-1] & ~rests[1:]):
        way = q[last:] - q[last]
        away = np.flatnonzero(np.abs(way) > _BREAK_AWAY_DISTANCE)
        if not away.size:
            continue
        led = goal[max(last - steps, 0) : last + int(away[0]) + steps]
        if np.abs(led[steps:] - led[:-steps]).max(initial=0.0) > speed * steps * _GRID_STEP:
            continue
        toward = math.copysign(1.0, way[away[0]]) * push[last : last + away[0] + 1]
        most = int(toward.argmax())
        held, largest = toward[max(most - 1, 0)], toward[most]
        found.append((0.5 * (held + largest), (largest - held) / math.sqrt(12.0)))
    return np.array(found).reshape(-1, 2)


# Heat

_PRIOR_STD = (0.4, 0.4, 3.0)  # prior σ of rise and time (relative), and of ambient temperature [°C]
# Standard deviation of a reading [°C], including the rounding to whole degrees.
_READING_ERROR = 0.4
_HEAT_STEP = 1.0  # s
_RISE_MIN = 8.0  # minimum temperature rise of the case [°C]
_RESIDUAL_MAX = 2.0  # maximum rms error of the readings [°C], five times the error of a reading
_ITERATIONS = 12


class HeatFit(NamedTuple):
    """Factors that scale the ``rise`` and ``time`` of the model, with standard deviations."""

    rise: float
    rise_std: float
    time: float
    time_std: float
    residual: float  # rms error of the readings [°C]


def _forecast(law: HeatLaw, squares: list[float], x: FloatArray, start: float) -> FloatArray:
    """Predict the case temperature [°C] from squared currents [A²] at intervals of _HEAT_STEP.

    The model is defined in `hand.servo_heat`. The winding and the case start at the temperature
    ``start`` [°C]. ``x`` contains the logarithms of the factors, and the ambient temperature [°C].
    """
    winding = case = start
    rise, time, ambient = np.exp(x[0]), np.exp(x[1]), x[2]
    heating, inner, outer = law.heating * rise / time, law.winding_time * time, law.case_time * time
    out = []
    for square in squares:
        out.append(case)
        flow, over = (winding - case) / inner, case - ambient
        copper = 1.0 + COPPER * (winding - ROOM_TEMPERATURE)
        winding += _HEAT_STEP * (heating * square * copper - flow)
        case += _HEAT_STEP * (law.share * flow - over * convection_factor(over) / outer)
    return np.array(out)


@np.errstate(over="ignore", invalid="ignore")
def fit_heat(law: HeatLaw, t: ArrayLike, current: ArrayLike, reading: ArrayLike) -> HeatFit:
    """Fit the thermal model to a hold that starts at room temperature.

    ``current`` [A] and ``reading`` [°C] are sampled at the times ``t`` [s]. ``law`` contains the
    constants of the servo model, which are known to within 40 %. The Gauss-Newton method fits the
    logarithms of the factors. Raises CalibrationError if the case temperature rises by less than 8
    °C, if there is no current, if the data are longer than an hour, or if the model does not fit
    the readings.
    """
    at, square, shown = (np.asarray(each, np.float64) for each in (t, np.square(current), reading))
    warmed = float(shown.max() - shown[0]) if shown.size else 0.0
    if warmed < _RISE_MIN:
        raise CalibrationError(
            f"heat: found a temperature rise of {warmed:.0f} °C, expected at least {_RISE_MIN:g} "
            "°C: hold the grip longer, or use more force"
        )
    if not square.max() > 0.0:
        raise CalibrationError("heat: found no current, expected a servo that measures its current")
    grid = time_grid(at, _HEAT_STEP)
    squares, readings = np.interp(grid, at, square).tolist(), np.interp(grid, at, shown)
    prior = np.array([0.0, 0.0, shown[0]])

    def misses(x: FloatArray) -> FloatArray:
        return _forecast(law, squares, x, shown[0]) - readings

    def rows(x: FloatArray) -> FloatArray:
        # Equal readings share one rounding error, so a group of equal readings has the weight of
        # one reading.
        weight = np.sqrt(warmed / grid.size) / _READING_ERROR
        return np.concatenate([misses(x) * weight, (x - prior) / _PRIOR_STD])

    x, off, steps = prior.copy(), rows(prior), np.array([1e-3, 1e-3, 1e-2])
    for _ in range(_ITERATIONS):
        slopes = np.stack([(rows(x + step) - off) / step.max() for step in np.diag(steps)], axis=1)
        if not np.isfinite(slopes).all():
            break
        x -= np.linalg.lstsq(slopes, off, rcond=None)[0]
        off = rows(x)
    rise, time = float(np.exp(x[0])), float(np.exp(x[1]))
    residual = float(np.sqrt(np.mean(misses(x) ** 2)))
    if not residual < _RESIDUAL_MAX:
        raise CalibrationError(
            f"heat: found a residual of {residual:.3g} °C, expected less than {_RESIDUAL_MAX:g} "
            "°C; record one grip that starts with a cold servo"
        )
    std = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    return HeatFit(rise, rise * float(std[0]), time, time * float(std[1]), residual)
