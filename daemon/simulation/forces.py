"""All forces on the simulated hand: tips, stops, friction, gravity; and the currents asked for.

The servo's own position loop (proportional and derivative, in its current limit) is here too, since
it runs inside the plant's sub-steps as it runs inside a real servo. Only kernels live here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import tip as tips
from daemon.simulation.layout import (
    CURRENT_BASED_POSITION_MODE,
    CURRENT_MODE,
    DRAG,
    FACE,
    FORCES,
    GOAL_CURRENT,
    GOAL_Q,
    GRAVITY,
    HALF_HEIGHT,
    HALF_SEPARATION,
    HALF_WIDTH,
    JOINT_DAMPING,
    JOINT_FRICTION,
    JOINT_INERTIA,
    JOINT_SPEED,
    LENGTH,
    MASS,
    MODE,
    NO_LOAD_SPEED,
    OFFSET,
    POSITION_GAIN,
    PRESENT,
    PUSH,
    RATE_GAIN,
    SCRIPT_LEFT,
    SCRIPT_RIGHT,
    SCRIPT_SPEED,
    SCRIPT_X,
    STALL_CURRENT,
    STOP_HIGH,
    STOP_LOW,
    STOP_STIFFNESS,
    TABLE_FORCE,
    TABLE_SPEED,
    TABLE_SPIN,
    TABLE_TORQUE,
    TORQUE_ON,
)
from daemon.simulation.tip import evaluate_tip, nearest_face
from kinematics.fingers import tip_position, tip_velocity
from kinematics.kernels import kernel

FloatArray = NDArray[np.float64]


@kernel
def current_reference(
    goal: FloatArray, q: float, rate: float, limit: float, params: FloatArray
) -> float:
    """Current [A] that a servo asks of its motor: its mode's law within all that bounds it.

    The supply's bound falls linearly from the stall current at rest to none at no-load speed.
    """
    if goal[TORQUE_ON] == 0.0:
        return 0.0
    if goal[MODE] == CURRENT_MODE:
        reference = goal[GOAL_CURRENT]
    else:
        reference = params[POSITION_GAIN] * (goal[GOAL_Q] - q) - params[RATE_GAIN] * rate
        if goal[MODE] == CURRENT_BASED_POSITION_MODE:
            limit = min(limit, abs(goal[GOAL_CURRENT]))
    reference = min(max(reference, -limit), limit)
    back = params[STALL_CURRENT] * rate / params[NO_LOAD_SPEED]
    stall = params[STALL_CURRENT]
    current: float = min(max(reference, -stall - back), stall - back)
    return current


@kernel
def script_place(t: float, params: FloatArray) -> float:
    """x [m] of a held object at ``t``: from its start onto the left tip, back, the right, back."""
    x: float = params[SCRIPT_X]
    left = params[SCRIPT_LEFT]
    right = params[SCRIPT_RIGHT]
    if params[SCRIPT_SPEED] > 0.0 and left + right > 0.0:
        way = (params[SCRIPT_SPEED] * t) % (2.0 * (left + right))
        if way <= 2.0 * left:
            x += abs(left - way) - left
        else:
            x += right - abs(right - (way - 2.0 * left))
    return x


@kernel
def evaluate_hand(
    position: FloatArray,
    velocity: FloatArray,
    state: FloatArray,
    shear1: float,
    shear2: float,
    params: FloatArray,
    data: FloatArray,
    work: FloatArray,
    stage: int,
) -> None:
    """Evaluate both tips into rows ``stage`` and ``stage`` + 1, then all forces but the motors'.

    The drag row is the positive slope of friction, losses and stops against the velocities, in the
    forces already.
    """
    forces = work[FORCES]
    drag = work[DRAG]
    angle = position[4]
    nx = math.cos(angle)
    ny = math.sin(angle)
    forces[2] = params[MASS] * params[GRAVITY] + params[PUSH]
    forces[3] = params[MASS] * params[GRAVITY + 1] + params[PUSH + 1]
    forces[4] = params[PUSH + 2]
    for finger in range(2):
        q = position[finger]
        rate = velocity[finger]
        friction = params[JOINT_FRICTION] / math.hypot(rate, params[JOINT_SPEED])
        drag[finger] = params[JOINT_DAMPING] + friction
        beyond = min(q - params[STOP_LOW + finger], 0.0) + max(q - params[STOP_HIGH + finger], 0.0)
        if beyond != 0.0:
            drag[finger] += math.sqrt(params[STOP_STIFFNESS] * params[JOINT_INERTIA])
        forces[finger] = -drag[finger] * rate - params[STOP_STIFFNESS] * beyond
        out = work[stage + finger]
        if params[PRESENT + finger] == 0.0:
            out[:] = 0.0
            continue
        side = 1.0 - 2.0 * finger
        ox, oy = tip_position(q, side, params[HALF_SEPARATION], params[LENGTH], params[OFFSET])
        vx, vy = tip_velocity(q, side, params[LENGTH], params[OFFSET])
        rx = ox - position[2]
        ry = oy - position[3]
        face = nearest_face(
            rx * nx + ry * ny, ry * nx - rx * ny, params[HALF_WIDTH], params[HALF_HEIGHT]
        )
        shear = shear1 if finger == 0 else shear2
        if face != state[FACE + finger]:
            # Only past an edge, where the window has closed and no shear is stored.
            state[FACE + finger] = face
            shear = 0.0
        evaluate_tip(
            side,
            math.cos(q),
            math.sin(q),
            vx,
            vy,
            rx,
            ry,
            nx,
            ny,
            face,
            params[HALF_WIDTH],
            params[HALF_HEIGHT],
            shear,
            rate,
            velocity[2],
            velocity[3],
            velocity[4],
            params,
            data,
            out,
        )
        forces[finger] += out[tips.Q]
        forces[2] += out[tips.Q + 1]
        forces[3] += out[tips.Q + 2]
        forces[4] += out[tips.Q + 3]
    speed = math.sqrt(velocity[2] ** 2 + velocity[3] ** 2 + params[TABLE_SPEED] ** 2)
    drag[2] = params[TABLE_FORCE] / speed
    drag[3] = drag[2]
    drag[4] = params[TABLE_TORQUE] / math.hypot(velocity[4], params[TABLE_SPIN])
    for j in range(2, 5):
        forces[j] -= drag[j] * velocity[j]
