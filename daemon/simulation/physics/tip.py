"""One soft tip of the simulated hand: the law of its contact, and its contact with the object.

All elastic forces are the gradient of one energy, so that the contact can't create any:

    U = w(θ) κ [ U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d) ] + U_rim(d, θ)

U₀ and F are energy and force of the contact table, for a plane face. With a constant modulus E,
F = πEd²/cos θ and the second term is πE(d² d_t tan θ + d d_t²), the parallel-distributed model's
tangential energy; for other materials F carries their effective modulus into it. w(θ) is 1 where
the soft hemisphere is and fades to 0 towards the finger's side. U_rim is a stiff spring between the
backing plate's rim and the object, met on a plane at d = a(1 − |sin θ|), the end of the soft tip's
range; just before it, at a(1 − √(sin² θ + 0.03²)), U₀ goes on linearly in d and F stays.

The tip touches the object's nearest point: on a face, along the face's normal; on a corner, along
the line to it, as if on the plane normal to that line; on a disc, along the line to its centre. A
disc stands upright on the hand's plane, so that its face is curved about one axis, with radius R.
Against the springs of the tip it takes the place of its tangent plane with two changes to leading
order in d: the footprint is narrower along the tilt by κ² = R/(R + a), the curvatures adding to
1/a + 1/R, and force and energy are κ times those of the plane, whatever θ. Integrals over the very
springs, for a constant modulus, a = 20 mm and d up to 8 mm, are within 1.6 % of that upright and
within 4.5 % at 30° for R = 20 and 40 mm, within 3 % and 9 % for R = 10 mm. The sensor's frame is
rendered from those springs (`simulation.sensor.curved_face`), so its sum differs by as much.

Friction is Coulomb's: d_t stays within the two shears at which |T| = μN. Where the model's own
ratio |T|/N can't reach μ (with a constant E it can't exceed 1 at θ = 0), the tip slips at its
largest ratio. Losses are viscous, each proportional to the soft part's stiffness, so they grow with
the contact.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.outline import nearest, rim_on_disc, rim_on_plane
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer
from softfinger.kinematics.contact.lookup import lookup_at

D_MIN = 1e-9  # m, less is no contact
_FADE_FROM = 1.15  # rad, where w(θ) begins to fade
_FADE_TO = 1.35  # rad, where nothing soft is left
_CLOSEST = 1e-3  # of the radius: how near a corner the tip's centre counts
_WITHIN = 5e-13  # of friction's limit
_BEFORE_RIM = 0.03  # of the radius, when the plate is parallel to the face: end of the soft range


@inner_kernel
def fade(theta: float) -> tuple[float, float]:
    """w(θ) and dw/dθ."""
    u = (abs(theta) - _FADE_FROM) / (_FADE_TO - _FADE_FROM)
    if u <= 0.0:
        return 1.0, 0.0
    if u >= 1.0:
        return 0.0, 0.0
    slope = -6.0 * u * (1.0 - u) / (_FADE_TO - _FADE_FROM)
    return 1.0 - u * u * (3.0 - 2.0 * u), slope if theta > 0.0 else -slope


@inner_kernel
def shear_limit(t1: float, n0: float, n1: float, n2: float, friction: float) -> float:
    """Largest ζ ≥ 0 with t1 ζ ≤ μ (n0 + n1 ζ + n2 ζ²), or the ζ of the largest ratio.

    ζ is the shear measured from where T = 0.
    """
    if friction <= 0.0 or n0 <= 0.0:
        return 0.0
    b = t1 - friction * n1
    rest = b * b - 4.0 * friction * friction * n0 * n2
    if b > 0.0 and rest >= 0.0:
        return 2.0 * friction * n0 / (b + math.sqrt(rest))
    return math.sqrt(n0 / n2)


@inner_kernel
def clear_row(memory: Pointer, row: int) -> None:
    """A tip without contact; d, θ and the gain stay."""
    for place in range(layout.FORCE, layout.TIP_ROW):
        memory[row + place] = 0.0


@inner_kernel
def press(
    memory: Pointer,
    data: Pointer,
    row: int,
    share: float,
    sine: float,
    cosine: float,
    reach: float,
    rate_d: float,
    rate_theta: float,
    slide: float,
    shear: float,
) -> None:
    """The law of the contact: what d, θ and shear of the ``row`` do along d, θ and d_t.

    ``share`` is κ, ``reach`` how much deeper the step may lead; ``slide`` [m/s] is the velocity of
    what is touched less the tip's, along t. Takes D, THETA, RIM and what belongs to the rim from
    the row, and writes the rest but the rows over the coordinates and Q.
    """
    d = memory[row + layout.D]
    theta = memory[row + layout.THETA]
    gain, gain_theta = fade(theta)
    gain *= share
    gain_theta *= share
    memory[row + layout.GAIN] = gain
    along_d = 0.0
    along_theta = 0.0
    energy = 0.0
    if memory[row + layout.RIM] > 0.0:
        along_d = memory[row + layout.RIM_D]
        along_theta = memory[row + layout.RIM_THETA]
        energy = memory[row + layout.RIM_ENERGY]
    force = 0.0
    normal = along_d
    tangential = 0.0
    tangent = 0.0
    stiffness_d = 0.0
    stiffness_theta = 0.0
    stiffness_t = 0.0
    coming = 0.0  # stiffness of the soft part that the step may add
    if gain > 0.0:
        inverse_cosine = 1.0 / cosine
        tangent = sine * inverse_cosine
        coming = 2.0 * math.pi * memory[layout.MODULUS] * gain * reach * inverse_cosine
    if gain > 0.0 and d > D_MIN:
        # The soft part within its range; d_soft_d, d_soft_theta are d_soft's derivatives.
        radius = memory[layout.RADIUS]
        d_soft = d
        d_soft_d = 1.0
        d_soft_theta = 0.0
        if d > radius * (1.0 - _BEFORE_RIM - abs(sine)):
            bent = math.sqrt(sine * sine + _BEFORE_RIM * _BEFORE_RIM)
            limit = radius * (1.0 - bent)
            if d > limit:
                d_soft = limit
                d_soft_d = 0.0
                d_soft_theta = -radius * sine * cosine / bent
        force, soft, force_d, force_theta, _, soft_theta, _ = lookup_at(data, d_soft, theta)
        scale = memory[layout.SCALE]
        force *= scale
        force_d *= scale
        force_theta *= scale
        # ∂U₀/∂d = F/cos θ for every material; beyond the range U₀ goes on along that slope.
        inverse_d = 1.0 / d_soft
        slope = force * inverse_cosine
        over = d - d_soft
        soft = scale * soft + slope * over
        soft_theta = (
            scale * soft_theta
            + (force_theta + force * tangent + force_d * d_soft_theta) * inverse_cosine * over
        )

        # T and N are polynomials of the shear: T = t0 + t1 d_t, N = n0 + n1 d_t + n2 d_t².
        ratio = cosine * inverse_d
        t0 = gain * force * sine
        t1 = 2.0 * gain * force * ratio
        n0 = gain * slope - t0 * tangent + along_d
        n1 = gain * d_soft_d * force_d * sine - t1 * tangent
        n2 = gain * d_soft_d * ratio * (force_d - force * inverse_d)
        bend = max(n2, 0.25 * gain * force * ratio * inverse_d)
        neutral = -0.5 * tangent * d_soft  # where T = 0
        at_neutral = n0 + neutral * (n1 + neutral * n2)
        # Most steps are far from slip, which two comparisons tell.
        normal = n0 + shear * (n1 + shear * n2)
        tangential = t0 + t1 * shear
        friction = memory[layout.FRICTION]
        # What was brought within the limits just now is within them.
        most = friction * normal * (1.0 + _WITHIN)
        if abs(tangential) > most or bend * (shear - neutral) ** 2 > at_neutral:
            slope_there = n1 + 2.0 * n2 * neutral
            highest = neutral + shear_limit(t1, at_neutral, slope_there, bend, friction)
            lowest = neutral - shear_limit(t1, at_neutral, -slope_there, bend, friction)
            shear = min(max(shear, lowest), highest)
            normal = n0 + shear * (n1 + shear * n2)
            tangential = t0 + t1 * shear

        # U's second term and its derivatives.
        stretch = sine * shear + ratio * shear * shear
        by_soft = force_d * stretch - force * ratio * inverse_d * shear * shear
        by_theta = force_theta * stretch + force * shear * (cosine - sine * inverse_d * shear)
        soft += force * stretch
        energy += gain * soft
        along_d += gain * (slope + d_soft_d * by_soft)
        along_theta += gain * (soft_theta + by_theta + d_soft_theta * by_soft) + gain_theta * soft
        stiffness_d = gain * force_d * inverse_cosine
        stiffness_theta = gain * slope * inverse_cosine * d_soft * (2.0 / 3.0)
        stiffness_t = t1
    else:
        shear = 0.0

    # Losses: a tip that leaves doesn't pull, and shear's loss stays within friction. Stick is
    # without slide, but for the tan θ ḋ that keeps the virtual work consistent.
    rate_t = slide - tangent * rate_d
    loss = memory[layout.LOSS]
    loss_d = loss * stiffness_d
    if rate_d < 0.0:
        loss_d = min(loss_d, max(normal, 0.0) / -rate_d)
    loss_theta = loss * stiffness_theta
    loss_t = loss * stiffness_t
    if rate_t != 0.0:
        opposed = tangential if rate_t > 0.0 else -tangential
        least = max(memory[layout.FRICTION] * normal - opposed, 0.0)
        loss_t = min(loss_t, least / abs(rate_t))
    memory[row + layout.FORCE] = gain * force
    memory[row + layout.ENERGY] = energy
    memory[row + layout.NORMAL] = normal
    memory[row + layout.TANGENTIAL] = tangential
    memory[row + layout.TIP_SHEAR] = shear
    memory[row + layout.SHEAR_RATE] = rate_t if d > D_MIN else 0.0
    memory[row + layout.K_D] = stiffness_d + coming
    memory[row + layout.K_THETA] = stiffness_theta
    memory[row + layout.K_T] = stiffness_t
    memory[row + layout.C_D] = loss_d + loss * coming
    memory[row + layout.C_THETA] = loss_theta
    memory[row + layout.C_T] = loss_t
    memory[row + layout.ALONG_D] = along_d + loss_d * rate_d
    memory[row + layout.ALONG_THETA] = along_theta + loss_theta * rate_theta
    memory[row + layout.ALONG_T] = tangential + loss_t * rate_t
    memory[row + layout.TANGENT] = tangent


@inner_kernel
def stiffen_by_rim(memory: Pointer, row: int) -> None:
    """Add the rim's stiffness to a row whose step may meet it.

    Its own row is at most that of d and a times that of θ; twice each bounds it.
    """
    hard = 2.0 * memory[layout.RIM_STIFFNESS]
    memory[row + layout.K_D] += hard
    memory[row + layout.K_THETA] += hard * memory[layout.RADIUS] ** 2


@inner_kernel
def evaluate_tip(
    memory: Pointer,
    data: Pointer,
    row: int,
    finger: int,
    velocity: int,
    cq: float,
    sq: float,
    vx: float,
    vy: float,
    rx: float,
    ry: float,
    nx: float,
    ny: float,
    shear: float,
) -> None:
    """Fill the tip's ``row`` of the plant's ``memory``; ``velocity`` is where the velocities are.

    ``cq``, ``sq`` are cosine and sine of the joint angle, (vx, vy) the tip centre's derivative by
    it, (rx, ry) the tip's centre from the object's, (nx, ny) the object's n; ``shear`` is d_t.
    """
    side = 1.0 - 2.0 * finger
    radius = memory[layout.RADIUS]
    mu, mv, distance, curved = nearest(memory, rx * nx + ry * ny, ry * nx - rx * ny)
    # m leads from the tip's centre into the object, t is m turned by a right angle.
    mx = mu * nx - mv * ny
    my = mu * ny + mv * nx
    d = radius - distance
    # Tip axis (±cos q, −sin q); θ is the angle from it to m.
    ux = side * cq
    uy = -sq
    cosine = ux * mx + uy * my
    sine = ux * my - uy * mx
    theta = math.atan2(sine, cosine)
    memory[row + layout.D] = d
    memory[row + layout.THETA] = theta

    # Rows over (q, x, y, φ); the contact point is at ``distance`` m from the tip's centre.
    px = rx + distance * mx
    py = ry + distance * my
    turn_m = my * px - mx * py
    turn_t = mx * px + my * py
    v_m = vx * mx + vy * my
    v_t = vy * mx - vx * my
    q_rate = memory[velocity + finger]
    x_rate = memory[velocity + 2]
    y_rate = memory[velocity + 3]
    turn_rate = memory[velocity + 4]
    rate_d = v_m * q_rate - mx * x_rate - my * y_rate - turn_m * turn_rate
    # The integrator's matrix takes the stiffness of where the step leads, so that an impact meets
    # it at once; losses take that of here.
    reach = max(memory[layout.STEP] * rate_d, 0.0)
    if d + reach <= D_MIN:
        memory[row + layout.GAIN] = fade(theta)[0] * memory[layout.SHARE]
        clear_row(memory, row)
        return
    theta_q = side
    theta_x = 0.0
    theta_y = 0.0
    theta_turn = 1.0
    if curved >= 0.0:
        # m turns with the way from the tip's centre to the centre of curvature, which is fixed in
        # the object: the corner itself, or the disc's centre.
        inverse = 1.0 / max(distance + curved, _CLOSEST * radius)
        theta_q -= v_t * inverse
        theta_x = -my * inverse
        theta_y = mx * inverse
        theta_turn = (turn_t + curved) * inverse
        memory[row + layout.BEND] = 1.0 / curved if curved > 0.0 else 0.0
    else:
        memory[row + layout.BEND] = 0.0
    if curved > 0.0:
        rim = rim_on_disc(memory, row, distance + curved, curved, sine, cosine)
    else:
        rim = rim_on_plane(memory, row, d, sine, cosine)
    memory[row + layout.RIM] = max(rim, 0.0)
    rate_theta = theta_q * q_rate + theta_x * x_rate + theta_y * y_rate + theta_turn * turn_rate
    # The object's velocity at the contact less the tip's, along t.
    t_q = side * distance - v_t
    slide = t_q * q_rate - my * x_rate + mx * y_rate + turn_t * turn_rate
    press(
        memory,
        data,
        row,
        memory[layout.SHARE],
        sine,
        cosine,
        reach,
        rate_d,
        rate_theta,
        slide,
        shear,
    )
    if rim + reach > 0.0:
        stiffen_by_rim(memory, row)
    tangent = memory[row + layout.TANGENT]
    t_q -= tangent * v_m
    t_x = -my + tangent * mx
    t_y = mx + tangent * my
    t_turn = turn_t + tangent * turn_m
    memory[row + layout.JD] = v_m
    memory[row + layout.JD + 1] = -mx
    memory[row + layout.JD + 2] = -my
    memory[row + layout.JD + 3] = -turn_m
    memory[row + layout.JTHETA] = theta_q
    memory[row + layout.JTHETA + 1] = theta_x
    memory[row + layout.JTHETA + 2] = theta_y
    memory[row + layout.JTHETA + 3] = theta_turn
    memory[row + layout.JT] = t_q
    memory[row + layout.JT + 1] = t_x
    memory[row + layout.JT + 2] = t_y
    memory[row + layout.JT + 3] = t_turn
    along_d = memory[row + layout.ALONG_D]
    along_theta = memory[row + layout.ALONG_THETA]
    along_t = memory[row + layout.ALONG_T]
    memory[row + layout.Q] = -(along_d * v_m + along_theta * theta_q + along_t * t_q)
    memory[row + layout.Q + 1] = along_d * mx - along_theta * theta_x - along_t * t_x
    memory[row + layout.Q + 2] = along_d * my - along_theta * theta_y - along_t * t_y
    memory[row + layout.Q + 3] = along_d * turn_m - along_theta * theta_turn - along_t * t_turn
