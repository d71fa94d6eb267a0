"""One soft tip of the simulated hand against the object: the kernel that evaluates its forces.

The tip touches the object's nearest point: on a face, along the face's normal; on a corner, along
the line to it, as if on the plane normal to that line. All elastic forces are the gradient of one
energy, so that the contact can't create any:

    U = w(θ) [ U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d) ] + U_rim(d, θ)

U₀ and F are energy and force of the contact table. With a constant modulus E, F = πEd²/cos θ and
the second term is πE(d² d_t tan θ + d d_t²), the parallel-distributed model's tangential energy;
for other materials F carries their effective modulus into it. w(θ) is 1 where the soft hemisphere
is and fades to 0 towards the finger's side. U_rim is a stiff spring between the backing plate's rim
and the object, met at d = a(1 − |sin θ|), the end of the soft tip's range; from there on U₀ goes on
linearly in d and F stays.

Friction is Coulomb's: d_t stays within the two shears at which |T| = μN. Where the model's own
ratio |T|/N can't reach μ (with a constant E it can't exceed 1 at θ = 0), the tip slips at its
largest ratio. Losses are viscous, each proportional to the soft part's stiffness, so they grow with
the contact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import layout
from kinematics.kernels import kernel
from kinematics.lookup import lookup

FloatArray = NDArray[np.float64]

_D_MIN = 1e-9  # m, less is no contact
_FADE_FROM = 1.15  # rad, where w(θ) begins to fade
_FADE_TO = 1.35  # rad, where nothing soft is left
_CLOSEST = 1e-3  # of the radius: how near a corner the tip's centre counts


@kernel
def fade(theta: float) -> tuple[float, float]:
    """w(θ) and dw/dθ."""
    u = (abs(theta) - _FADE_FROM) / (_FADE_TO - _FADE_FROM)
    if u <= 0.0:
        return 1.0, 0.0
    if u >= 1.0:
        return 0.0, 0.0
    slope = -6.0 * u * (1.0 - u) / (_FADE_TO - _FADE_FROM)
    return 1.0 - u * u * (3.0 - 2.0 * u), slope if theta > 0.0 else -slope


@kernel
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


@kernel
def nearest(
    u: float, v: float, half_width: float, half_height: float
) -> tuple[float, float, float]:
    """Way from a point (u, v) of the object's frame to its boundary: direction inwards, distance.

    The direction leads from an outer point to the nearest one of the rectangle. For a point inside
    the distance is negative, to the nearest face, and the direction that face's inward normal.
    """
    across = max(abs(u) - half_width, 0.0)
    along = max(abs(v) - half_height, 0.0)
    to_left = -1.0 if u > 0.0 else 1.0
    down = -1.0 if v > 0.0 else 1.0
    if along == 0.0:
        depth = abs(u) - half_width
        if across == 0.0 and abs(v) - half_height > depth:
            return 0.0, down, abs(v) - half_height
        return to_left, 0.0, depth
    if across == 0.0:
        return 0.0, down, along
    distance = math.sqrt(across * across + along * along)
    return to_left * across / distance, down * along / distance, distance


@kernel
def evaluate_tip(
    memory: FloatArray,
    data: FloatArray,
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
    mu, mv, distance = nearest(
        rx * nx + ry * ny,
        ry * nx - rx * ny,
        memory[layout.HALF_WIDTH],
        memory[layout.HALF_HEIGHT],
    )
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
    gain, gain_theta = fade(theta)
    memory[row + layout.D] = d
    memory[row + layout.THETA] = theta
    memory[row + layout.GAIN] = gain

    # Rows over (q, x, y, φ); (px, py) is the contact point from the object's centre.
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
    if d + reach <= _D_MIN:
        for place in range(layout.FORCE, layout.TIP_ROW):
            memory[row + place] = 0.0
        return
    theta_q = side
    theta_x = 0.0
    theta_y = 0.0
    theta_turn = 1.0
    if mu != 0.0 and mv != 0.0:
        # On a corner m turns with the tip's place, not with the object.
        inverse = 1.0 / max(distance, _CLOSEST * radius)
        theta_q -= v_t * inverse
        theta_x = -my * inverse
        theta_y = mx * inverse
        theta_turn = turn_t * inverse
    rate_theta = theta_q * q_rate + theta_x * x_rate + theta_y * y_rate + theta_turn * turn_rate

    # The backing plate's rim.
    rim_theta = radius * cosine if sine >= 0.0 else -radius * cosine
    clearance = radius * (1.0 - abs(sine))
    rim = max(d - clearance, 0.0)
    rim_force = memory[layout.RIM_STIFFNESS] * rim
    along_d = rim_force
    along_theta = rim_force * rim_theta
    energy = 0.5 * rim_force * rim
    force = 0.0
    normal = rim_force
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
    if gain > 0.0 and d > _D_MIN:
        # The soft part within its range; d_soft_d, d_soft_theta are d_soft's derivatives.
        d_soft = d
        d_soft_d = 1.0
        d_soft_theta = 0.0
        if d_soft > clearance:
            d_soft = clearance
            d_soft_d = 0.0
            d_soft_theta = -rim_theta
        if d_soft > memory[layout.D_MAX]:
            d_soft = memory[layout.D_MAX]
            d_soft_d = 0.0
            d_soft_theta = 0.0
        force, soft, force_d, force_theta, _, soft_theta, _ = lookup(data, d_soft, theta)
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
        n0 = gain * slope - t0 * tangent + rim_force
        n1 = gain * d_soft_d * force_d * sine - t1 * tangent
        n2 = gain * d_soft_d * ratio * (force_d - force * inverse_d)
        bend = max(n2, 0.25 * gain * force * ratio * inverse_d)
        neutral = -0.5 * tangent * d_soft  # where T = 0
        at_neutral = n0 + neutral * (n1 + neutral * n2)
        # Most steps are far from slip, which two comparisons tell.
        normal = n0 + shear * (n1 + shear * n2)
        tangential = t0 + t1 * shear
        friction = memory[layout.FRICTION]
        if abs(tangential) > friction * normal or bend * (shear - neutral) ** 2 > at_neutral:
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

    hard = 0.0
    if d + reach > clearance:
        # The rim's row is that of d plus rim_theta times that of θ: twice each bounds it.
        hard = 2.0 * memory[layout.RIM_STIFFNESS]

    # Stick: the object's velocity at the contact less the tip's, along t, less tan θ ḋ.
    t_q = side * distance - v_t - tangent * v_m
    t_x = -my + tangent * mx
    t_y = mx + tangent * my
    t_turn = turn_t + tangent * turn_m
    rate_t = t_q * q_rate + t_x * x_rate + t_y * y_rate + t_turn * turn_rate

    # Losses: a tip that leaves doesn't pull, and shear's loss stays within friction.
    loss_d = memory[layout.LOSS] * stiffness_d
    if rate_d < 0.0:
        loss_d = min(loss_d, max(normal, 0.0) / -rate_d)
    loss_theta = memory[layout.LOSS] * stiffness_theta
    loss_t = memory[layout.LOSS] * stiffness_t
    if rate_t != 0.0:
        opposed = tangential if rate_t > 0.0 else -tangential
        most = max(memory[layout.FRICTION] * normal - opposed, 0.0)
        loss_t = min(loss_t, most / abs(rate_t))
    along_d += loss_d * rate_d
    along_theta += loss_theta * rate_theta
    along_t = tangential + loss_t * rate_t

    memory[row + layout.FORCE] = gain * force
    memory[row + layout.ENERGY] = energy
    memory[row + layout.RIM] = rim
    memory[row + layout.NORMAL] = normal
    memory[row + layout.TANGENTIAL] = tangential
    memory[row + layout.TIP_SHEAR] = shear
    memory[row + layout.SHEAR_RATE] = rate_t if d > _D_MIN else 0.0
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
    memory[row + layout.Q] = -(along_d * v_m + along_theta * theta_q + along_t * t_q)
    memory[row + layout.Q + 1] = along_d * mx - along_theta * theta_x - along_t * t_x
    memory[row + layout.Q + 2] = along_d * my - along_theta * theta_y - along_t * t_y
    memory[row + layout.Q + 3] = along_d * turn_m - along_theta * theta_turn - along_t * t_turn
    memory[row + layout.K_D] = stiffness_d + coming + hard
    memory[row + layout.K_THETA] = stiffness_theta + hard * rim_theta * rim_theta
    memory[row + layout.K_T] = stiffness_t
    memory[row + layout.C_D] = loss_d + memory[layout.LOSS] * coming
    memory[row + layout.C_THETA] = loss_theta
    memory[row + layout.C_T] = loss_t
