"""Evaluate object-to-palm and tip-to-tip contacts, which occur only in some scenes.

Palm contacts and tip-to-tip contacts add rows to the step matrix (see `solver`).

The palm is a plane parallel to the x axis. Each corner of the object, or the lowest point of a
disc, has two springs. The first spring pushes a corner up if the corner is below the palm's
surface. The damping of the first spring never pulls the corner down. The second spring models
Coulomb friction along the palm. The corner slips when the force of the second spring reaches the
friction coefficient times the normal force. Because of the second spring, a resting object does not
creep.

The tips are equal hemispheres and meet in the plane midway between their centres. Each tip is
compressed as if by a rigid plane. If the centres are a distance D apart, the compression is d = a −
D/2. The total energy of both tips is U(d, θ1, d_t1) + U(d, θ2, d_t2), which equals 2 U(d, θ) for
symmetric fingers. If the tilts differ, a real contact surface bulges towards the softer tip. The
modelled energy is then too high by a second-order term in the difference between the tips' cos² θ.
Both tips stick equally to the contact plane. Each tip's shear rate is half the sliding velocity
between the two surfaces, minus the tip's tan θ ḋ.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.outline import rim_on_plane
from softfinger.daemon.simulation.physics.plant_state import (
    ALONG_D,
    ALONG_SHEAR,
    ALONG_THETA,
    CORNERS,
    DISC,
    EXTRA_ROWS,
    NO_OBJECT,
    PALM_ROWS,
    Motion,
    Plant,
    Stage,
)
from softfinger.daemon.simulation.physics.tip import D_MIN, clear_contact, contact_forces, fade
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.table_record import Table

STIFFNESS = 1e5  # normal and tangential contact stiffness of a corner on the palm [N/m]
LOSS = 1e-3  # ratio of damping to stiffness [s]
# Maximum distance between the tip centres at which the contact is evaluated, in tip diameters.
_DISTANCE_MAX = 1.5


@inner_kernel
def palm_is_far(plant: Plant, now: Motion) -> bool:
    """Return True if the object can't touch the palm during this step."""
    p = plant.parameters
    height = now.position[3] - p.palm - p.extent
    rate = now.velocity[3]
    turning = now.velocity[4] * p.extent
    return bool(height > p.step * (abs(rate) + abs(turning)))


@inner_kernel
def touch_palm(
    plant: Plant, now: Motion, stage: Stage, nx: float, ny: float, is_first: bool
) -> None:
    """Add the forces that the palm exerts on the object; (nx, ny) is the object's face normal n.

    In the first stage, this function also applies the friction limit to the shears and sets the
    palm rows of the step matrix.
    """
    if palm_is_far(plant, now):
        for corner in range(CORNERS):
            stage.extra_rate[corner] = 0.0
        if is_first and plant.palm_energy != 0.0:
            plant.palm_energy = 0.0
            for corner in range(CORNERS):
                now.extra_shear[corner] = 0.0
        return
    p = plant.parameters
    height = now.position[3] - p.palm
    x_rate = now.velocity[2]
    y_rate = now.velocity[3]
    turn_rate = now.velocity[4]
    round_ = p.shape == DISC
    energy = 0.0
    for corner in range(1 if round_ else p.corners):
        lever_x = 0.0
        lever_y = -p.roundness
        if not round_:
            u = p.outline[corner].x
            v = p.outline[corner].y
            lever_x = u * nx - v * ny
            lever_y = u * ny + v * nx
        depth = -(height + lever_y)
        rate = -(y_rate + lever_x * turn_rate)
        slip_rate = x_rate - lever_y * turn_rate
        coming = max(depth, depth + p.step * rate) > 0.0
        normal = 0.0
        drag = 0.0
        loss = LOSS * STIFFNESS
        along = 0.0
        if depth > 0.0:
            normal = max(STIFFNESS * (depth + LOSS * rate), 0.0)
            along_max = p.palm_friction * normal
            along = min(max(STIFFNESS * now.extra_shear[corner], -along_max), along_max)
            energy += 0.5 * (STIFFNESS * depth * depth + along * along / STIFFNESS)
            if slip_rate != 0.0:
                opposed = along if slip_rate > 0.0 else -along
                loss = min(loss, (along_max - opposed) / abs(slip_rate))
            drag = along + loss * slip_rate
            plant.forces[2] -= drag
            plant.forces[3] += normal
            plant.forces[4] += normal * lever_x + drag * lever_y
        stage.extra_rate[corner] = slip_rate if depth > 0.0 else 0.0
        if is_first:
            now.extra_shear[corner] = along / STIFFNESS
            up = plant.extra[2 * corner]
            up.row[3] = -1.0
            up.row[4] = -lever_x
            up.stiffness = STIFFNESS if coming else 0.0
            up.damping = LOSS * STIFFNESS if coming else 0.0
            up.shear = 0
            side = plant.extra[2 * corner + 1]
            side.row[2] = 1.0
            side.row[4] = -lever_y
            side.stiffness = up.stiffness
            side.damping = loss if coming else 0.0
            side.shear = 1 + corner
            plant.has_extra_rows = plant.has_extra_rows or coming
    plant.palm_energy = energy


