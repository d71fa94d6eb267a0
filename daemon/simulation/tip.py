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

from kinematics.kernels import kernel
from kinematics.table import lookup

FloatArray = NDArray[np.float64]

# Places in a tip's row of the work array.
D = 0  # normal displacement [m], negative is a gap
THETA = 1  # tilt of the object against the tip [rad]
GAIN = 2  # w(s): share of the tip that is on the face
FORCE = 3  # total force on the tip's base, what a pressure grid sums to [N]
ENERGY = 4  # elastic energy [J]
RIM = 5  # how far the rim is pressed into the object [m], 0 when free
NORMAL = 6  # N [N]
TANGENTIAL = 7  # T [N]
SHEAR = 8  # d_t within its limits [m]
SHEAR_RATE = 9  # stick rate of d_t [m/s]
JD = 10  # row of ∂d over (q, x, y, φ)
JT = 14  # row of d_t's increments over (q, x, y, φ)
Q = 18  # generalised forces on (q, x, y, φ)
K_D = 22  # stiffness of the three rows d, θ, d_t
K_THETA = 23
K_T = 24
C_D = 25  # damping of the three rows
C_THETA = 26
C_T = 27
WORK = 28

# Places in the tip's part of the parameters.
RADIUS = 0
SCALE = 1  # real modulus over the table's
FRICTION = 2
LOSS = 3  # damping over stiffness [s]
RIM_STIFFNESS = 4
D_MAX = 5  # largest d the table answers [m]
TIP_PARAMETERS = 6

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
    side: float,
    cq: float,
    sq: float,
    vx: float,
    vy: float,
    rx: float,
    ry: float,
    nx: float,
    ny: float,
    face: int,
    half_width: float,
    half_height: float,
    shear: float,
    q_rate: float,
    x_rate: float,
    y_rate: float,
    turn_rate: float,
    tip: FloatArray,
    data: FloatArray,
    out: FloatArray,
) -> None:
    """Fill ``out`` [WORK] for one tip.

    ``cq``, ``sq`` are cosine and sine of the joint angle, (vx, vy) the tip centre's derivative by
    it, (rx, ry) the tip's centre from the object's, (nx, ny) the object's n; ``shear`` is d_t.
    """
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
    radius = tip[RADIUS]
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
    out[D] = d
    out[THETA] = theta
    out[GAIN] = gain
    if d <= _D_MIN or gain <= 0.0:
        out[FORCE:WORK] = 0.0
        return

    # The rim, then the soft part within its range; d_soft_d, d_soft_theta are d_soft's derivatives.
    rim = max(d - radius * (1.0 - abs(sine)), 0.0)
    rim_theta = radius * cosine if sine >= 0.0 else -radius * cosine
    rim_force = tip[RIM_STIFFNESS] * rim
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
    if d_soft > tip[D_MAX]:
        d_soft = tip[D_MAX]
        d_soft_d = 0.0
        d_soft_theta = 0.0
    force, energy, force_d, force_theta, _, energy_theta, _ = lookup(data, d_soft, theta)
    scale = tip[SCALE]
    force *= scale
    force_d *= scale
    force_theta *= scale
    # ∂U₀/∂d = F/cos θ for every material; beyond the range U₀ goes on along that slope.
    slope = force / cosine
    tangent = sine / cosine
    over = d - d_soft
    energy = scale * energy + slope * over
    energy_theta = (
        scale * energy_theta
        + (force_theta + force * tangent + force_d * d_soft_theta) / cosine * over
    )

    # T and N are polynomials of the shear: T = t0 + t1 d_t, N = n0 + n1 d_t + n2 d_t².
    ratio = cosine / d_soft
    t0 = force * sine
    t1 = 2.0 * force * ratio
    n0 = slope - t0 * tangent + rim_force
    n1 = d_soft_d * force_d * sine - t1 * tangent
    n2 = d_soft_d * ratio * (force_d - force / d_soft)
    neutral = -t0 / t1
    bend = max(n2, 0.25 * force * ratio / d_soft)
    at_neutral = n0 + neutral * (n1 + neutral * n2)
    slope_there = n1 + 2.0 * n2 * neutral
    highest = neutral + shear_limit(t1, at_neutral, slope_there, bend, tip[FRICTION])
    lowest = neutral - shear_limit(t1, at_neutral, -slope_there, bend, tip[FRICTION])
    shear = min(max(shear, lowest), highest)
    normal = gain * (n0 + shear * (n1 + shear * n2))
    tangential = gain * (t0 + t1 * shear)

    # U's second term G and its derivatives.
    stretch = sine * shear + ratio * shear * shear
    by_soft = force_d * stretch - force * ratio / d_soft * shear * shear
    by_theta = force_theta * stretch + force * shear * (cosine - sine / d_soft * shear)
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
    rate_d = d_q * q_rate - mx * x_rate - my * y_rate + s * turn_rate
    rate_t = t_q * q_rate + t_x * x_rate + t_y * y_rate + t_turn * turn_rate
    rate_theta = side * q_rate + turn_rate

    # Losses: a tip that leaves doesn't pull, and shear's loss stays within friction.
    stiffness_d = gain * force_d / cosine
    stiffness_theta = turning * gain * force * d_soft / (1.5 * cosine * cosine)
    stiffness_t = gain * t1
    if rim > 0.0:
        # The rim's row is that of d plus rim_theta times that of θ: twice each bounds it.
        stiffness_d += 2.0 * gain * tip[RIM_STIFFNESS]
        stiffness_theta += 2.0 * gain * tip[RIM_STIFFNESS] * rim_theta * rim_theta
    loss_d = tip[LOSS] * stiffness_d
    if rate_d < 0.0:
        loss_d = min(loss_d, max(normal, 0.0) / -rate_d)
    loss_theta = tip[LOSS] * stiffness_theta
    loss_t = tip[LOSS] * stiffness_t
    if rate_t != 0.0:
        opposed = tangential if rate_t > 0.0 else -tangential
        loss_t = min(loss_t, max(tip[FRICTION] * normal - opposed, 0.0) / abs(rate_t))
    along_d += loss_d * rate_d
    along_theta += loss_theta * rate_theta
    along_t = tangential + loss_t * rate_t

    out[FORCE] = gain * force
    out[ENERGY] = gain * energy
    out[RIM] = rim
    out[NORMAL] = normal
    out[TANGENTIAL] = tangential
    out[SHEAR] = shear
    out[SHEAR_RATE] = rate_t
    out[JD] = d_q
    out[JD + 1] = -mx
    out[JD + 2] = -my
    out[JD + 3] = s
    out[JT] = t_q
    out[JT + 1] = t_x
    out[JT + 2] = t_y
    out[JT + 3] = t_turn
    out[Q] = -(along_d * d_q + along_theta * side + along_t * t_q + along_s * s_q)
    out[Q + 1] = along_d * mx - along_t * t_x - along_s * my
    out[Q + 2] = along_d * my - along_t * t_y + along_s * mx
    out[Q + 3] = -(along_d * s + along_theta + along_t * t_turn - along_s * depth)
    out[K_D] = stiffness_d
    out[K_THETA] = stiffness_theta
    out[K_T] = stiffness_t
    out[C_D] = loss_d
    out[C_THETA] = loss_theta
    out[C_T] = loss_t
