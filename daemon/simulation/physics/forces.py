"""All forces on the simulated hand, summed over its contacts; and the currents asked for.

The servo's own position loop (proportional and derivative, in its current limit) is here too, since
it runs inside the plant's sub-steps as it runs inside a real servo. Only kernels live here.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.full_solver import clear_extra
from softfinger.daemon.simulation.physics.palm import evaluate_palm, palm_is_far
from softfinger.daemon.simulation.physics.tip import clear_row, evaluate_tip
from softfinger.daemon.simulation.physics.tip_tip import evaluate_mutual, mutual_rows, tips_are_far
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer


@inner_kernel
def current_reference(memory: Pointer, joint: int, q: float, rate: float) -> float:
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


@inner_kernel
def current_slopes(memory: Pointer, joint: int, g: float) -> tuple[float, float]:
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


@inner_kernel
def stop_stiffness(memory: Pointer, joint: int) -> float:
    """Stiffness [N·m/rad] of the end stop that the joint is on or will be within a step, else 0."""
    stiffness: float = 0.0
    q = memory[layout.POSITION + joint]
    ahead = q + memory[layout.STEP] * memory[layout.VELOCITY + joint]
    low = memory[layout.STOP_LOW + joint]
    high = memory[layout.STOP_HIGH + joint]
    if min(q, ahead) < low or max(q, ahead) > high:
        stiffness = memory[layout.STOP_STIFFNESS]
    return stiffness


@inner_kernel
def script_place(memory: Pointer, t: float) -> float:
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


@inner_kernel
def touch_palm(
    memory: Pointer,
    position: int,
    velocity: int,
    shears: int,
    nx: float,
    ny: float,
    stage: np.int64,
) -> None:
    """Add the palm's forces where the object may meet it."""
    if palm_is_far(memory, position, velocity):
        for corner in range(4):
            memory[layout.EXTRA_RATE + 6 * int(stage) + corner] = 0.0
        if stage == layout.FIRST_STAGE and memory[layout.PALM_ENERGY] != 0.0:
            memory[layout.PALM_ENERGY] = 0.0
            for corner in range(4):
                memory[shears + corner] = 0.0
    else:
        evaluate_palm(memory, position, velocity, shears, nx, ny, stage)


@inner_kernel
def touch_each_other(
    memory: Pointer,
    data: Pointer,
    position: int,
    velocity: int,
    shears: int,
    stage: np.int64,
) -> None:
    """Add the tips' torques on each other where they may meet; without an object always."""
    row = layout.MUTUAL + 2 * int(stage) * layout.TIP_ROW
    near = not tips_are_far(memory) or memory[layout.SHAPE] == layout.NO_OBJECT
    touching = near and evaluate_mutual(memory, data, row, position, velocity, shears + 4)
    for finger in range(2):
        rate = memory[row + finger * layout.TIP_ROW + layout.SHEAR_RATE] if touching else 0.0
        memory[layout.EXTRA_RATE + 6 * int(stage) + 4 + finger] = rate
    if stage == layout.FIRST_STAGE:
        if memory[layout.MUTUAL_NEAR] != 0.0 and not near:
            for finger in range(2):
                clear_row(memory, layout.MUTUAL + finger * layout.TIP_ROW)
                memory[layout.MUTUAL_SHEAR + finger] = 0.0
        memory[layout.MUTUAL_NEAR] = 1.0 if near else 0.0
        if touching:
            if memory[layout.COUPLED] == 0.0:
                clear_extra(memory, 0, layout.PALM_ROWS)
            memory[layout.COUPLED] = 1.0
            mutual_rows(memory)
        elif memory[layout.COUPLED] != 0.0:
            clear_extra(memory, layout.PALM_ROWS, layout.EXTRA_ROWS)


@inner_kernel
def evaluate_hand(
    memory: Pointer,
    data: Pointer,
    position: int,
    velocity: int,
    shears: int,
    stage: np.int64,
    shear1: float,
    shear2: float,
) -> None:
    """Evaluate all contacts into the rows of a ``stage``, and all forces but the motors'.

    ``position`` and ``velocity`` are where the five coordinates and their rates stand, ``shears``
    where those of palm and mutual contact do; ``shear1`` and ``shear2`` are the tips' on the
    object. The drag is friction over velocity, in the forces already.
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
    mass = memory[layout.MASS]
    memory[layout.FORCES + 2] = mass * memory[layout.GRAVITY] + memory[layout.PUSH] - drag * vx
    memory[layout.FORCES + 3] = (
        mass * memory[layout.GRAVITY + 1] + memory[layout.PUSH + 1] - drag * vy
    )
    memory[layout.FORCES + 4] = memory[layout.PUSH + 2] - spin_drag * spin
    memory[layout.DRAG + 2] = drag
    memory[layout.DRAG + 3] = drag
    memory[layout.DRAG + 4] = spin_drag
    with_object = memory[layout.SHAPE] != layout.NO_OBJECT
    if stage == layout.FIRST_STAGE:
        memory[layout.COUPLED] = 0.0
    if with_object:
        touch_palm(memory, position, velocity, shears, nx, ny, stage)
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
        if memory[layout.PRESENT + finger] != 0.0:
            cq = math.cos(q)
            sq = math.sin(q)
            # The tip's centre from its pivot, inwards and away from the palm (hand.geometry).
            inward = memory[layout.LENGTH] * sq + memory[layout.OFFSET] * cq
            ahead = memory[layout.LENGTH] * cq - memory[layout.OFFSET] * sq
            side = 1.0 - 2.0 * finger
            place = layout.TIP_PLACE + 4 * finger
            x = side * (inward - memory[layout.HALF_SEPARATION])
            memory[place] = x
            memory[place + 1] = ahead
            memory[place + 2] = side * ahead
            memory[place + 3] = -inward
            if with_object:
                out = layout.TIP + int(2 * stage + finger) * layout.TIP_ROW
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
                    x - memory[position + 2],
                    ahead - memory[position + 3],
                    nx,
                    ny,
                    shear1 if finger == 0 else shear2,
                )
                joint_torque += memory[out + layout.Q]
                memory[layout.FORCES + 2] += memory[out + layout.Q + 1]
                memory[layout.FORCES + 3] += memory[out + layout.Q + 2]
                memory[layout.FORCES + 4] += memory[out + layout.Q + 3]
        memory[layout.FORCES + finger] = joint_torque
    if memory[layout.PRESENT] != 0.0 and memory[layout.PRESENT + 1] != 0.0:
        touch_each_other(memory, data, position, velocity, shears, stage)
