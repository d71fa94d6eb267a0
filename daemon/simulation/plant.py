"""The kernel that moves the simulated hand: two joints, two soft tips, one rigid rectangle.

Coordinates (q1, q2, x, y, φ) with their velocities, the shear d_t of each tip and the current of
each motor are advanced by fixed sub-steps of a two-stage Rosenbrock method (ROS2, γ = 1 − 1/√2):

    (1 − γhA) k1 = f(y)    (1 − γhA) k2 = f(y + h k1) − 2 k1    y ← y + h (3 k1 + k2)/2

It is of second order whatever matrix A is, and L-stable where A is the Jacobian; A here holds what
is stiff: the tips' normal, turning and shear stiffness with their losses, end stops, friction at
its secant, the motors' lag. Of the unknowns only the five accelerations are coupled, and the joints
only through the object, so that a step costs two evaluations of the tips and one 3 × 3
factorisation. Coulomb slip is a return of d_t into its limits at the start of a step.

Only kernels live here; the forces are in forces.py, the layout of the arrays in layout.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import tip as tips
from daemon.simulation.forces import current_reference, evaluate_hand, script_place
from daemon.simulation.layout import (
    CONTACT_D,
    CONTACT_FORCE,
    CONTACT_GAIN,
    CONTACT_NORMAL,
    CONTACT_RIM,
    CONTACT_TANGENTIAL,
    CONTACT_THETA,
    CURRENT,
    CURRENT_LIMIT,
    DRAG,
    ELECTRIC_TIME,
    FIRST_V,
    FIRST_X,
    FORCES,
    INERTIA,
    JOINT_INERTIA,
    JOINTS_HELD,
    MASS,
    MATRIX,
    OBJECT_HELD,
    POSITION,
    RIGHT,
    SAMPLE_D,
    SAMPLE_GAIN,
    SAMPLE_PERIOD,
    SAMPLE_SEQ,
    SAMPLE_T,
    SAMPLE_THETA,
    SAMPLES,
    SECOND_V,
    SECOND_X,
    SHEAR,
    STEP,
    STEPS,
    STOP_HIGH,
    STOP_LOW,
    STOP_STIFFNESS,
    TORQUE_CONSTANT,
    VELOCITY,
)
from kinematics.kernels import kernel

FloatArray = NDArray[np.float64]


_GAMMA = 1.0 - math.sqrt(0.5)


@kernel
def factorise(position: FloatArray, params: FloatArray, work: FloatArray, g: float) -> None:
    """Factorise M + gD + g²K of stage 1 into the matrix row; ``g`` = γh.

    Places 0, 1: inverse joint pivots; 2-4 and 5-7: the joints' couplings to (x, y, φ); 8-13: the
    object's 3 × 3 Schur complement as L D Lᵀ (inverse d0, l10, l20, inverse d1, l21, inverse d2).
    """
    m = work[MATRIX]
    drag = work[DRAG]
    a = params[MASS] + g * drag[2]
    c = params[MASS] + g * drag[3]
    f = params[INERTIA] + g * drag[4]
    b = 0.0
    d = 0.0
    e = 0.0
    for finger in range(2):
        q = position[finger]
        pivot = params[JOINT_INERTIA] + g * drag[finger]
        if q < params[STOP_LOW + finger] or q > params[STOP_HIGH + finger]:
            pivot += g * g * params[STOP_STIFFNESS]
        out = work[finger]
        side = 1.0 - 2.0 * finger
        w_d = g * (out[tips.C_D] + g * out[tips.K_D])
        w_theta = g * (out[tips.C_THETA] + g * out[tips.K_THETA])
        w_t = g * (out[tips.C_T] + g * out[tips.K_T])
        d0, d1, d2, d3 = out[tips.JD], out[tips.JD + 1], out[tips.JD + 2], out[tips.JD + 3]
        t0, t1, t2, t3 = out[tips.JT], out[tips.JT + 1], out[tips.JT + 2], out[tips.JT + 3]
        pivot += w_d * d0 * d0 + w_theta + w_t * t0 * t0
        inverse = 1.0 / pivot
        if params[JOINTS_HELD] != 0.0:
            inverse = 0.0
        u0 = w_d * d0 * d1 + w_t * t0 * t1
        u1 = w_d * d0 * d2 + w_t * t0 * t2
        u2 = w_d * d0 * d3 + w_theta * side + w_t * t0 * t3
        m[finger] = inverse
        m[2 + 3 * finger] = u0
        m[3 + 3 * finger] = u1
        m[4 + 3 * finger] = u2
        a += w_d * d1 * d1 + w_t * t1 * t1 - u0 * u0 * inverse
        b += w_d * d1 * d2 + w_t * t1 * t2 - u0 * u1 * inverse
        c += w_d * d2 * d2 + w_t * t2 * t2 - u1 * u1 * inverse
        d += w_d * d1 * d3 + w_t * t1 * t3 - u0 * u2 * inverse
        e += w_d * d2 * d3 + w_t * t2 * t3 - u1 * u2 * inverse
        f += w_d * d3 * d3 + w_theta + w_t * t3 * t3 - u2 * u2 * inverse
    l10 = b / a
    l20 = d / a
    c -= l10 * b
    l21 = (e - l10 * d) / c
    f -= l20 * d + l21 * l21 * c
    free = 0.0 if params[OBJECT_HELD] != 0.0 else 1.0
    m[8] = free / a
    m[9] = l10
    m[10] = l20
    m[11] = free / c
    m[12] = l21
    m[13] = free / f


@kernel
def solve(work: FloatArray, out: FloatArray) -> None:
    """Solve the factorised matrix for the right row into ``out`` [5]; held parts stay 0."""
    m = work[MATRIX]
    r = work[RIGHT]
    r0 = r[0] * m[0]
    r1 = r[1] * m[1]
    b0 = r[2] - m[2] * r0 - m[5] * r1
    b1 = r[3] - m[3] * r0 - m[6] * r1 - m[9] * b0
    b2 = r[4] - m[4] * r0 - m[7] * r1 - m[10] * b0 - m[12] * b1
    z2 = b2 * m[13]
    z1 = b1 * m[11] - m[12] * z2
    z0 = b0 * m[8] - m[9] * z1 - m[10] * z2
    if m[8] == 0.0:
        z0 = 0.0
        z1 = 0.0
        z2 = 0.0
    out[2] = z0
    out[3] = z1
    out[4] = z2
    out[0] = r0 - m[0] * (m[2] * z0 + m[3] * z1 + m[4] * z2)
    out[1] = r1 - m[1] * (m[5] * z0 + m[6] * z1 + m[7] * z2)


@kernel
def take_stiffness(
    work: FloatArray, along: FloatArray, shear1: float, shear2: float, g: float
) -> None:
    """Take g K r from the right row, K of stage 1: r is ``along`` [5] and both shears' parts."""
    right = work[RIGHT]
    for finger in range(2):
        out = work[finger]
        if out[tips.K_D] == 0.0:
            continue
        side = 1.0 - 2.0 * finger
        rate_d = out[tips.JD] * along[finger]
        for j in range(3):
            rate_d += out[tips.JD + 1 + j] * along[2 + j]
        by_d = g * out[tips.K_D] * rate_d
        by_theta = g * out[tips.K_THETA] * (side * along[finger] + along[4])
        by_t = g * out[tips.K_T] * (shear1 if finger == 0 else shear2)
        right[finger] -= out[tips.JD] * by_d + side * by_theta + out[tips.JT] * by_t
        for j in range(3):
            right[2 + j] -= out[tips.JD + 1 + j] * by_d + out[tips.JT + 1 + j] * by_t
        right[4] -= by_theta


