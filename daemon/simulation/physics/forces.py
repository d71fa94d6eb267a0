"""Compute the forces due to motors, weight, loads, friction and end stops.

The module `contacts` adds the contact forces.
"""

from __future__ import annotations

import math

from softfinger.daemon.servos.control_table import CURRENT_BASED_POSITION_MODE, CURRENT_MODE
from softfinger.daemon.simulation.physics.contacts import (
    touch_each_other,
    touch_object,
    touch_palm,
)
from softfinger.daemon.simulation.physics.plant_state import (
    EXTRA_ROWS,
    NO_OBJECT,
    STOP_STIFFNESS,
    Motion,
    Plant,
    Stage,
)
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.table_record import Table

ELECTRIC_TIME = 1e-3  # lag of the servo current behind its reference [s]
TABLE_SPEED = 0.0005  # speed below which table friction is viscous [m/s]


@inner_kernel
def current_reference(plant: Plant, joint: int, q: float, rate: float) -> float:
    """Return the motor current [A] that a servo commands after all limits have been applied.

    The voltage-limited current decreases linearly from the stall current at standstill to 0 at
    no-load speed. The PWM limit scales the supply voltage.
    """
    p, goals = plant.parameters, plant.goals
    if goals.torque_on[joint] == 0:
        return 0.0
    limit = p.stall_current
    mode = goals.mode[joint]
    if mode == CURRENT_MODE:
        reference = goals.current[joint]
    else:
        pull = goals.stiffness[joint] * (goals.q[joint] - q) - goals.damping[joint] * rate
        reference = p.position_gain * pull - p.rate_gain * rate
        if mode == CURRENT_BASED_POSITION_MODE:
            limit = min(limit, abs(goals.current[joint]))
    reference = min(max(reference, -limit), limit)
    back = p.stall_current * rate / p.no_load_speed
    most = goals.duty[joint] * p.stall_current
    current: float = min(max(reference, -most - back), most - back)
    return current


@inner_kernel
def set_motor_slopes(plant: Plant, g: float) -> None:
    """Set the derivatives of the motor torques with respect to joint angle and velocity.

    The derivatives are divided by τ + g, where τ is the time constant of the current. The
    derivatives are 0 if their effect over the step size ``g`` is negligible. The derivatives are
    upper bounds, because the current may reach or leave its limits during the step.
    """
    p, goals = plant.parameters, plant.goals
    constant = p.torque_constant
    for joint in range(2):
        by_q = 0.0
        by_rate = 0.0
        if goals.torque_on[joint] != 0:
            by_rate = p.stall_current / p.no_load_speed
            if goals.mode[joint] != CURRENT_MODE:
                by_q = p.position_gain * goals.stiffness[joint]
                by_rate = max(by_rate, p.rate_gain + p.position_gain * goals.damping[joint])
            if g * constant * (by_rate + g * by_q) < 0.1 * p.joint_inertia:
                by_q = 0.0
                by_rate = 0.0
        plant.motor_by_q[joint] = constant * by_q / (ELECTRIC_TIME + g)
        plant.motor_by_rate[joint] = constant * by_rate / (ELECTRIC_TIME + g)


@inner_kernel
def joint_stiffness(plant: Plant, joint: int) -> float:
    """Return the stiffness [N·m/rad] of a joint's bristles and of any end stop it may touch."""
    p = plant.parameters
    stiffness: float = plant.gears[joint].stiffness
    q = plant.state.position[joint]
    ahead = q + p.step * plant.state.velocity[joint]
    if min(q, ahead) < p.stop_low[joint] or max(q, ahead) > p.stop_high[joint]:
        stiffness += STOP_STIFFNESS
    return stiffness


@inner_kernel
def free_object(plant: Plant, now: Motion) -> None:
    """Set the forces on the object that are due to weight, loads and table friction."""
    p, load = plant.parameters, plant.goals.load
    vx = now.velocity[2]
    vy = now.velocity[3]
    spin = now.velocity[4]
    drag = p.table_force / math.sqrt(vx * vx + vy * vy + TABLE_SPEED**2)
    spin_drag = p.table_torque / math.sqrt(spin**2 + p.table_spin**2)
    plant.forces[2] = p.mass * p.gravity[0] + load[0] - drag * vx
    plant.forces[3] = p.mass * p.gravity[1] + load[1] - drag * vy
    plant.forces[4] = load[2] - spin_drag * spin
    plant.drag[2] = drag
    plant.drag[3] = drag
    plant.drag[4] = spin_drag