@inner_kernel
def tip_on_tip(
    plant: Plant, table: Table, now: Motion, stage: Stage, apart_x: float, apart_y: float
) -> bool:
    """Evaluate the tip-to-tip contact and add its torques; return True if the tips may touch.

    (apart_x, apart_y) is the vector from the left to the right tip's centre [m].
    """
    p = plant.parameters
    left, right = plant.fingers[0], plant.fingers[1]
    apart = math.sqrt(apart_x * apart_x + apart_y * apart_y)
    half = 0.5 * apart
    d = p.radius - half
    ex = apart_x / apart
    ey = apart_y / apart
    # Tip velocities per unit of joint velocity, along e and along e rotated by 90°.
    m1 = left.x_q * ex + left.y_q * ey
    m2 = right.x_q * ex + right.y_q * ey
    t1 = left.y_q * ex - left.x_q * ey
    t2 = right.y_q * ex - right.x_q * ey
    q1_rate = now.velocity[0]
    q2_rate = now.velocity[1]
    rate_d = 0.5 * (m1 * q1_rate - m2 * q2_rate)
    travel = max(p.step * rate_d, 0.0)
    touching = bool(d + travel > D_MIN)
    slide1 = 0.5 * (half - t1)
    slide2 = 0.5 * (t2 - half)
    for finger in range(2):
        tip = stage.on_tip[finger]
        side = 1.0 - 2.0 * finger
        ux = plant.fingers[finger].cosine  # The finger axis and e are mirrored for the right tip.
        uy = -side * plant.fingers[finger].sine
        tip.sine = ux * ey - uy * ex
        tip.cosine = ux * ex + uy * ey
        tip.theta = math.atan2(tip.sine, tip.cosine)
        tip.d = d
        if not touching:
            tip.gain = fade(tip.theta)[0]
            clear_contact(tip)
            continue
        by_q1 = -t1 / apart
        by_q2 = t2 / apart
        if finger == 0:
            by_q1 += 1.0
        else:
            by_q2 -= 1.0
        rim_on_plane(p, tip)
        tip.curvature = 0.0
        tip.travel = travel
        tip.rate_d = rate_d
        tip.rate_theta = by_q1 * q1_rate + by_q2 * q2_rate
        tip.slip_rate = slide1 * q1_rate + slide2 * q2_rate
        tip.shear = now.extra_shear[CORNERS + finger]
        contact_forces(p, table, tip, 1.0)
        tangent = tip.tangent
        tip.rows[ALONG_D, 0] = 0.5 * m1
        tip.rows[ALONG_D, 1] = -0.5 * m2
        tip.rows[ALONG_THETA, 0] = by_q1
        tip.rows[ALONG_THETA, 1] = by_q2
        tip.rows[ALONG_SHEAR, 0] = slide1 - tangent * 0.5 * m1
        tip.rows[ALONG_SHEAR, 1] = slide2 + tangent * 0.5 * m2
        for j in range(2):
            plant.forces[j] -= (
                tip.along[ALONG_D] * tip.rows[ALONG_D, j]
                + tip.along[ALONG_THETA] * tip.rows[ALONG_THETA, j]
                + tip.along[ALONG_SHEAR] * tip.rows[ALONG_SHEAR, j]
            )
    return touching


@inner_kernel
def touch_each_other(plant: Plant, table: Table, now: Motion, stage: Stage, is_first: bool) -> None:
    """Add the tip-to-tip torques if the tips are close or there is no object.

    In the first stage, this function also sets the tip-to-tip rows in the step matrix.
    """
    apart_x = plant.fingers[1].x - plant.fingers[0].x
    apart_y = plant.fingers[1].y - plant.fingers[0].y
    far = 2.0 * _DISTANCE_MAX * plant.parameters.radius
    near = apart_x**2 + apart_y**2 <= far**2 or plant.parameters.shape == NO_OBJECT
    touching = near and tip_on_tip(plant, table, now, stage, apart_x, apart_y)
    for finger in range(2):
        tip = stage.on_tip[finger]
        stage.extra_rate[CORNERS + finger] = tip.shear_rate if touching else 0.0
        if is_first and plant.tips_may_touch and not near:
            clear_contact(tip)
            plant.state.extra_shear[CORNERS + finger] = 0.0
    if not is_first:
        return
    plant.tips_may_touch = near
    if touching:
        plant.has_extra_rows = True
        for finger in range(2):
            tip = stage.on_tip[finger]
            for r in range(3):
                extra = plant.extra[PALM_ROWS + 3 * finger + r]
                extra.row[0] = tip.rows[r, 0]
                extra.row[1] = tip.rows[r, 1]
                extra.stiffness = tip.stiffness[r]
                extra.damping = tip.damping[r]
                extra.shear = 1 + CORNERS + finger if r == ALONG_SHEAR else 0


@inner_kernel
def clear_extra(plant: Plant) -> None:
    """Clear the extra rows of the step matrix."""
    for number in range(EXTRA_ROWS):
        plant.extra[number].stiffness = 0.0
        plant.extra[number].damping = 0.0
