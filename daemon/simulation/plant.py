"""The kernel that moves the simulated hand: two joints, two soft tips, one rigid rectangle.

Coordinates (q1, q2, x, y, φ) with their velocities, the shear d_t of each tip and the current of
each motor are advanced by fixed sub-steps of a two-stage Rosenbrock method (ROS2, γ = 1 − 1/√2):

    (1 − γhA) k1 = f(y)    (1 − γhA) k2 = f(y + h k1) − 2 k1    y ← y + h (3 k1 + k2)/2

It is of second order whatever matrix A is, and L-stable where A is the Jacobian; A here holds what
is stiff: the tips' normal, turning and shear stiffness with their losses, end stops, friction at
its secant, the motors' lag and the servos' loops. Of the unknowns only the five accelerations are
coupled, and the joints only through the object, so that a step costs two evaluations of the tips
and one 3 × 3 factorisation. Coulomb slip is a return of d_t into its limits at the start of a step.

Only kernels live here; forces are in forces.py and tip.py, places in the memory in layout.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import layout
from daemon.simulation.forces import (
    PALM_LOSS,
    current_reference,
    current_slopes,
    evaluate_hand,
    script_place,
    stop_stiffness,
)
from kinematics.kernels import kernel

FloatArray = NDArray[np.float64]

_GAMMA = 1.0 - math.sqrt(0.5)
_LATER = layout.TIP + 2 * layout.TIP_ROW  # the tips' rows of stage 2


@kernel
def factorise(memory: FloatArray, g: float) -> None:
    """Factorise M + gD + g²K of stage 1 into the matrix; ``g`` = γh.

    Places 0, 1: inverse joint pivots; 2-4 and 5-7: the joints' couplings to (x, y, φ); 8-13: the
    object's 3 × 3 Schur complement as L D Lᵀ (inverse d0, l10, l20, inverse d1, l21, inverse d2).
    """
    a = memory[layout.MASS] + g * memory[layout.DRAG + 2]
    palm = g * (PALM_LOSS + g)
    b = 0.0
    c = memory[layout.MASS] + g * memory[layout.DRAG + 3]
    c += palm * memory[layout.PALM_STIFFNESS]
    d = 0.0
    e = palm * memory[layout.PALM_STIFFNESS + 1]
    f = memory[layout.INERTIA] + g * memory[layout.DRAG + 4]
    f += palm * memory[layout.PALM_STIFFNESS + 2]
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        w_d = g * (memory[row + layout.C_D] + g * memory[row + layout.K_D])
        w_r = g * (memory[row + layout.C_THETA] + g * memory[row + layout.K_THETA])
        w_t = g * (memory[row + layout.C_T] + g * memory[row + layout.K_T])
        d0 = memory[row + layout.JD]
        d1 = memory[row + layout.JD + 1]
        d2 = memory[row + layout.JD + 2]
        d3 = memory[row + layout.JD + 3]
        r0 = memory[row + layout.JTHETA]
        r1 = memory[row + layout.JTHETA + 1]
        r2 = memory[row + layout.JTHETA + 2]
        r3 = memory[row + layout.JTHETA + 3]
        t0 = memory[row + layout.JT]
        t1 = memory[row + layout.JT + 1]
        t2 = memory[row + layout.JT + 2]
        t3 = memory[row + layout.JT + 3]
        stop = stop_stiffness(memory, finger)
        motor = memory[layout.MOTOR + 2 + finger] + g * memory[layout.MOTOR + finger]
        pivot = memory[layout.JOINT_INERTIA] + g * (
            memory[layout.DRAG + finger] + g * (stop + motor)
        )
        pivot += w_d * d0 * d0 + w_r * r0 * r0 + w_t * t0 * t0
        inverse = 0.0 if memory[layout.JOINTS_HELD] != 0.0 else 1.0 / pivot
        u0 = w_d * d0 * d1 + w_r * r0 * r1 + w_t * t0 * t1
        u1 = w_d * d0 * d2 + w_r * r0 * r2 + w_t * t0 * t2
        u2 = w_d * d0 * d3 + w_r * r0 * r3 + w_t * t0 * t3
        memory[layout.MATRIX + finger] = inverse
        memory[layout.MATRIX + 2 + 3 * finger] = u0
        memory[layout.MATRIX + 3 + 3 * finger] = u1
        memory[layout.MATRIX + 4 + 3 * finger] = u2
        a += w_d * d1 * d1 + w_r * r1 * r1 + w_t * t1 * t1 - u0 * u0 * inverse
        b += w_d * d1 * d2 + w_r * r1 * r2 + w_t * t1 * t2 - u0 * u1 * inverse
        c += w_d * d2 * d2 + w_r * r2 * r2 + w_t * t2 * t2 - u1 * u1 * inverse
        d += w_d * d1 * d3 + w_r * r1 * r3 + w_t * t1 * t3 - u0 * u2 * inverse
        e += w_d * d2 * d3 + w_r * r2 * r3 + w_t * t2 * t3 - u1 * u2 * inverse
        f += w_d * d3 * d3 + w_r * r3 * r3 + w_t * t3 * t3 - u2 * u2 * inverse
    free = 0.0 if memory[layout.OBJECT_HELD] != 0.0 else 1.0
    first = 1.0 / a
    l10 = b * first
    l20 = d * first
    second = 1.0 / (c - l10 * b)
    rest = e - l10 * d
    l21 = rest * second
    memory[layout.MATRIX + 8] = free * first
    memory[layout.MATRIX + 9] = l10
    memory[layout.MATRIX + 10] = l20
    memory[layout.MATRIX + 11] = free * second
    memory[layout.MATRIX + 12] = l21
    memory[layout.MATRIX + 13] = free / (f - l20 * d - l21 * rest)


@kernel
def solve(memory: FloatArray, out: int) -> None:
    """Solve the factorised matrix for the load; five results from ``out`` on, held parts 0."""
    m = layout.MATRIX
    r0 = memory[layout.LOAD] * memory[m]
    r1 = memory[layout.LOAD + 1] * memory[m + 1]
    b0 = memory[layout.LOAD + 2] - memory[m + 2] * r0 - memory[m + 5] * r1
    b1 = memory[layout.LOAD + 3] - memory[m + 3] * r0 - memory[m + 6] * r1
    b2 = memory[layout.LOAD + 4] - memory[m + 4] * r0 - memory[m + 7] * r1
    b1 -= memory[m + 9] * b0
    b2 -= memory[m + 10] * b0 + memory[m + 12] * b1
    z2 = b2 * memory[m + 13]
    z1 = b1 * memory[m + 11] - memory[m + 12] * z2
    z0 = b0 * memory[m + 8] - memory[m + 9] * z1 - memory[m + 10] * z2
    memory[out] = r0 - memory[m] * (memory[m + 2] * z0 + memory[m + 3] * z1 + memory[m + 4] * z2)
    memory[out + 1] = r1 - memory[m + 1] * (
        memory[m + 5] * z0 + memory[m + 6] * z1 + memory[m + 7] * z2
    )
    memory[out + 2] = z0
    memory[out + 3] = z1
    memory[out + 4] = z2


@kernel
def row_along(memory: FloatArray, row: int, finger: int, along: int) -> float:
    """A tip's row over (q, x, y, φ) times the coordinates' rates from ``along`` on."""
    rate: float = (
        memory[row] * memory[along + finger]
        + memory[row + 1] * memory[along + 2]
        + memory[row + 2] * memory[along + 3]
        + memory[row + 3] * memory[along + 4]
    )
    return rate


@kernel
def take_stiffness(memory: FloatArray, along: int, shear1: float, shear2: float, g: float) -> None:
    """Take g K r from the load, K of stage 1; r stands from ``along`` on, then both shears."""
    by_y = memory[layout.PALM_STIFFNESS + 1] * memory[along + 4]
    by_turn = memory[layout.PALM_STIFFNESS + 2] * memory[along + 4]
    by_y += memory[layout.PALM_STIFFNESS] * memory[along + 3]
    by_turn += memory[layout.PALM_STIFFNESS + 1] * memory[along + 3]
    memory[layout.LOAD + 3] -= g * by_y
    memory[layout.LOAD + 4] -= g * by_turn
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        at_d = row + layout.JD
        at_r = row + layout.JTHETA
        at_t = row + layout.JT
        by_d = g * memory[row + layout.K_D] * row_along(memory, at_d, finger, along)
        by_r = g * memory[row + layout.K_THETA] * row_along(memory, at_r, finger, along)
        by_t = g * memory[row + layout.K_T] * (shear1 if finger == 0 else shear2)
        memory[layout.LOAD + finger] -= (
            memory[at_d] * by_d + memory[at_r] * by_r + memory[at_t] * by_t
        )
        for j in range(1, 4):
            memory[layout.LOAD + 1 + j] -= (
                memory[at_d + j] * by_d + memory[at_r + j] * by_r + memory[at_t + j] * by_t
            )


@kernel
def shear_along(memory: FloatArray, finger: int, along: int) -> float:
    """Rate of a tip's d_t by stage 1's row for the coordinates' rates from ``along`` on."""
    row = layout.TIP + finger * layout.TIP_ROW + layout.JT
    return row_along(memory, row, finger, along)


