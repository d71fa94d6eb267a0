"""Find the contacts of tips, object and palm, and add their forces to the plant.

A tip touches the nearest point of the object, a rigid convex polygon or disc. On a face, the
contact direction is the face normal. At a corner, the contact direction is the line to the corner.
The corner acts like a plane that is normal to the contact direction. On a disc, the contact
direction is the line to the disc centre.

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

Palm contacts and tip-to-tip contacts occur only in some scenes. They add extra rows to the step
matrix.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import (
    ALONG_D,
    ALONG_SHEAR,
    ALONG_THETA,
    CORNERS,
    DISC,
    NO_OBJECT,
    PALM_ROWS,
    Motion,
    Parameters,
    Plant,
    Stage,
    TipContact,
)
from softfinger.daemon.simulation.physics.tip import (
    D_MIN,
    RIM_STIFFNESS,
    along_row,
    clear_contact,
    contact_forces,
    fade,
)
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.table_record import Table

_FACE = -1.0  # curvature radius that denotes a flat face
_DISTANCE_MIN = 1e-12  # m
# Minimum distance from the tip centre to a corner, as a fraction of the radius.
_CORNER_DISTANCE_MIN = 1e-3
# Maximum distance between the tip centres at which the contact is evaluated, in tip diameters.
_TIP_DISTANCE_MAX = 1.5
PALM_STIFFNESS = 1e5  # normal and tangential contact stiffness of a corner on the palm [N/m]
PALM_LOSS = 1e-3  # ratio of damping to stiffness [s]


@inner_kernel
def nearest(p: Parameters, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the direction, distance and curvature radius of the outline point nearest to (u, v).

    The point (u, v) is given in the object's frame. If (u, v) is outside the object, the direction
    points to the nearest point of the outline. If (u, v) is inside, the direction is the inward
    normal of the nearest face, and the distance is negative. The curvature radius is 0 at a corner,
    −1 on a face, and the disc radius on a disc.
    """
    if p.shape == DISC:
        away = max(math.sqrt(u * u + v * v), _DISTANCE_MIN)
        return -u / away, -v / away, away - p.roundness, p.roundness
    best = -math.inf
    face = 0
    for k in range(p.corners):
        edge = p.outline[k]
        out = (u - edge.x) * edge.normal_x
        out += (v - edge.y) * edge.normal_y
        if out > best:
            best = out
            face = k
        if out > 0.0:
            # Edges run counter-clockwise, so rotating an outward normal by 90° gives the edge
            # direction.
            along = (v - edge.y) * edge.normal_x
            along -= (u - edge.x) * edge.normal_y
            if 0.0 <= along <= edge.length:
                best = out
                face = k
                break
    else:
        if best > 0.0:
            distance = math.inf
            to_u = 0.0
            to_v = 0.0
            for k in range(p.corners):
                to_corner_u = p.outline[k].x - u
                to_corner_v = p.outline[k].y - v
                length = math.sqrt(to_corner_u * to_corner_u + to_corner_v * to_corner_v)
                if length < distance:
                    distance = length
                    to_u = to_corner_u / length
                    to_v = to_corner_v / length
            return to_u, to_v, distance, 0.0
    return -p.outline[face].normal_x, -p.outline[face].normal_y, best, _FACE


@inner_kernel
def rim_on_plane(p: Parameters, tip: TipContact) -> None:
    """Evaluate both ends of the rim on a plane, and set the rim depth to the larger depth.

    The depths of the two ends are d − a(1 ∓ sin θ). Each end has its own spring, so energy and
    forces are smooth even if the plate lies flat on the face. If the rim is in contact, this
    function sets the rim energy and its derivatives.
    """
    d = tip.d
    sine = tip.sine
    radius = p.radius
    tip.rim = d - radius * (1.0 - abs(sine))
    if tip.rim > 0.0:
        right = max(d - radius * (1.0 - sine), 0.0)
        left = max(d - radius * (1.0 + sine), 0.0)
        tip.rim_energy = 0.5 * RIM_STIFFNESS * (left * left + right * right)
        tip.rim_d = RIM_STIFFNESS * (left + right)
        tip.rim_theta = RIM_STIFFNESS * radius * tip.cosine * (right - left)


@inner_kernel
def rim_on_disc(p: Parameters, tip: TipContact, away: float) -> None:
    """Evaluate the rim on a disc as in :func:`rim_on_plane`, but with a single spring.

    ``away`` is the distance between the disc centre and the tip centre. The depth is the disc
    radius minus the distance from the disc centre to the rim's chord.
    """
    across = away * tip.sine
    up = away * tip.cosine
    beyond = max(abs(across) - p.radius, 0.0)
    clear = math.sqrt(up * up + beyond * beyond)
    tip.rim = p.roundness - clear
    if tip.rim > 0.0:
        force = RIM_STIFFNESS * tip.rim
        inverse = 1.0 / max(clear, _DISTANCE_MIN)
        outwards = beyond if across > 0.0 else -beyond
        tip.rim_energy = 0.5 * force * tip.rim
        # ∂(away)/∂d = −1.
        tip.rim_d = force * inverse * (up * tip.cosine + outwards * tip.sine)
        tip.rim_theta = force * inverse * (up * across - outwards * up)


