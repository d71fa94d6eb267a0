"""The kernel that moves the simulated hand: two joints, two soft tips, one rigid object.

Coordinates (q1, q2, x, y, φ) with their velocities, the shear of each contact and the current of
each motor are advanced by fixed sub-steps of a two-stage Rosenbrock method (ROS2, γ = 1 − 1/√2):

    (1 − γhA) k1 = f(y)    (1 − γhA) k2 = f(y + h k1) − 2 k1    y ← y + h (3 k1 + k2)/2

It is of second order whatever matrix A is, and L-stable where A is the Jacobian; A here holds what
is stiff: the contacts' normal, turning and shear stiffness with their losses, end stops, friction
at its secant, the motors' lag and the servos' loops. Of the unknowns only the five accelerations
are coupled, and mostly the joints only through the object, so that a step costs two evaluations of
the tips and one 3 × 3 factorisation; palm and tips on each other make it 5 × 5. Coulomb slip is a
return of the shears into their limits at the start of a step. The ledger has the last word.

Only kernels live here; forces are in forces.py, tip.py, mutual.py and palm.py, places in the memory
in layout.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.energy_guard import (
    HALVINGS,
    balance_ledger,
    enter_changed,
    is_covered,
    keep_earlier,
    on_rim,
    open_ledger,
    shorten,
)
from softfinger.daemon.simulation.physics.forces import (
    current_reference,
    current_slopes,
    evaluate_hand,
    script_place,
    stop_stiffness,
)
from softfinger.daemon.simulation.physics.full_solver import (
    add_extra_shears,
    factorise_full,
    solve_full,
    take_extra_stiffness,
)
from softfinger.daemon.simulation.physics.solver import (
    factorise,
    joint_pivot,
    shear_along,
    solve,
    take_stiffness,
)
from softfinger.daemon.simulation.sensor.samples import settle
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.simd import Pointer, address

FloatArray = NDArray[np.float64]

_GAMMA = 1.0 - math.sqrt(0.5)
_LATER = layout.TIP + 2 * layout.TIP_ROW  # the tips' rows of stage 2
_SHEARS = 6  # of palm and tips on each other


@inner_kernel
def bounded(value: float, most: float) -> float:
    """``value`` within ± ``most``."""
    return min(max(value, -most), most)


@inner_kernel
def load_motors(
    memory: Pointer, stage: int, position: int, velocity: int, h: float, g: float
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


@inner_kernel
def current_change(memory: Pointer, joint: int, acceleration: float, g: float) -> float:
    """k of a current, for the joint's k of velocity."""
    slope = memory[layout.MOTOR + 2 + joint] + g * memory[layout.MOTOR + joint]
    change: float = (
        memory[layout.CHANGE + joint] - g * slope / memory[layout.TORQUE_CONSTANT] * acceleration
    )
    return change


@inner_kernel
def first_stage(memory: Pointer, g: float) -> tuple[float, float]:
    """k1 of the coordinates, velocities and currents into FIRST_X, FIRST_V; that of the shears."""
    for j in range(5):
        memory[layout.LOAD + j] = memory[layout.FORCES + j]
    load_motors(memory, 1, layout.POSITION, layout.VELOCITY, 0.0, g)
    coupled = memory[layout.COUPLED] != 0.0
    if coupled:
        factorise_full(memory, (joint_pivot(memory, 0, g), joint_pivot(memory, 1, g)), g)
        for k in range(_SHEARS):
            memory[layout.EXTRA_FIRST + k] = memory[layout.EXTRA_RATE + k]
        take_extra_stiffness(memory, layout.VELOCITY, layout.EXTRA_FIRST, g)
    else:
        factorise(memory, g)
    rate1 = memory[layout.TIP + layout.SHEAR_RATE]
    rate2 = memory[layout.TIP + layout.TIP_ROW + layout.SHEAR_RATE]
    take_stiffness(memory, layout.VELOCITY, rate1, rate2, g)
    if coupled:
        solve_full(memory, layout.FIRST_V)
        add_extra_shears(memory, layout.FIRST_V, layout.EXTRA_FIRST, g)
    else:
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