@kernel
def sample(memory: FloatArray, ring: FloatArray) -> None:
    """Write the sample that is due into ``ring``, between the recorded tips and stage 1's."""
    h = memory[layout.STEP]
    number = memory[layout.SAMPLES]
    due = number * memory[layout.SAMPLE_PERIOD]
    back = min((memory[layout.STEPS] * h - due) / h, 1.0)
    at = int(number) % ring.shape[0]
    ring[at, layout.SAMPLE_SEQ] = number
    ring[at, layout.SAMPLE_T] = due
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        for place, before, now in (
            (layout.SAMPLE_D, layout.CONTACT_D, layout.D),
            (layout.SAMPLE_THETA, layout.CONTACT_THETA, layout.THETA),
            (layout.SAMPLE_GAIN, layout.CONTACT_GAIN, layout.GAIN),
        ):
            change = memory[row + now] - memory[before + finger]
            ring[at, place + finger] = memory[row + now] - back * change
    memory[layout.SAMPLES] = number + 1.0


@kernel
def settle(memory: FloatArray, ring: FloatArray) -> None:
    """Take the samples that fall due at the state's instant, then record what the tips feel."""
    while (
        memory[layout.SAMPLES] * memory[layout.SAMPLE_PERIOD]
        <= memory[layout.STEPS] * memory[layout.STEP]
    ):
        sample(memory, ring)
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        memory[layout.SHEAR + finger] = memory[row + layout.TIP_SHEAR]
        memory[layout.CONTACT_D + finger] = memory[row + layout.D]
        memory[layout.CONTACT_THETA + finger] = memory[row + layout.THETA]
        memory[layout.CONTACT_GAIN + finger] = memory[row + layout.GAIN]
        memory[layout.CONTACT_FORCE + finger] = memory[row + layout.FORCE]
        memory[layout.CONTACT_NORMAL + finger] = memory[row + layout.NORMAL]
        memory[layout.CONTACT_TANGENTIAL + finger] = memory[row + layout.TANGENTIAL]
        memory[layout.CONTACT_RIM + finger] = memory[row + layout.RIM]
        memory[layout.CONTACT_ENERGY + finger] = memory[row + layout.ENERGY]