@inner_kernel
def touch_palm(
    plant: Plant, now: Motion, stage: Stage, nx: float, ny: float, is_first: bool
) -> None:
    """Add the forces that the palm exerts on the object; (nx, ny) is the object's face normal n.

    In the first stage, this function also applies the friction limit to the shears and sets the
    palm rows of the step matrix.
    """
    p = plant.parameters
    height = now.position[3] - p.palm
    x_rate = now.velocity[2]
    y_rate = now.velocity[3]
    turn_rate = now.velocity[4]
    # The object can't touch the palm during this step.
    if height - p.extent > p.step * (abs(y_rate) + abs(turn_rate * p.extent)):
        for corner in range(CORNERS):
            stage.extra_rate[corner] = 0.0
        if is_first and plant.palm_energy != 0.0:
            plant.palm_energy = 0.0
            for corner in range(CORNERS):
                now.extra_shear[corner] = 0.0
        return
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
        loss = PALM_LOSS * PALM_STIFFNESS
        along = 0.0
        if depth > 0.0:
            normal = max(PALM_STIFFNESS * (depth + PALM_LOSS * rate), 0.0)
            along_max = p.palm_friction * normal
            along = min(max(PALM_STIFFNESS * now.extra_shear[corner], -along_max), along_max)
            energy += 0.5 * (PALM_STIFFNESS * depth * depth + along * along / PALM_STIFFNESS)
            if slip_rate != 0.0:
                opposed = along if slip_rate > 0.0 else -along
                loss = min(loss, (along_max - opposed) / abs(slip_rate))
            drag = along + loss * slip_rate
            plant.forces[2] -= drag
            plant.forces[3] += normal
            plant.forces[4] += normal * lever_x + drag * lever_y
        stage.extra_rate[corner] = slip_rate if depth > 0.0 else 0.0
        if is_first:
            now.extra_shear[corner] = along / PALM_STIFFNESS
            up = plant.extra[2 * corner]
            up.row[3] = -1.0
            up.row[4] = -lever_x
            up.stiffness = PALM_STIFFNESS if coming else 0.0
            up.damping = PALM_LOSS * PALM_STIFFNESS if coming else 0.0
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
def apply_tip_forces(
    plant: Plant, table: Table, tip: TipContact, now: Motion, factor: float
) -> None:
    """Evaluate the contact law for ``tip`` in the state ``now``, and add its forces to the plant.

    The function expects the derivatives of the sliding distance in the row ``ALONG_SHEAR``, and
    replaces them with the derivatives of d_t.
    """
    tip.rate_theta = along_row(tip, ALONG_THETA, now.velocity)
    tip.slip_rate = along_row(tip, ALONG_SHEAR, now.velocity)
    contact_forces(plant.parameters, table, tip, factor)
    for j in range(5):
        tip.rows[ALONG_SHEAR, j] -= tip.tangent * tip.rows[ALONG_D, j]
        plant.forces[j] -= (
            tip.along[ALONG_D] * tip.rows[ALONG_D, j]
            + tip.along[ALONG_THETA] * tip.rows[ALONG_THETA, j]
            + tip.along[ALONG_SHEAR] * tip.rows[ALONG_SHEAR, j]
        )


@inner_kernel
def touch_object(
    plant: Plant, table: Table, tip: TipContact, finger: int, now: Motion, nx: float, ny: float
) -> None:
    """Evaluate a finger's ``tip`` on the object in state ``now``; (nx, ny) is the face normal n."""
    p, its, rows = plant.parameters, plant.fingers[finger], tip.rows
    factor = p.factor * plant.relaxation_factor[finger]
    rx = its.x - now.position[2]
    ry = its.y - now.position[3]
    mu, mv, distance, curved = nearest(p, rx * nx + ry * ny, ry * nx - rx * ny)
    # The vector m points from the tip centre into the object, and t is m rotated by 90°.
    mx = mu * nx - mv * ny
    my = mu * ny + mv * nx
    # θ is the angle from the tip axis (±cos q, −sin q) to m.
    side = 1.0 - 2.0 * finger
    ux = side * its.cosine
    uy = -its.sine
    tip.cosine = ux * mx + uy * my
    tip.sine = ux * my - uy * mx
    tip.theta = math.atan2(tip.sine, tip.cosine)
    tip.d = p.radius - distance

    # Derivatives with respect to (q, x, y, φ). The vector from the tip centre to the contact point
    # is ``distance`` · m.
    px = rx + distance * mx
    py = ry + distance * my
    rotation_t = mx * px + my * py
    v_t = its.y_q * mx - its.x_q * my
    rows[ALONG_D, finger] = its.x_q * mx + its.y_q * my
    rows[ALONG_D, 2] = -mx
    rows[ALONG_D, 3] = -my
    rows[ALONG_D, 4] = mx * py - my * px
    tip.rate_d = along_row(tip, ALONG_D, now.velocity)
    # The step matrix uses the stiffness at the end of the step, so it remains accurate during an
    # impact. Damping uses the stiffness at the present position.
    tip.travel = max(p.step * tip.rate_d, 0.0)
    if tip.d + tip.travel <= D_MIN:
        tip.gain = fade(tip.theta)[0] * factor
        clear_contact(tip)
        return
    rows[ALONG_THETA, finger] = side
    rows[ALONG_THETA, 2] = 0.0
    rows[ALONG_THETA, 3] = 0.0
    rows[ALONG_THETA, 4] = 1.0
    if curved >= 0.0:
        # The vector m points to a fixed point of the object, which is either a corner or the centre
        # of a disc.
        inverse = 1.0 / max(distance + curved, _CORNER_DISTANCE_MIN * p.radius)
        rows[ALONG_THETA, finger] -= v_t * inverse
        rows[ALONG_THETA, 2] = -my * inverse
        rows[ALONG_THETA, 3] = mx * inverse
        rows[ALONG_THETA, 4] = (rotation_t + curved) * inverse
    # Sliding of the object relative to the tip, along t.
    rows[ALONG_SHEAR, finger] = side * distance - v_t
    rows[ALONG_SHEAR, 2] = -my
    rows[ALONG_SHEAR, 3] = mx
    rows[ALONG_SHEAR, 4] = rotation_t
    if curved > 0.0:
        tip.curvature = 1.0 / curved
        rim_on_disc(p, tip, distance + curved)
    else:
        tip.curvature = 0.0
        rim_on_plane(p, tip)
    tip.shear = now.shear[finger]
    tip.shear_variance = plant.shear_variance[finger]
    apply_tip_forces(plant, table, tip, now, factor)


