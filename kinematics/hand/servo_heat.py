"""Kalman filter for the winding and case temperatures of a servo.

    Ẇ = k r I² (1 + α (W − 25 °C)) − (W − C)/τ_w      winding
    Ċ = s (W − C)/τ_w − g (C − A)/τ_c                 case, measured by the servo in steps of 1 °C
    A, k random walks                                 ambient; heating relative to the model

Here r = R/C_w, s = C_w/C_c, τ_w = C_w R_wc and τ_c = C_c R_ca. R is the electrical resistance, C_w
and C_c are heat capacities, and R_wc and R_ca are thermal resistances. The constant α is the
temperature coefficient of copper, and g = ((C − A)/30 K)^(1/4) describes natural convection. The
terms with α and g are evaluated at the current estimate. If I² is known, all other terms of the
model are linear. A constant reading contains little information. A step in the reading determines
the case temperature accurately.
"""

from __future__ import annotations

import math
from typing import Annotated

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray, Record, Records

WINDING, CASE, AMBIENT, HEATING = range(4)
COPPER = 0.0039  # temperature coefficient of the winding's resistance [1/K]
TIME_MAX = 3600.0  # upper bound on the computed time to a temperature limit [s]
ROOM_TEMPERATURE = 25.0  # °C
_CONVECTION_DIFFERENCE = 30.0  # difference from ambient temperature at which τ_c is defined [K]
_INITIAL_STD = (6.0, 0.5, 8.0, 0.35)  # initial standard deviations of W, C, A [°C] and k
_RANDOM_WALK = (0.03, 0.01, 0.2, 0.01)  # random walks of W, C, A [°C/√s] and k [1/√s]
_STEP_STD = 0.12  # standard deviation of the case temperature at a change in the reading [°C]
_STAY_STD = 6.0  # standard deviation of a reading that has been constant for 1 s [°C]
_COUPLING = 0.25  # error of W due to an error in τ_w, which is not observable; relative to W − C


class HeatLaw(Record):
    """Thermal constants of one servo."""

    heating: float  # r [K/(A² s)]
    winding_time: float  # τ_w [s]
    share: float  # s
    case_time: float  # τ_c [s]


class HeatState(Record):
    """Temperature estimate of one servo."""

    law: HeatLaw
    known: bool  # True after the first reading
    reading: float  # last reading [°C]
    x: Annotated[FloatArray, 4]  # W, C, A [°C], k
    p: Annotated[FloatArray, 4, 4]  # covariance of x
    scratch: Annotated[FloatArray, 4, 4]


@kernel
def follow(states: Records[HeatState], square: float, dt: float, reading: float) -> None:
    """Predict over ``dt`` [s] with mean squared current [A²], then update with ``reading`` [°C]."""
    s = states[0]
    if not s.known:
        s.known = True
        s.reading = reading
        for i in range(4):
            s.p[i, i] = _INITIAL_STD[i] * _INITIAL_STD[i]
        s.x[WINDING] = s.x[CASE] = reading
        s.x[AMBIENT] = min(reading, ROOM_TEMPERATURE)
        s.x[HEATING] = 1.0
        return
    _predict(s, square, dt)
    stepped = reading - s.reading
    if abs(stepped) > 1.0:  # The filter has missed some steps, or the sensor has been replaced.
        _correct(s, reading, 1.0)
    elif stepped != 0.0:
        _correct(s, reading - 0.5 * stepped, _STEP_STD * _STEP_STD)
    else:
        _correct(s, reading, _STAY_STD * _STAY_STD / dt)
    s.reading = reading


def convection_factor(over: float) -> float:
    """Return the convection factor g for a case ``over`` K (at least 1 K) above ambient."""
    return math.sqrt(math.sqrt(max(over, 1.0) / _CONVECTION_DIFFERENCE))


_convection_factor = inner_kernel(convection_factor)