@kernel
def shear_along(out: FloatArray, finger: int, along: FloatArray) -> float:
    """Rate of the tip's d_t for the coordinates' rates ``along`` [5], with stage 1's row."""
    rate: float = (
        out[tips.JT] * along[finger]
        + out[tips.JT + 1] * along[2]
        + out[tips.JT + 2] * along[3]
        + out[tips.JT + 3] * along[4]
    )
    return rate


@kernel
def record(state: FloatArray, params: FloatArray, work: FloatArray, ring: FloatArray) -> None:
    """Write stage 1's tips into the state, and due samples, interpolated, into the ring."""
    h = params[STEP]
    t = state[STEPS] * h
    due = state[SAMPLES] * params[SAMPLE_PERIOD]
    while due <= t:
        back = min((t - due) / h, 1.0)
        row = ring[int(state[SAMPLES]) % ring.shape[0]]
        row[SAMPLE_SEQ] = state[SAMPLES]
        row[SAMPLE_T] = due
        for finger in range(2):
            out = work[finger]
            for place, before, now in (
                (SAMPLE_D, CONTACT_D, tips.D),
                (SAMPLE_THETA, CONTACT_THETA, tips.THETA),
                (SAMPLE_GAIN, CONTACT_GAIN, tips.GAIN),
            ):
                row[place + finger] = out[now] - back * (out[now] - state[before + finger])
        state[SAMPLES] += 1.0
        due = state[SAMPLES] * params[SAMPLE_PERIOD]
    for finger in range(2):
        out = work[finger]
        state[SHEAR + finger] = out[tips.SHEAR]
        state[CONTACT_D + finger] = out[tips.D]
        state[CONTACT_THETA + finger] = out[tips.THETA]
        state[CONTACT_GAIN + finger] = out[tips.GAIN]
        state[CONTACT_FORCE + finger] = out[tips.FORCE]
        state[CONTACT_NORMAL + finger] = out[tips.NORMAL]
        state[CONTACT_TANGENTIAL + finger] = out[tips.TANGENTIAL]
        state[CONTACT_RIM + finger] = out[tips.RIM]