@inner_kernel
def touch_each_other(plant: Plant, table: Table, now: Motion, stage: Stage, is_first: bool) -> None:
    """Evaluate the tip-to-tip contact if the tips are close or there is no object.

    In the first stage, this function also sets the tip-to-tip rows in the step matrix.
    """
    p, left, right = plant.parameters, plant.fingers[0], plant.fingers[1]
    apart_x = right.x - left.x
    apart_y = right.y - left.y
    square = apart_x * apart_x + apart_y * apart_y
    near = square <= (2.0 * _TIP_DISTANCE_MAX * p.radius) ** 2 or p.shape == NO_OBJECT
    if not near:
        for finger in range(2):
            stage.extra_rate[CORNERS + finger] = 0.0
            if is_first and plant.tips_may_touch:
                clear_contact(stage.on_tip[finger])
                plant.state.extra_shear[CORNERS + finger] = 0.0
    if is_first:
        plant.tips_may_touch = near
    if not near:
        return
    # The unit vector e points from the left to the right tip's centre.
    apart = math.sqrt(square)
    half = 0.5 * apart
    ex = apart_x / apart
    ey = apart_y / apart
    # Tip velocities per unit of joint velocity, along e and along e rotated by 90°.
    m1 = left.x_q * ex + left.y_q * ey
    m2 = right.x_q * ex + right.y_q * ey
    t1 = left.y_q * ex - left.x_q * ey
    t2 = right.y_q * ex - right.x_q * ey
    for finger in range(2):
        tip, side = stage.on_tip[finger], 1.0 - 2.0 * finger
        ux = plant.fingers[finger].cosine  # The finger axis and e are mirrored for the right tip.
        uy = -side * plant.fingers[finger].sine
        tip.sine = ux * ey - uy * ex
        tip.cosine = ux * ex + uy * ey
        tip.theta = math.atan2(tip.sine, tip.cosine)
        tip.d = p.radius - half
        tip.rows[ALONG_D, 0] = 0.5 * m1
        tip.rows[ALONG_D, 1] = -0.5 * m2
        tip.rate_d = along_row(tip, ALONG_D, now.velocity)
        tip.travel = max(p.step * tip.rate_d, 0.0)
        if tip.d + tip.travel <= D_MIN:
            tip.gain = fade(tip.theta)[0]
            clear_contact(tip)
            stage.extra_rate[CORNERS + finger] = 0.0
            continue
        tip.rows[ALONG_THETA, 0] = -t1 / apart
        tip.rows[ALONG_THETA, 1] = t2 / apart
        tip.rows[ALONG_THETA, finger] += side
        tip.rows[ALONG_SHEAR, 0] = 0.5 * (half - t1)
        tip.rows[ALONG_SHEAR, 1] = 0.5 * (t2 - half)
        tip.curvature = 0.0
        tip.shear = now.extra_shear[CORNERS + finger]
        rim_on_plane(p, tip)
        apply_tip_forces(plant, table, tip, now, 1.0)
        stage.extra_rate[CORNERS + finger] = tip.shear_rate
        if is_first:
            plant.has_extra_rows = True
            for r in range(3):
                extra = plant.extra[PALM_ROWS + 3 * finger + r]
                extra.row[0] = tip.rows[r, 0]
                extra.row[1] = tip.rows[r, 1]
                extra.stiffness = tip.stiffness[r]
                extra.damping = tip.damping[r]
                extra.shear = 1 + CORNERS + finger if r == ALONG_SHEAR else 0
