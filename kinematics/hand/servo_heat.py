"""Heat of a servo's motor: winding and case, followed by a Kalman filter on its own thermometer.

    Ẇ = k r I² (1 + α (W − 25 °C)) − (W − C)/τ_w      winding
    Ċ = s (W − C)/τ_w − g (C − A)/τ_c                 case, which the servo reads in steps of 1 °C
    A, k wander                                       ambient; heating over the model's

r = R/C_w, s = C_w/C_c, τ_w = C_w R_wc, τ_c = C_c R_ca, of resistance, heat capacities and thermal
resistances; α is copper's, and g = ((C − A)/30 K)^(1/4) of a body that air cools by rising from it.
With I² known all else is linear; these two are taken at the estimate. A reading says little while
it stays, and where the case is when it steps.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records

FloatArray = NDArray[np.float64]

WINDING, CASE, AMBIENT, HEATING = range(4)
COPPER = 0.0039  # 1/K, of a winding's resistance
LONGEST = 3600.0  # s, the longest time to a limit that is told
_ROOM = 25.0  # °C
_STILL = 30.0  # K over the air for which τ_c holds
_FIRST = (6.0, 0.5, 8.0, 0.35)  # standard deviations at the first reading [°C], of k relative
_WANDER = (0.03, 0.01, 0.2, 0.01)  # and what they gain in a second's square root
_STEP_STD = 0.12  # °C, of the case where its reading steps
_STAY_STD = 6.0  # °C, of a reading a second that stays: as likely anywhere in its step
_COUPLING = 0.25  # of W − C that τ_w may be off by: nothing shows it


class HeatLaw(Record):
    """Constants of one servo."""

    heating: float  # r [K/(A² s)]
    winding_time: float  # τ_w [s]
    share: float  # s
    case_time: float  # τ_c [s]


class HeatState(Record):
    """Estimate of one servo's temperatures."""

    law: HeatLaw
    known: bool  # a reading has come
    reading: float  # the last one [°C]
    x: Annotated[FloatArray, 4]  # W, C, A [°C], k
    p: Annotated[FloatArray, 4, 4]  # their covariance
    scratch: Annotated[FloatArray, 4, 4]


@kernel
def follow(states: Records[HeatState], square: float, dt: float, reading: float) -> None:
    """Go on by ``dt`` [s] with the mean ``square`` of the current [A²], then take a ``reading``."""
    s = states[0]
    if not s.known:
        s.known = True
        s.reading = reading
        for i in range(4):
            s.p[i, i] = _FIRST[i] * _FIRST[i]
        s.x[WINDING] = s.x[CASE] = reading
        s.x[AMBIENT] = min(reading, _ROOM)
        s.x[HEATING] = 1.0
        return
    _predict(s, square, dt)
    stepped = reading - s.reading
    if abs(stepped) > 1.0:  # missed steps, or another thermometer
        _correct(s, reading, 1.0)
    elif stepped != 0.0:
        _correct(s, reading - 0.5 * stepped, _STEP_STD * _STEP_STD)
    else:
        _correct(s, reading, _STAY_STD * _STAY_STD / dt)
    s.reading = reading


@inner_kernel
def _draught(over: float) -> float:
    """Return g of a case ``over`` K warmer than the air; some air always moves."""
    return math.sqrt(math.sqrt(max(over, 1.0) / _STILL))


@inner_kernel
def _predict(s: HeatState, square: float, dt: float) -> None:
    law, x, p, f = s.law, s.x, s.p, s.scratch
    heating = law.heating * square * (1.0 + COPPER * (x[WINDING] - _ROOM))
    flow = (x[WINDING] - x[CASE]) / law.winding_time
    loss = _draught(x[CASE] - x[AMBIENT]) / law.case_time
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
    for i in range(4):  # P Fᵀ, a row in place
        row0, row1, row2, row3 = p[i, 0], p[i, 1], p[i, 2], p[i, 3]
        for j in range(4):
            p[i, j] = row0 * f[j, 0] + row1 * f[j, 1] + row2 * f[j, 2] + row3 * f[j, 3]
    for j in range(4):  # F of that, a column in place
        row0, row1, row2, row3 = p[0, j], p[1, j], p[2, j], p[3, j]
        for i in range(4):
            p[i, j] = f[i, 0] * row0 + f[i, 1] * row1 + f[i, 2] * row2 + f[i, 3] * row3
    for i in range(4):
        p[i, i] += _WANDER[i] * _WANDER[i] * dt


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


@kernel
def winding_std(states: Records[HeatState]) -> float:
    """Return the standard deviation of the winding's temperature [°C]."""
    s = states[0]
    coupling = _COUPLING * (s.x[WINDING] - s.x[CASE])
    return math.sqrt(max(s.p[WINDING, WINDING], 0.0) + coupling * coupling)


@kernel
def time_to_limit(states: Records[HeatState], square: float, limit: float) -> float:
    """Return when the case comes to ``limit`` [°C] with a mean ``square`` of the current [A²]; s.

    LONGEST where it does not within that. The winding is stepped implicitly, so steps may grow.
    """
    s = states[0]
    law = s.law
    winding, case, ambient = s.x[WINDING], s.x[CASE], s.x[AMBIENT]
    heating = law.heating * square * s.x[HEATING]
    t = 0.0
    while t < LONGEST:
        if case >= limit:
            return t
        dt = 1.0 + 0.02 * t
        source = heating * (1.0 - COPPER * _ROOM) + case / law.winding_time
        loss = 1.0 / law.winding_time - heating * COPPER
        winding = (winding + dt * source) / max(1.0 + dt * loss, 0.1)
        outward = (case - ambient) * _draught(case - ambient) / law.case_time
        rate = law.share * (winding - case) / law.winding_time - outward
        if rate > 0.0 and case + dt * rate >= limit:
            left: float = t + (limit - case) / rate
            return min(left, LONGEST)
        case += dt * rate
        t += dt
    return LONGEST


@kernel
def lasting_square(states: Records[HeatState], limit: float) -> float:
    """Return the mean square of the current [A²] with which the case settles at ``limit`` [°C]."""
    s = states[0]
    law = s.law
    over = max(limit - s.x[AMBIENT], 0.0)
    flow = over * _draught(over) / (law.case_time * law.share)  # (W − C)/τ_w [K/s]
    winding = limit + flow * law.winding_time
    heating = law.heating * s.x[HEATING] * (1.0 + COPPER * (winding - _ROOM))
    square: float = flow / heating
    return square