@kernel
def bounded(value: float, most: float) -> float:
    """``value`` within ± ``most``."""
    return min(max(value, -most), most)


@kernel
def load_motors(
    memory: FloatArray, stage: int, position: int, velocity: int, h: float, g: float
) -> None:
    """Add the motors' part to the load; the part of the currents' k that doesn't need the solution.

    A current follows its reference with a lag: i' = (r(q, ω) − i)/τ. Its k falls by
    (r_q g + r_ω) g/(τ + g) for each unit of acceleration, which stands in the matrix; stage 1's
    slopes, times the torque constant and over (τ + g), are kept in MOTOR for both.
    """
    lag = memory[layout.ELECTRIC_TIME]
    constant = memory[layout.TORQUE_CONSTANT]
    for j in range(2):
        q = memory[position + j]
        rate = memory[velocity + j]
        reference = current_reference(memory, j, q, rate)
        current = memory[layout.CURRENT + j]
        before = 0.0
        way = rate
        if stage == 1:
            by_q, by_rate = current_slopes(memory, j, g)
            memory[layout.MOTOR + j] = constant * by_q / (lag + g)
            memory[layout.MOTOR + 2 + j] = constant * by_rate / (lag + g)
        else:
            before = memory[layout.FIRST_X + 5 + j]
            way = rate - 2.0 * memory[layout.FIRST_X + j]
            current += h * before
        fall = g * memory[layout.MOTOR + j] * way / constant
        change = (reference - current - 2.0 * lag * before) / (lag + g) - fall
        memory[layout.CHANGE + j] = change
        stop = stop_stiffness(memory, j)
        memory[layout.LOAD + j] += constant * (current + g * change) - g * stop * way


