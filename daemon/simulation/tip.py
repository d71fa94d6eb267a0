"""One soft tip of the simulated hand against the object: the kernel that evaluates its forces.

All elastic forces are the gradient of one energy, so that the contact can't create any:

    U = w(s) [ U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d) + U_rim(d, θ) ]

U₀ and F are energy and force of the contact table. With a constant modulus E, F = πEd²/cos θ and
the second term is πE(d² d_t tan θ + d d_t²), the parallel-distributed model's tangential energy;
for other materials F carries their effective modulus into it. w(s) is 1 on the face and fades to 0
where the tip rolls over its edge. U_rim is a stiff spring between the backing plate's rim and the
object, met at d = a(1 − |sin θ|), the end of the soft tip's range; from there on U₀ goes on
linearly in d and F stays.

Friction is Coulomb's: d_t stays within the two shears at which |T| = μN. Where the model's own
ratio |T|/N can't reach μ (with a constant E it can't exceed 1 at θ = 0), the tip slips at its
largest ratio.
Losses are viscous, each proportional to its stiffness, so they grow with the contact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.simulation import layout
from kinematics.kernels import kernel
from kinematics.table import lookup

FloatArray = NDArray[np.float64]

_D_MIN = 1e-9  # m, less is no contact
_THETA_MAX = 1.3  # beyond this tilt only the rim is left, the soft part no longer changes with θ
_SIN_MAX = math.sin(_THETA_MAX)
_COS_MAX = math.cos(_THETA_MAX)


@kernel
def nearest_face(u: float, v: float, half_width: float, half_height: float) -> int:
    """Face that a point (u, v) of the object's frame is outside of most: as below.

    0 left, 1 bottom, 2 right, 3 top; inside the rectangle it is the face the point is nearest to.
    """
    across = abs(u) - half_width
    along = abs(v) - half_height
    if across >= along:
        return 2 if u > 0.0 else 0
    return 3 if v > 0.0 else 1


@kernel
def edge_window(s: float, half: float, fade: float) -> tuple[float, float]:
    """w(s) and dw/ds: 1 on a face of ``half`` length, 0 beyond its edge, smooth over ± ``fade``."""
    beyond = abs(s) - (half - fade)
    if beyond <= 0.0:
        return 1.0, 0.0
    u = beyond / (2.0 * fade)
    if u >= 1.0:
        return 0.0, 0.0
    slope = -3.0 * u * (1.0 - u) / fade
    return 1.0 - u * u * (3.0 - 2.0 * u), slope if s > 0.0 else -slope


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
    face: int,
    shear: float,
) -> None:
    """Fill the tip's ``row`` of the plant's ``memory``; ``velocity`` is where the velocities are.

    ``cq``, ``sq`` are cosine and sine of the joint angle, (vx, vy) the tip centre's derivative by
    it, (rx, ry) the tip's centre from the object's, (nx, ny) the object's n; ``shear`` is d_t.
    """
    side = 1.0 - 2.0 * finger
    half_width = memory[layout.HALF_WIDTH]
    half_height = memory[layout.HALF_HEIGHT]
    # Inward normal m of the face, along which the tip presses, and the face's direction.
    if face == 0:
        mx, my = nx, ny
    elif face == 1:
        mx, my = -ny, nx
    elif face == 2:
        mx, my = -nx, -ny
    else:
        mx, my = ny, -nx
    upright = face == 0 or face == 2
    half_depth = half_width if upright else half_height
    half_face = half_height if upright else half_width
    radius = memory[layout.RADIUS]
    depth = rx * mx + ry * my
    s = ry * mx - rx * my
    d = radius + half_depth + depth
    # Tip axis (±cos q, −sin q); θ is the angle from it to m.
    ux = side * cq
    uy = -sq
    cosine = ux * mx + uy * my
    sine = ux * my - uy * mx
    theta = math.atan2(sine, cosine)
    fade = min(0.25 * radius, 0.9 * half_face)
    gain, gain_slope = edge_window(s, half_face, fade)
    memory[row + layout.D] = d
    memory[row + layout.THETA] = theta
    memory[row + layout.GAIN] = gain
    if d <= _D_MIN or gain <= 0.0:
        for place in range(layout.FORCE, layout.TIP_ROW):
            memory[row + place] = 0.0
        return

    # The rim, then the soft part within its range; d_soft_d, d_soft_theta are d_soft's derivatives.
    rim = max(d - radius * (1.0 - abs(sine)), 0.0)
    rim_theta = radius * cosine if sine >= 0.0 else -radius * cosine
    rim_force = memory[layout.RIM_STIFFNESS] * rim
    turning = 1.0  # dθ_soft/dθ
    if abs(theta) > _THETA_MAX:
        turning = 0.0
        theta = _THETA_MAX if theta > 0.0 else -_THETA_MAX
        sine = _SIN_MAX if theta > 0.0 else -_SIN_MAX
        cosine = _COS_MAX
    d_soft = d
    d_soft_d = 1.0
    d_soft_theta = 0.0
    if d_soft > radius * (1.0 - abs(sine)):
        d_soft = radius * (1.0 - abs(sine))
        d_soft_d = 0.0
        d_soft_theta = -radius * cosine if sine >= 0.0 else radius * cosine
    if d_soft > memory[layout.D_MAX]:
        d_soft = memory[layout.D_MAX]
        d_soft_d = 0.0
        d_soft_theta = 0.0
    force, energy, force_d, force_theta, _, energy_theta, _ = lookup(data, d_soft, theta)
    scale = memory[layout.SCALE]
    force *= scale
    force_d *= scale
    force_theta *= scale
    # ∂U₀/∂d = F/cos θ for every material; beyond the range U₀ goes on along that slope.
    inverse_cosine = 1.0 / cosine
    inverse_d = 1.0 / d_soft
    tangent = sine * inverse_cosine
    slope = force * inverse_cosine
    over = d - d_soft
    energy = scale * energy + slope * over
    energy_theta = (
        scale * energy_theta
        + (force_theta + force * tangent + force_d * d_soft_theta) * inverse_cosine * over
    )

    # T and N are polynomials of the shear: T = t0 + t1 d_t, N = n0 + n1 d_t + n2 d_t².
    ratio = cosine * inverse_d
    t0 = force * sine
    t1 = 2.0 * force * ratio
    n0 = slope - t0 * tangent + rim_force
    n1 = d_soft_d * force_d * sine - t1 * tangent
    n2 = d_soft_d * ratio * (force_d - force * inverse_d)
    bend = max(n2, 0.25 * force * ratio * inverse_d)
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
    normal *= gain
    tangential *= gain

    # U's second term G and its derivatives.
    stretch = sine * shear + ratio * shear * shear
    by_soft = force_d * stretch - force * ratio * inverse_d * shear * shear
    by_theta = force_theta * stretch + force * shear * (cosine - sine * inverse_d * shear)
    energy += force * stretch + 0.5 * rim_force * rim
    along_d = gain * (slope + d_soft_d * by_soft + rim_force)
    along_theta = gain * (
        turning * (energy_theta + by_theta + d_soft_theta * by_soft) + rim_force * rim_theta
    )
    along_s = gain_slope * energy

    # Rows over (q, x, y, φ); that of θ is (side, 0, 0, 1).
    arm = radius - d
    s_q = vy * mx - vx * my
    d_q = vx * mx + vy * my
    t_q = arm * side - s_q - tangent * d_q
    t_x = -my + tangent * mx
    t_y = mx + tangent * my
    t_turn = arm + depth - tangent * s
    q_rate = memory[velocity + finger]
    x_rate = memory[velocity + 2]
    y_rate = memory[velocity + 3]
    turn_rate = memory[velocity + 4]
    rate_d = d_q * q_rate - mx * x_rate - my * y_rate + s * turn_rate
    rate_t = t_q * q_rate + t_x * x_rate + t_y * y_rate + t_turn * turn_rate
    rate_theta = side * q_rate + turn_rate

    # Losses: a tip that leaves doesn't pull, and shear's loss stays within friction.
    stiffness_d = gain * force_d * inverse_cosine
    stiffness_theta = turning * gain * slope * inverse_cosine * d_soft * (2.0 / 3.0)
    stiffness_t = gain * t1
    if rim > 0.0:
        # The rim's row is that of d plus rim_theta times that of θ: twice each bounds it.
        stiffness_d += 2.0 * gain * memory[layout.RIM_STIFFNESS]
        stiffness_theta += 2.0 * gain * memory[layout.RIM_STIFFNESS] * rim_theta * rim_theta
    loss_d = memory[layout.LOSS] * stiffness_d
    if rate_d < 0.0:
        loss_d = min(loss_d, max(normal, 0.0) / -rate_d)
    loss_theta = memory[layout.LOSS] * stiffness_theta
    loss_t = memory[layout.LOSS] * stiffness_t
    if rate_t != 0.0:
        opposed = tangential if rate_t > 0.0 else -tangential
        loss_t = min(loss_t, max(memory[layout.FRICTION] * normal - opposed, 0.0) / abs(rate_t))
    along_d += loss_d * rate_d
    along_theta += loss_theta * rate_theta
    along_t = tangential + loss_t * rate_t

    memory[row + layout.FORCE] = gain * force
    memory[row + layout.ENERGY] = gain * energy
    memory[row + layout.RIM] = rim
    memory[row + layout.NORMAL] = normal
    memory[row + layout.TANGENTIAL] = tangential
    memory[row + layout.TIP_SHEAR] = shear
    memory[row + layout.SHEAR_RATE] = rate_t
    memory[row + layout.JD] = d_q
    memory[row + layout.JD + 1] = -mx
    memory[row + layout.JD + 2] = -my
    memory[row + layout.JD + 3] = s
    memory[row + layout.JT] = t_q
    memory[row + layout.JT + 1] = t_x
    memory[row + layout.JT + 2] = t_y
    memory[row + layout.JT + 3] = t_turn
    memory[row + layout.Q] = -(along_d * d_q + along_theta * side + along_t * t_q + along_s * s_q)
    memory[row + layout.Q + 1] = along_d * mx - along_t * t_x - along_s * my
    memory[row + layout.Q + 2] = along_d * my - along_t * t_y + along_s * mx
    memory[row + layout.Q + 3] = -(along_d * s + along_theta + along_t * t_turn - along_s * depth)
    memory[row + layout.K_D] = stiffness_d
    memory[row + layout.K_THETA] = stiffness_theta
    memory[row + layout.K_T] = stiffness_t
    memory[row + layout.C_D] = loss_d
    memory[row + layout.C_THETA] = loss_theta
    memory[row + layout.C_T] = loss_t
