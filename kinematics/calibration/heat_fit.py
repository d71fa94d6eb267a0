"""Fit a servo's thermal model (temperature rise and time constant) to a hold of several minutes."""

from __future__ import annotations

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

_PRIOR_STD = (0.4, 0.4, 3.0)  # prior σ of rise and time (relative), and of ambient temperature [°C]
# Standard deviation of a reading [°C], including the rounding to whole degrees.
_READING_ERROR = 0.4
_STEP = 1.0  # s
_RISE_MIN = 8.0  # minimum temperature rise of the case [°C]
_RESIDUAL_MAX = 2.0  # maximum rms error of the readings [°C], five times the error of a reading
_ITERATIONS = 12


class HeatFit(NamedTuple):
    """Factors that scale the ``rise`` and ``time`` of the model, with standard deviations."""

    rise: float
    rise_std: float
    time: float
    time_std: float
    ambient: float  # °C
    residual: float  # rms error of the readings [°C]


def forecast(
    law: HeatLaw,
    squares: NDArray[np.float64],
    rise: float,
    time: float,
    start: float,
    ambient: float,
) -> NDArray[np.float64]:
    """Predict the case temperature [°C] from squared currents [A²] sampled at intervals of _STEP.

    The model is defined in `hand.servo_heat`. The winding and the case start at the temperature
    ``start`` [°C]. ``rise`` and ``time`` scale the model constants.
    """
    winding = case = start
    heating, inner, outer = law.heating * rise / time, law.winding_time * time, law.case_time * time
    out = []
    for square in squares.tolist():
        out.append(case)
        flow, over = (winding - case) / inner, case - ambient
        copper = 1.0 + COPPER * (winding - ROOM_TEMPERATURE)
        winding += _STEP * (heating * square * copper - flow)
        case += _STEP * (law.share * flow - over * convection_factor(over) / outer)
    return np.array(out)


@np.errstate(over="ignore", invalid="ignore")
def fit_heat(law: HeatLaw, t: ArrayLike, current: ArrayLike, reading: ArrayLike) -> HeatFit:
    """Fit the thermal model to a hold that starts at room temperature.

    ``current`` [A] and ``reading`` [°C] are sampled at the times ``t`` [s]. ``law`` contains the
    constants of the servo model, which are known to within 40 %. The Gauss-Newton method fits the
    logarithms of the factors. Raises CalibrationError if the case temperature rises by less than 8
    °C, if there is no current, or if the model does not fit the readings.
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
    grid = np.arange(at[0], at[-1], _STEP)
    squares, readings = np.interp(grid, at, square), np.interp(grid, at, shown)
    prior = np.array([0.0, 0.0, shown[0]])

    def rows(x: NDArray[np.float64]) -> NDArray[np.float64]:
        case = forecast(law, squares, np.exp(x[0]), np.exp(x[1]), shown[0], x[2])
        # Equal readings share one rounding error, so a group of equal readings has the weight of
        # one reading.
        weight = np.sqrt(warmed / grid.size) / _READING_ERROR
        return np.concatenate([(case - readings) * weight, (x - prior) / _PRIOR_STD])

    x, off, steps = prior.copy(), rows(prior), np.array([1e-3, 1e-3, 1e-2])
    for _ in range(_ITERATIONS):
        slopes = np.stack([(rows(x + step) - off) / step.max() for step in np.diag(steps)], axis=1)
        if not np.isfinite(slopes).all():
            break
        x -= np.linalg.lstsq(slopes, off, rcond=None)[0]
        off = rows(x)
    rise, time = float(np.exp(x[0])), float(np.exp(x[1]))
    case = forecast(law, squares, rise, time, shown[0], x[2])
    residual = float(np.sqrt(np.mean((case - readings) ** 2)))
    if not residual < _RESIDUAL_MAX:
        raise CalibrationError(
            f"heat: found a residual of {residual:.3g} °C, expected less than {_RESIDUAL_MAX:g} "
            "°C; record one grip that starts with a cold servo"
        )
    std = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    return HeatFit(rise, rise * float(std[0]), time, time * float(std[1]), float(x[2]), residual)
