"""All forces on the simulated hand: tips, stops, palm, friction; and the currents asked for.

The servo's own position loop (proportional and derivative, in its current limit) is here too, since
it runs inside the plant's sub-steps as it runs inside a real servo. Only kernels live here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import layout
from daemon.simulation.tip import evaluate_tip
from kinematics.kernels import kernel

FloatArray = NDArray[np.float64]

PALM_STIFFNESS = 1e5  # N/m, each corner of the object on the palm
PALM_LOSS = 1e-3  # s, its damping over its stiffness


@kernel
def current_reference(memory: FloatArray, joint: int, q: float, rate: float) -> float:
    """Current [A] that a servo asks of its motor: its mode's law within all that bounds it.

    The supply's bound falls linearly from the stall current at rest to none at no-load speed.
    """
    if memory[layout.TORQUE_ON + joint] == 0.0:
        return 0.0
    limit = memory[layout.CURRENT_LIMIT]
    mode = memory[layout.MODE + joint]
    goal_current = memory[layout.GOAL_CURRENT + joint]
    if mode == layout.CURRENT_MODE:
        reference = goal_current
    else:
        error = memory[layout.GOAL_Q + joint] - q
        reference = memory[layout.POSITION_GAIN] * error - memory[layout.RATE_GAIN] * rate
        if mode == layout.CURRENT_BASED_POSITION_MODE:
            limit = min(limit, abs(goal_current))
    reference = min(max(reference, -limit), limit)
    stall = memory[layout.STALL_CURRENT]
    back = stall * rate / memory[layout.NO_LOAD_SPEED]
    current: float = min(max(reference, -stall - back), stall - back)
    return current


@kernel
def current_slopes(memory: FloatArray, joint: int, g: float) -> tuple[float, float]:
    """How steeply the reference falls with angle [A/rad] and with velocity [A·s/rad].

    For the integrator's matrix, and only where a step of ``g`` makes them stiff. They are then
    upper bounds, since whether the reference is limited may change within the step.
    """
    if memory[layout.TORQUE_ON + joint] == 0.0:
        return 0.0, 0.0
    by_q = 0.0
    by_rate = memory[layout.STALL_CURRENT] / memory[layout.NO_LOAD_SPEED]
    if memory[layout.MODE + joint] != layout.CURRENT_MODE:
        by_q = memory[layout.POSITION_GAIN]
        by_rate = max(by_rate, memory[layout.RATE_GAIN])
    torque = g * memory[layout.TORQUE_CONSTANT] * (by_rate + g * by_q)
    if torque < 0.1 * memory[layout.JOINT_INERTIA]:
        return 0.0, 0.0
    return by_q, by_rate


@kernel
def stop_stiffness(memory: FloatArray, joint: int) -> float:
    """Stiffness [N·m/rad] of the end stop that the joint is on or will be within a step, else 0."""
    stiffness: float = 0.0
    q = memory[layout.POSITION + joint]
    ahead = q + memory[layout.STEP] * memory[layout.VELOCITY + joint]
    low = memory[layout.STOP_LOW + joint]
    high = memory[layout.STOP_HIGH + joint]
    if min(q, ahead) < low or max(q, ahead) > high:
        stiffness = memory[layout.STOP_STIFFNESS]
    return stiffness


@kernel
def script_place(memory: FloatArray, t: float) -> float:
    """x [m] of a held object at ``t``: from its start onto the left tip, back, the right, back."""
    x: float = memory[layout.SCRIPT_X]
    left = memory[layout.SCRIPT_LEFT]
    right = memory[layout.SCRIPT_RIGHT]
    if memory[layout.SCRIPT_SPEED] > 0.0 and left + right > 0.0:
        way = (memory[layout.SCRIPT_SPEED] * t) % (2.0 * (left + right))
        if way <= 2.0 * left:
            x += abs(left - way) - left
        else:
            x += right - abs(right - (way - 2.0 * left))
    return x


@kernel
def evaluate_palm(memory: FloatArray, position: int, velocity: int) -> tuple[float, float]:
    """Force along y and torque of the palm on the object's corners; a spring with loss each.

    Writes its energy and, in stage 1, its stiffness as it will be at the step's end.
    """
    height = memory[position + 3] - memory[layout.PALM]
    half_width = memory[layout.HALF_WIDTH]
    half_height = memory[layout.HALF_HEIGHT]
    force = 0.0
    torque = 0.0
    energy = 0.0
    stiff_y = 0.0
    stiff_both = 0.0
    stiff_turn = 0.0
    y_rate = memory[velocity + 3]
    h = memory[layout.STEP]
    if height - half_width - half_height < h * abs(y_rate):
        nx = math.cos(memory[position + 4])
        ny = math.sin(memory[position + 4])
        for corner in range(4):
            u = half_width if corner % 2 else -half_width
            v = half_height if corner < 2 else -half_height
            # Height of the corner and its derivative by φ, its place along x.
            depth = -(height + u * ny + v * nx)
            lever = u * nx - v * ny
            rate = -(y_rate + lever * memory[velocity + 4])
            if max(depth, depth + h * rate) <= 0.0:
                continue
            stiff_y += PALM_STIFFNESS
            stiff_both += PALM_STIFFNESS * lever
            stiff_turn += PALM_STIFFNESS * lever * lever
            if depth > 0.0:
                push = max(PALM_STIFFNESS * (depth + PALM_LOSS * rate), 0.0)
                energy += 0.5 * PALM_STIFFNESS * depth * depth
                force += push
                torque += push * lever
    memory[layout.PALM_ENERGY] = energy
    if position == layout.POSITION:
        memory[layout.PALM_STIFFNESS] = stiff_y
        memory[layout.PALM_STIFFNESS + 1] = stiff_both
        memory[layout.PALM_STIFFNESS + 2] = stiff_turn
    return force, torque


@kernel
def evaluate_hand(
    memory: FloatArray,
    data: FloatArray,
    position: int,
    velocity: int,
    row: int,
    shear1: float,
    shear2: float,
) -> None:
    """Evaluate both tips into the rows from ``row`` on, then all forces but the motors'.

    ``position`` and ``velocity`` are where the five coordinates and their rates stand. The drag is
    friction over velocity, in the forces already.
    """
    angle = memory[position + 4]
    nx = math.cos(angle)
    ny = math.sin(angle)
    vx = memory[velocity + 2]
    vy = memory[velocity + 3]
    spin = memory[velocity + 4]
    speed = math.sqrt(vx * vx + vy * vy + memory[layout.TABLE_SPEED] ** 2)
    drag = memory[layout.TABLE_FORCE] / speed
    spin_drag = memory[layout.TABLE_TORQUE] / math.sqrt(spin**2 + memory[layout.TABLE_SPIN] ** 2)
    force_x = memory[layout.MASS] * memory[layout.GRAVITY] + memory[layout.PUSH] - drag * vx
    force_y = memory[layout.MASS] * memory[layout.GRAVITY + 1] + memory[layout.PUSH + 1] - drag * vy
    torque = memory[layout.PUSH + 2] - spin_drag * spin
    palm_force, palm_torque = evaluate_palm(memory, position, velocity)
    force_y += palm_force
    torque += palm_torque
    memory[layout.DRAG + 2] = drag
    memory[layout.DRAG + 3] = drag
    memory[layout.DRAG + 4] = spin_drag
    for finger in range(2):
        q = memory[position + finger]
        rate = memory[velocity + finger]
        slow = memory[layout.JOINT_SPEED]
        resisting = memory[layout.JOINT_DAMPING] + memory[layout.JOINT_FRICTION] / math.sqrt(
            rate * rate + slow * slow
        )
        beyond = min(q - memory[layout.STOP_LOW + finger], 0.0) + max(
            q - memory[layout.STOP_HIGH + finger], 0.0
        )
        if beyond != 0.0:
            resisting += math.sqrt(memory[layout.STOP_STIFFNESS] * memory[layout.JOINT_INERTIA])
        memory[layout.DRAG + finger] = resisting
        joint_torque = -resisting * rate - memory[layout.STOP_STIFFNESS] * beyond
        out = row + finger * layout.TIP_ROW
        if memory[layout.PRESENT + finger] != 0.0:
            cq = math.cos(q)
            sq = math.sin(q)
            # The tip's centre from its pivot, inwards and away from the palm (kinematics.fingers).
            inward = memory[layout.LENGTH] * sq + memory[layout.OFFSET] * cq
            ahead = memory[layout.LENGTH] * cq - memory[layout.OFFSET] * sq
            side = 1.0 - 2.0 * finger
            rx = side * (inward - memory[layout.HALF_SEPARATION]) - memory[position + 2]
            ry = ahead - memory[position + 3]
            evaluate_tip(
                memory,
                data,
                out,
                finger,
                velocity,
                cq,
                sq,
                side * ahead,
                -inward,
                rx,
                ry,
                nx,
                ny,
                shear1 if finger == 0 else shear2,
            )
            joint_torque += memory[out + layout.Q]
            force_x += memory[out + layout.Q + 1]
            force_y += memory[out + layout.Q + 2]
            torque += memory[out + layout.Q + 3]
        memory[layout.FORCES + finger] = joint_torque
    memory[layout.FORCES + 2] = force_x
    memory[layout.FORCES + 3] = force_y
    memory[layout.FORCES + 4] = torque