@inner_kernel
def bend_bristles(plant: Plant, finger: int, now: Motion, is_first: bool) -> float:
    """Return the torque [N·m] of a joint's bristles, and store their damping as the joint's drag.

    Elastic bristles with deflection z connect the gears and slip at the friction level f. The
    elasto-plastic friction model is by Dupont, Hayward, Armstrong and Altpeter (IEEE Transactions
    on Automatic Control 47(5), 2002). Break-away and steady slip occur at the same deflection z_p =
    ``presliding``:

        torque = f z/z_p    ż = q̇ while |z| ≤ z_p

    A load below f, even an oscillating load, deforms the bristles only elastically and therefore
    never causes drift. The number of bristles is proportional to f. New bristles are undeflected,
    and the energy of removed bristles is lost. A change in f therefore never adds energy. On
    average, new bristles are added halfway through the step. A stuck joint has half the critical
    damping. The sum of bristle torque and damping torque is limited to f.

    The base, Stribeck and load terms of f are from Rhoban's model M4, which was identified for
    similar servos (arXiv 2410.08650). The load term is proportional to the gear torque, |external −
    motor|.
    """
    p, gears = plant.parameters, plant.gears[finger]
    rate = now.velocity[finger]
    still = math.exp(-abs(rate) / p.joint_stribeck_speed)
    load = abs(plant.external[finger] - p.torque_constant * now.current[finger])
    share = p.joint_load_friction[0] + still * p.joint_load_friction[1]
    friction = p.joint_friction + still * p.joint_stribeck + share * load
    bent = now.bristles[finger]
    if friction > gears.level:
        bent -= (1.0 - gears.level / friction) * 0.5 * (gears.deflection + bent)
    bent = min(max(bent, -p.joint_presliding), p.joint_presliding)
    stiffness = friction / p.joint_presliding
    torque: float = stiffness * bent
    damping = math.sqrt(stiffness * p.joint_inertia)
    if rate != 0.0:
        before_slip = friction - (torque if rate > 0.0 else -torque)
        damping = min(damping, before_slip / abs(rate))
        stiffness = min(stiffness, before_slip / (p.step * abs(rate)))
    plant.drag[finger] = damping
    gears.friction = friction
    gears.limited_deflection = bent
    if is_first:
        gears.stiffness = stiffness
    return torque


@inner_kernel
def free_joint(plant: Plant, finger: int, now: Motion, is_first: bool) -> float:
    """Return the torque [N·m] due to a joint's friction and end stops, and set the joint's drag."""
    p = plant.parameters
    q = now.position[finger]
    torque = -bend_bristles(plant, finger, now, is_first)
    plant.drag[finger] += p.joint_damping
    beyond = min(q - p.stop_low[finger], 0.0) + max(q - p.stop_high[finger], 0.0)
    if beyond != 0.0:
        plant.drag[finger] += math.sqrt(STOP_STIFFNESS * p.joint_inertia)
        torque -= STOP_STIFFNESS * beyond
    return torque - float(plant.drag[finger] * now.velocity[finger])


@inner_kernel
def place_finger(plant: Plant, finger: int, q: float) -> None:
    """Compute a finger's position from its joint angle ``q``."""
    p, its = plant.parameters, plant.fingers[finger]
    cosine = math.cos(q)
    sine = math.sin(q)
    # Position of the tip centre relative to the finger's pivot, as in `hand.geometry`.
    inward = p.length * sine + p.offset * cosine
    ahead = p.length * cosine - p.offset * sine
    side = 1.0 - 2.0 * finger
    its.cosine = cosine
    its.sine = sine
    its.x = side * (inward - p.half_separation)
    its.y = ahead
    its.x_q = side * ahead
    its.y_q = -inward


@inner_kernel
def evaluate_hand(plant: Plant, table: Table, now: Motion, stage: Stage, is_first: bool) -> None:
    """Compute all contacts and forces for the state ``now``, except for the motor forces.

    The contacts are stored in ``stage``. The drag is viscous friction divided by velocity. The
    forces already include viscous friction.
    """
    p, forces = plant.parameters, plant.forces
    nx = math.cos(now.position[4])
    ny = math.sin(now.position[4])
    with_object = p.shape != NO_OBJECT
    free_object(plant, now)
    if is_first and plant.has_extra_rows:
        plant.has_extra_rows = False
        for number in range(EXTRA_ROWS):
            plant.extra[number].stiffness = 0.0
            plant.extra[number].damping = 0.0
    if with_object:
        touch_palm(plant, now, stage, nx, ny, is_first)
    for finger in range(2):
        forces[finger] = 0.0
        if p.finger_present[finger] != 0:
            place_finger(plant, finger, now.position[finger])
            if with_object:
                touch_object(plant, table, stage.on_object[finger], finger, now, nx, ny)
    if p.finger_present[0] != 0 and p.finger_present[1] != 0:
        touch_each_other(plant, table, now, stage, is_first)
    for finger in range(2):
        plant.external[finger] = forces[finger]
        forces[finger] += free_joint(plant, finger, now, is_first)


@inner_kernel
def evaluate_state(plant: Plant, table: Table) -> None:
    """Evaluate all contacts and forces for the current state."""
    evaluate_hand(plant, table, plant.state, plant.stages[0], True)


@inner_kernel
def script_x(plant: Plant, t: float) -> float:
    """Return x [m] of a scripted object at ``t``. The object moves left, then back, then right."""
    p = plant.parameters
    x: float = p.script_x
    left = p.script_travel[0]
    right = p.script_travel[1]
    if p.script_speed > 0.0 and left + right > 0.0:
        path = (p.script_speed * t) % (2.0 * (left + right))
        if path <= 2.0 * left:
            x += abs(left - path) - left
        else:
            x += right - abs(right - (path - 2.0 * left))
    return x