@inner_kernel
def _predict(s: HeatState, square: float, dt: float) -> None:
    law, x, p, f = s.law, s.x, s.p, s.scratch
    heating = law.heating * square * (1.0 + COPPER * (x[WINDING] - ROOM_TEMPERATURE))
    flow = (x[WINDING] - x[CASE]) / law.winding_time
    loss = _convection_factor(x[CASE] - x[AMBIENT]) / law.case_time
    f[:] = 0.0
    for i in range(4):
        f[i, i] = 1.0
    f[WINDING, WINDING] += dt * (
        law.heating * square * x[HEATING] * COPPER - 1.0 / law.winding_time
    )
    f[WINDING, CASE] = dt / law.winding_time
    f[WINDING, HEATING] = dt * heating
    f[CASE, WINDING] = dt * law.share / law.winding_time
    f[CASE, CASE] -= dt * (law.share / law.winding_time + 1.25 * loss)
    f[CASE, AMBIENT] = dt * 1.25 * loss
    x[WINDING] += dt * (x[HEATING] * heating - flow)
    x[CASE] += dt * (law.share * flow - (x[CASE] - x[AMBIENT]) * loss)
    for i in range(4):  # Compute P Fᵀ in place, row by row.
        row0, row1, row2, row3 = p[i, 0], p[i, 1], p[i, 2], p[i, 3]
        for j in range(4):
            p[i, j] = row0 * f[j, 0] + row1 * f[j, 1] + row2 * f[j, 2] + row3 * f[j, 3]
    for j in range(4):  # Compute F (P Fᵀ) in place, column by column.
        row0, row1, row2, row3 = p[0, j], p[1, j], p[2, j], p[3, j]
        for i in range(4):
            p[i, j] = f[i, 0] * row0 + f[i, 1] * row1 + f[i, 2] * row2 + f[i, 3] * row3
    for i in range(4):
        p[i, i] += _RANDOM_WALK[i] * _RANDOM_WALK[i] * dt


@inner_kernel
def _correct(s: HeatState, case: float, variance: float) -> None:
    x, p = s.x, s.p
    off = case - x[CASE]
    total = p[CASE, CASE] + variance
    column0, column1, column2, column3 = p[0, CASE], p[1, CASE], p[2, CASE], p[3, CASE]
    column = (column0, column1, column2, column3)
    for i in range(4):
        x[i] += column[i] / total * off
    for i in range(4):
        for j in range(4):
            p[i, j] -= column[i] * column[j] / total
    x[HEATING] = max(x[HEATING], 0.1)


def winding_std(s: HeatState) -> float:
    """Return the standard deviation of the winding temperature [°C]."""
    coupling = _COUPLING * (s.x[WINDING] - s.x[CASE])
    return math.sqrt(max(s.p[WINDING, WINDING], 0.0) + coupling * coupling)


@kernel
def time_to_limit(states: Records[HeatState], square: float, limit: float) -> float:
    """Return the time [s] until the case reaches ``limit`` [°C] at a mean squared current [A²].

    The result is at most TIME_MAX. The winding temperature is integrated implicitly, so large time
    steps are stable.
    """
    s = states[0]
    law = s.law
    winding, case, ambient = s.x[WINDING], s.x[CASE], s.x[AMBIENT]
    heating = law.heating * square * s.x[HEATING]
    t = 0.0
    while t < TIME_MAX:
        if case >= limit:
            return t
        dt = 1.0 + 0.02 * t
        source = heating * (1.0 - COPPER * ROOM_TEMPERATURE) + case / law.winding_time
        loss = 1.0 / law.winding_time - heating * COPPER
        winding = (winding + dt * source) / max(1.0 + dt * loss, 0.1)
        outward = (case - ambient) * _convection_factor(case - ambient) / law.case_time
        rate = law.share * (winding - case) / law.winding_time - outward
        if rate > 0.0 and case + dt * rate >= limit:
            left: float = t + (limit - case) / rate
            return min(left, TIME_MAX)
        case += dt * rate
        t += dt
    return TIME_MAX


def sustained_square(s: HeatState, limit: float) -> float:
    """Return the mean squared current [A²] at which the case settles at ``limit`` [°C]."""
    law = s.law
    over = max(limit - s.x[AMBIENT], 0.0)
    flow = over * convection_factor(over) / (law.case_time * law.share)  # (W − C)/τ_w [K/s]
    winding = limit + flow * law.winding_time
    heating = law.heating * s.x[HEATING] * (1.0 + COPPER * (winding - ROOM_TEMPERATURE))
    return float(flow / heating)