@inner_kernel
def second_stage(memory: Pointer, shear1: float, shear2: float, h: float, g: float) -> None:
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
    if memory[layout.COUPLED] != 0.0:
        second = layout.EXTRA_RATE + _SHEARS
        for k in range(_SHEARS):
            memory[second + k] -= 2.0 * memory[layout.EXTRA_FIRST + k]
        take_extra_stiffness(memory, layout.SECOND_X, second, g)
        solve_full(memory, layout.SECOND_V)
        add_extra_shears(memory, layout.SECOND_V, second, g)
        for k in range(_SHEARS):
            change = 1.5 * memory[layout.EXTRA_FIRST + k] + 0.5 * memory[second + k]
            memory[layout.PALM_SHEAR + k] += h * change
    else:
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
            most /= memory[layout.EXTENT]
        memory[layout.POSITION + j] += bounded(way, most)
        memory[layout.VELOCITY + j] = bounded(memory[layout.VELOCITY + j] + change, most / h)


@inner_kernel
def evaluate_state(memory: Pointer, data: Pointer) -> None:
    """Evaluate all contacts and forces of the state as it is."""
    evaluate_hand(
        memory,
        data,
        layout.POSITION,
        layout.VELOCITY,
        layout.PALM_SHEAR,
        layout.FIRST_STAGE,
        memory[layout.SHEAR],
        memory[layout.SHEAR + 1],
    )


@inner_kernel
def go_back(memory: Pointer, data: Pointer) -> None:
    """Shorten a step that leads uphill, until it doesn't, or all of it."""
    for _ in range(HALVINGS):
        shorten(memory, 0.5)
        evaluate_state(memory, data)
        if is_covered(memory):
            return
    shorten(memory, 0.0)
    evaluate_state(memory, data)


@kernel
def step(block: FloatArray, table: FloatArray, ring: FloatArray, count: int) -> None:
    """Advance the plant in ``block`` by ``count`` sub-steps; the tips' truth is then current.

    ``table`` is the contact table's data; ``ring`` (n, layout.SAMPLE) takes the samples that fall
    due.
    """
    # Bare addresses from here on: an array argument costs a reference count at each call.
    memory = address(block)
    data = address(table)
    h = memory[layout.STEP]
    g = _GAMMA * h
    scripted = memory[layout.OBJECT_HELD] != 0.0 and memory[layout.SCRIPT_SPEED] > 0.0
    evaluate_state(memory, data)
    open_ledger(memory)
    settle(memory, ring)
    for _ in range(count):
        if scripted:
            t = memory[layout.STEPS] * h
            way = script_place(memory, t + h) - script_place(memory, t)
            memory[layout.VELOCITY + 2] = way / h
            evaluate_state(memory, data)
        keep_earlier(memory)
        was_on_rim = on_rim(memory)
        shear1, shear2 = first_stage(memory, g)
        for j in range(5):
            memory[layout.SECOND_X + j] = (
                memory[layout.POSITION + j] + h * memory[layout.FIRST_X + j]
            )
            memory[layout.SECOND_V + j] = (
                memory[layout.VELOCITY + j] + h * memory[layout.FIRST_V + j]
            )
        shears = layout.PALM_SHEAR
        if memory[layout.COUPLED] != 0.0:
            shears = layout.EXTRA_SHEAR
            for k in range(_SHEARS):
                memory[layout.EXTRA_SHEAR + k] = (
                    memory[layout.PALM_SHEAR + k] + h * memory[layout.EXTRA_FIRST + k]
                )
        evaluate_hand(
            memory,
            data,
            layout.SECOND_X,
            layout.SECOND_V,
            shears,
            layout.SECOND_STAGE,
            memory[layout.SHEAR] + h * shear1,
            memory[layout.SHEAR + 1] + h * shear2,
        )
        second_stage(memory, shear1, shear2, h, g)
        memory[layout.STEPS] += 1.0
        if scripted:
            memory[layout.POSITION + 2] = script_place(memory, memory[layout.STEPS] * h)
        # Slip: the shears come back within their limits, and settle keeps them there.
        evaluate_state(memory, data)
        if scripted:
            open_ledger(memory)
        else:
            found = balance_ledger(memory, was_on_rim)
            if found == 2:
                go_back(memory, data)
            elif found == 1:
                evaluate_state(memory, data)
            if found != 0:
                enter_changed(memory)
        settle(memory, ring)
