"""The object's outline as a tip sees it: the nearest point, and the rim of the tip's backing plate.

The object is rigid and convex: a polygon or a disc.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import DISC, Parameters, TipContact
from softfinger.kinematics.compiled.kernel import inner_kernel

FACE = -1.0  # radius of curvature that means a plane face
_SMALLEST = 1e-12  # m


@inner_kernel
def nearest(p: Parameters, u: float, v: float) -> tuple[float, float, float, float]:
    """Return inward direction and distance of the boundary from a point (u, v) in its frame.

    The direction leads from an outer point to the nearest one of the outline. For a point inside
    the distance is negative, to the nearest face, and the direction that face's inward normal. The
    last result is the boundary's radius of curvature there: 0 on a corner, ``FACE`` on a face, a
    disc's radius.
    """
    if p.shape == DISC:
        away = max(math.sqrt(u * u + v * v), _SMALLEST)
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
            # Edges run counter-clockwise: along an edge is its normal turned by a right angle.
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
    return -p.outline[face].normal_x, -p.outline[face].normal_y, best, FACE


@inner_kernel
def rim_on_plane(p: Parameters, tip: TipContact) -> float:
    """Press both ends of the rim into a plane; how deep the deeper one is [m], negative: a gap.

    They are d − a(1 ∓ sin θ) deep, each on a spring of its own, so that energy and forces are
    smooth also where the plate lies flat on the face. Writes the rim's energy and derivatives when
    it is met.
    """
    d = tip.d
    sine = tip.sine
    radius = p.radius
    deepest: float = d - radius * (1.0 - abs(sine))
    if deepest > 0.0:
        right = max(d - radius * (1.0 - sine), 0.0)
        left = max(d - radius * (1.0 + sine), 0.0)
        stiffness = p.rim_stiffness
        tip.rim_energy = 0.5 * stiffness * (left * left + right * right)
        tip.rim_d = stiffness * (left + right)
        tip.rim_theta = stiffness * radius * tip.cosine * (right - left)
    return deepest


@inner_kernel
def rim_on_disc(p: Parameters, tip: TipContact, away: float) -> float:
    """Evaluate :func:`rim_on_plane` for a disc, the plate's chord pressed into it by one spring.

    ``away`` is the distance of the disc's centre from the tip's. The chord is as deep in the disc
    as the disc's radius exceeds the distance of its centre from the chord, and that is smooth.
    """
    across = away * tip.sine
    up = away * tip.cosine
    beyond = max(abs(across) - p.radius, 0.0)
    clear = math.sqrt(up * up + beyond * beyond)
    rim: float = p.roundness - clear
    if rim > 0.0:
        force = p.rim_stiffness * rim
        inverse = 1.0 / max(clear, _SMALLEST)
        outwards = beyond if across > 0.0 else -beyond
        tip.rim_energy = 0.5 * force * rim
        # ∂(away)/∂d = −1.
        tip.rim_d = force * inverse * (up * tip.cosine + outwards * tip.sine)
        tip.rim_theta = force * inverse * (up * across - outwards * up)
    return rim
