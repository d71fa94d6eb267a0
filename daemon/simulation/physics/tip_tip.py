"""Both tips pressed on each other, without an object between them.

Two equal hemispheres meet on the plane midway between their centres, and each is pressed as by a
rigid plane: d = a − D/2 with the centres' distance D. The energy is that of both, U(d, θ1, d_t1) +
U(d, θ2, d_t2), which is 2 U(d, θ) for fingers that mirror each other. With unlike tilts the plane
would bulge towards the softer tip, and this energy is a little too high (of second order in the
difference of cos² θ). The plane sticks to both tips alike: each shears by half of what their
surfaces slide along each other, less its tan θ ḋ. Only kernels live here.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.outline import rim_on_plane
from softfinger.daemon.simulation.physics.tip import D_MIN, clear_row, fade, press, stiffen_by_rim
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

_FAR = 1.5  # radii: half the centres' distance from which on nothing is evaluated


@inner_kernel
def evaluate_mutual(
    memory: Pointer,
    data: Pointer,
    row: int,
    position: int,
    velocity: int,
    shear: int,
) -> bool:
    """Fill both tips' rows from ``row`` on and add their torques to FORCES; may they touch?

    Both tips' centres stand in TIP_PLACE; ``position``, ``velocity`` and ``shear`` are where the
    coordinates, their rates and both shears are.
    """
    radius = memory[layout.RADIUS]
    place = layout.TIP_PLACE
    way_x = memory[place + 4] - memory[place]
    way_y = memory[place + 5] - memory[place + 1]
    apart = math.sqrt(way_x * way_x + way_y * way_y)
    half = 0.5 * apart
    d = radius - half
    ex = way_x / apart
    ey = way_y / apart
    # v·e and v along e turned by a right angle.
    m1 = memory[place + 2] * ex + memory[place + 3] * ey
    m2 = memory[place + 6] * ex + memory[place + 7] * ey
    t1 = memory[place + 3] * ex - memory[place + 2] * ey
    t2 = memory[place + 7] * ex - memory[place + 6] * ey
    q1_rate = memory[velocity]
    q2_rate = memory[velocity + 1]
    rate_d = 0.5 * (m1 * q1_rate - m2 * q2_rate)
    reach = max(memory[layout.STEP] * rate_d, 0.0)
    touching = bool(d + reach > D_MIN)
    slide1 = 0.5 * (half - t1)
    slide2 = 0.5 * (t2 - half)
    slide = slide1 * q1_rate + slide2 * q2_rate
    for finger in range(2):
        out = row + finger * layout.TIP_ROW
        side = 1.0 - 2.0 * finger
        q = memory[position + finger]
        ux = math.cos(q)  # the axis and e turned over for the right tip
        uy = -side * math.sin(q)
        cosine = ux * ex + uy * ey
        sine = ux * ey - uy * ex
        theta = math.atan2(sine, cosine)
        memory[out + layout.D] = d
        memory[out + layout.THETA] = theta
        if not touching:
            memory[out + layout.GAIN] = fade(theta)[0]
            clear_row(memory, out)
            continue
        by_q1 = -t1 / apart
        by_q2 = t2 / apart
        if finger == 0:
            by_q1 += 1.0
        else:
            by_q2 -= 1.0
        rim = rim_on_plane(memory, out, d, sine, cosine)
        memory[out + layout.RIM] = max(rim, 0.0)
        memory[out + layout.BEND] = 0.0
        press(
            memory,
            data,
            out,
            1.0,
            sine,
            cosine,
            reach,
            rate_d,
            by_q1 * q1_rate + by_q2 * q2_rate,
            slide,
            memory[shear + finger],
        )
        if rim + reach > 0.0:
            stiffen_by_rim(memory, out)
        tangent = memory[out + layout.TANGENT]
        memory[out + layout.JD] = 0.5 * m1
        memory[out + layout.JD + 1] = -0.5 * m2
        memory[out + layout.JTHETA] = by_q1
        memory[out + layout.JTHETA + 1] = by_q2
        memory[out + layout.JT] = slide1 - tangent * 0.5 * m1
        memory[out + layout.JT + 1] = slide2 + tangent * 0.5 * m2
        for j in range(2):
            memory[layout.FORCES + j] -= (
                memory[out + layout.ALONG_D] * memory[out + layout.JD + j]
                + memory[out + layout.ALONG_THETA] * memory[out + layout.JTHETA + j]
                + memory[out + layout.ALONG_T] * memory[out + layout.JT + j]
            )
    return touching


@inner_kernel
def tips_are_far(memory: Pointer) -> bool:
    """Whether both tips, at TIP_PLACE, are too far from each other to be looked at."""
    place = layout.TIP_PLACE
    way_x = memory[place + 4] - memory[place]
    way_y = memory[place + 5] - memory[place + 1]
    far = 2.0 * _FAR * memory[layout.RADIUS]
    return bool(way_x * way_x + way_y * way_y > far * far)


@inner_kernel
def mutual_rows(memory: Pointer) -> None:
    """Hand the first stage's rows of both tips to the coupled matrix."""
    for finger in range(2):
        row = layout.MUTUAL + finger * layout.TIP_ROW
        for number, place, stiffness, damping in (
            (0, layout.JD, layout.K_D, layout.C_D),
            (1, layout.JTHETA, layout.K_THETA, layout.C_THETA),
            (2, layout.JT, layout.K_T, layout.C_T),
        ):
            extra = layout.EXTRA + (layout.PALM_ROWS + 3 * finger + number) * layout.EXTRA_ROW
            memory[extra] = memory[row + place]
            memory[extra + 1] = memory[row + place + 1]
            memory[extra + 5] = memory[row + stiffness]
            memory[extra + 6] = memory[row + damping]
            memory[extra + 7] = 5.0 + finger if number == 2 else 0.0