@kernel
def current_change(memory: FloatArray, joint: int, acceleration: float, g: float) -> float:
    """k of a current, for the joint's k of velocity."""
    slope = memory[layout.MOTOR + 2 + joint] + g * memory[layout.MOTOR + joint]
    change: float = (
        memory[layout.CHANGE + joint] - g * slope / memory[layout.TORQUE_CONSTANT] * acceleration
    )
    return change


@kernel
def first_stage(memory: FloatArray, g: float) -> tuple[float, float]:
    """k1 of the coordinates, velocities and currents into FIRST_X, FIRST_V; that of the shears."""
    for j in range(5):
        memory[layout.LOAD + j] = memory[layout.FORCES + j]
    load_motors(memory, 1, layout.POSITION, layout.VELOCITY, 0.0, g)
    factorise(memory, g)
    rate1 = memory[layout.TIP + layout.SHEAR_RATE]
    rate2 = memory[layout.TIP + layout.TIP_ROW + layout.SHEAR_RATE]
    take_stiffness(memory, layout.VELOCITY, rate1, rate2, g)
    solve(memory, layout.FIRST_V)
    for j in range(5):
        memory[layout.FIRST_X + j] = memory[layout.VELOCITY + j] + g * memory[layout.FIRST_V + j]
    for j in range(2):
        acceleration = memory[layout.FIRST_V + j]
        memory[layout.FIRST_X + 5 + j] = current_change(memory, j, acceleration, g)
    return (
        rate1 + g * shear_along(memory, 0, layout.FIRST_V),
        rate2 + g * shear_along(memory, 1, layout.FIRST_V),
    )