@kernel
def step(
    state: FloatArray,
    params: FloatArray,
    goals: FloatArray,
    data: FloatArray,
    ring: FloatArray,
    work: FloatArray,
    count: int,
) -> None:
    """Advance ``state`` [STATE] in place by ``count`` sub-steps; the tips' truth is then current.

    ``params`` [PARAMETERS], ``goals`` (2, GOALS), ``data`` the contact table, ``ring`` (n, SAMPLE)
    takes the samples that fall due, ``work`` (WORK_ROWS, tips.WORK) is scratch.
    """
    h = params[STEP]
    g = _GAMMA * h
    lag = params[ELECTRIC_TIME]
    constant = params[TORQUE_CONSTANT]
    limit = params[CURRENT_LIMIT]
    position = state[POSITION : POSITION + 5]
    velocity = state[VELOCITY : VELOCITY + 5]
    forces = work[FORCES]
    right = work[RIGHT]
    x1 = work[FIRST_X]
    v1 = work[FIRST_V]
    x2 = work[SECOND_X]
    v2 = work[SECOND_V]
    joints_move = params[JOINTS_HELD] == 0.0
    object_moves = params[OBJECT_HELD] == 0.0
    for _ in range(count):
        if not object_moves:
            t = state[STEPS] * h
            velocity[2] = (script_place(t + h, params) - script_place(t, params)) / h
        # Stage 1. Slip: evaluate_hand returns the shears within their limits.
        evaluate_hand(
            position, velocity, state, state[SHEAR], state[SHEAR + 1], params, data, work, 0
        )
        record(state, params, work, ring)
        factorise(position, params, work, g)
        shear_rate1 = work[0, tips.SHEAR_RATE]
        shear_rate2 = work[1, tips.SHEAR_RATE]
        for j in range(5):
            right[j] = forces[j]
        for j in range(2):
            reference = current_reference(goals[j], position[j], velocity[j], limit, params)
            current = state[CURRENT + j]
            change = (reference - current) / (lag + g)
            x1[5 + j] = change
            right[j] += constant * (current + g * change)
            if position[j] < params[STOP_LOW + j] or position[j] > params[STOP_HIGH + j]:
                right[j] -= g * params[STOP_STIFFNESS] * velocity[j]
        take_stiffness(work, velocity, shear_rate1, shear_rate2, g)
        solve(work, v1)
        shear_k1 = shear_rate1 + g * shear_along(work[0], 0, v1)
        shear_k2 = shear_rate2 + g * shear_along(work[1], 1, v1)
        for j in range(5):
            x1[j] = velocity[j] + g * v1[j]
            x2[j] = position[j] + h * x1[j]
            v2[j] = velocity[j] + h * v1[j]

        # Stage 2.
        evaluate_hand(
            x2,
            v2,
            state,
            state[SHEAR] + h * shear_k1,
            state[SHEAR + 1] + h * shear_k2,
            params,
            data,
            work,
            2,
        )
        right[0] = forces[0] - 2.0 * params[JOINT_INERTIA] * v1[0]
        right[1] = forces[1] - 2.0 * params[JOINT_INERTIA] * v1[1]
        right[2] = forces[2] - 2.0 * params[MASS] * v1[2]
        right[3] = forces[3] - 2.0 * params[MASS] * v1[3]
        right[4] = forces[4] - 2.0 * params[INERTIA] * v1[4]
        for j in range(2):
            current = state[CURRENT + j] + h * x1[5 + j]
            reference = current_reference(goals[j], x2[j], v2[j], limit, params)
            change = (reference - current - 2.0 * lag * x1[5 + j]) / (lag + g)
            right[j] += constant * (current + g * change)
            state[CURRENT + j] += h * (1.5 * x1[5 + j] + 0.5 * change)
            if position[j] < params[STOP_LOW + j] or position[j] > params[STOP_HIGH + j]:
                right[j] -= g * params[STOP_STIFFNESS] * (v2[j] - 2.0 * x1[j])
        for j in range(5):
            x2[j] = v2[j] - 2.0 * x1[j]
        shear_rate1 = work[2, tips.SHEAR_RATE] - 2.0 * shear_k1
        shear_rate2 = work[3, tips.SHEAR_RATE] - 2.0 * shear_k2
        take_stiffness(work, x2, shear_rate1, shear_rate2, g)
        solve(work, v2)
        shear_rate1 += g * shear_along(work[0], 0, v2)
        shear_rate2 += g * shear_along(work[1], 1, v2)
        state[SHEAR] += h * (1.5 * shear_k1 + 0.5 * shear_rate1)
        state[SHEAR + 1] += h * (1.5 * shear_k2 + 0.5 * shear_rate2)
        for j in range(5):
            moves = joints_move if j < 2 else object_moves
            if moves:
                position[j] += h * (1.5 * x1[j] + 0.5 * (x2[j] + g * v2[j]))
                velocity[j] += h * (1.5 * v1[j] + 0.5 * v2[j])
        state[STEPS] += 1.0
        if not object_moves:
            position[2] = script_place(state[STEPS] * h, params)
    evaluate_hand(position, velocity, state, state[SHEAR], state[SHEAR + 1], params, data, work, 0)
    record(state, params, work, ring)
