"""Compute the point at which a tip, or the rim of its backing plate, touches the object.

The object is a rigid convex polygon or a disc.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import DISC, Parameters, TipContact
from softfinger.kinematics.compiled.kernel import inner_kernel

FACE = -1.0  # curvature radius that denotes a flat face
RIM_STIFFNESS = 1e6  # stiffness of the backing plate against the object [N/m]
_DISTANCE_MIN = 1e-12  # m


@inner_kernel
def nearest(p: Parameters, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the direction, distance and curvature radius of the outline point nearest to (u, v).

    The point (u, v) is given in the object's frame. If (u, v) is outside the object, the direction
    points to the nearest point of the outline. If (u, v) is inside, the direction is the inward
    normal of the nearest face, and the distance is negative. The curvature radius is 0 at a corner,
    ``FACE`` on a face, and the disc radius on a disc.
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
    return -p.outline[face].normal_x, -p.outline[face].normal_y, best, FACE


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