@kernel
def second_stage(memory: FloatArray, shear1: float, shear2: float, h: float, g: float) -> None:
    """k2 and the step itself, from stage 2's forces; ``shear1``, ``shear2`` are the shears' k1."""
    for j in range(5):
        inertia = memory[layout.MASS]
        if j < 2:
            inertia = memory[layout.JOINT_INERTIA]
        elif j == 4:
            inertia = memory[layout.INERTIA]
        memory[layout.LOAD + j] = (
            memory[layout.FORCES + j] - 2.0 * inertia * memory[layout.FIRST_V + j]
        )
    load_motors(memory, 2, layout.SECOND_X, layout.SECOND_V, h, g)
    for j in range(5):
        memory[layout.SECOND_X + j] = memory[layout.SECOND_V + j] - 2.0 * memory[layout.FIRST_X + j]
    later1 = memory[_LATER + layout.SHEAR_RATE] - 2.0 * shear1
    later2 = memory[_LATER + layout.TIP_ROW + layout.SHEAR_RATE] - 2.0 * shear2
    take_stiffness(memory, layout.SECOND_X, later1, later2, g)
    solve(memory, layout.SECOND_V)
    later1 += g * shear_along(memory, 0, layout.SECOND_V)
    later2 += g * shear_along(memory, 1, layout.SECOND_V)
    memory[layout.SHEAR] += h * (1.5 * shear1 + 0.5 * later1)
    memory[layout.SHEAR + 1] += h * (1.5 * shear2 + 0.5 * later2)
    for j in range(2):
        before = memory[layout.FIRST_X + 5 + j]
        change = current_change(memory, j, memory[layout.SECOND_V + j], g)
        current = memory[layout.CURRENT + j] + h * (1.5 * before + 0.5 * change)
        memory[layout.CURRENT + j] = bounded(current, 2.0 * memory[layout.STALL_CURRENT])
    first = 2 if memory[layout.JOINTS_HELD] != 0.0 else 0
    last = 2 if memory[layout.OBJECT_HELD] != 0.0 else 5
    for j in range(first, last):
        later = memory[layout.SECOND_X + j] + g * memory[layout.SECOND_V + j]
        way = h * (1.5 * memory[layout.FIRST_X + j] + 0.5 * later)
        change = h * (1.5 * memory[layout.FIRST_V + j] + 0.5 * memory[layout.SECOND_V + j])
        # A step that would carry a tip past a quarter of its radius is far too long for what it
        # is asked: it goes that far, and what it loses by that is energy.
        most = 0.25 * memory[layout.RADIUS]
        if j < 2:
            most /= memory[layout.LENGTH] + abs(memory[layout.OFFSET])
        elif j == 4:
            most /= memory[layout.HALF_WIDTH] + memory[layout.HALF_HEIGHT]
        memory[layout.POSITION + j] += bounded(way, most)
        memory[layout.VELOCITY + j] = bounded(memory[layout.VELOCITY + j] + change, most / h)


@kernel
def step(memory: FloatArray, data: FloatArray, ring: FloatArray, count: int) -> None:
    """Advance the plant in ``memory`` by ``count`` sub-steps; the tips' truth is then current.

    ``data`` is the contact table; ``ring`` (n, layout.SAMPLE) takes the samples that fall due.
    """
    h = memory[layout.STEP]
    g = _GAMMA * h
    held = memory[layout.OBJECT_HELD] != 0.0
    for _ in range(count):
        if held:
            t = memory[layout.STEPS] * h
            way = script_place(memory, t + h) - script_place(memory, t)
            memory[layout.VELOCITY + 2] = way / h
        # Slip: the shears come back within their limits, and settle keeps them there.
        evaluate_hand(
            memory,
            data,
            layout.POSITION,
            layout.VELOCITY,
            layout.TIP,
            memory[layout.SHEAR],
            memory[layout.SHEAR + 1],
        )
        settle(memory, ring)
        shear1, shear2 = first_stage(memory, g)
        for j in range(5):
            memory[layout.SECOND_X + j] = (
                memory[layout.POSITION + j] + h * memory[layout.FIRST_X + j]
            )
            memory[layout.SECOND_V + j] = (
                memory[layout.VELOCITY + j] + h * memory[layout.FIRST_V + j]
            )
        evaluate_hand(
            memory,
            data,
            layout.SECOND_X,
            layout.SECOND_V,
            _LATER,
            memory[layout.SHEAR] + h * shear1,
            memory[layout.SHEAR + 1] + h * shear2,
        )
        second_stage(memory, shear1, shear2, h, g)
        memory[layout.STEPS] += 1.0
        if held:
            memory[layout.POSITION + 2] = script_place(memory, memory[layout.STEPS] * h)
    evaluate_hand(
        memory,
        data,
        layout.POSITION,
        layout.VELOCITY,
        layout.TIP,
        memory[layout.SHEAR],
        memory[layout.SHEAR + 1],
    )
    settle(memory, ring)
