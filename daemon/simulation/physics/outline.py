"""The object's outline as a tip sees it: the nearest point, and the rim of the tip's backing plate.

Only kernels live here. The object is rigid and convex: a rectangle, a polygon of four edges (the
wedge) or a disc.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics import layout
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

FACE = -1.0  # radius of curvature that stands for a plane face
_SMALLEST = 1e-12  # m


@inner_kernel
def nearest_on_rectangle(
    u: float, v: float, half_width: float, half_height: float
) -> tuple[float, float, float, float]:
    """Way from a point (u, v) of the object's frame to its boundary: direction inwards, distance.

    The direction leads from an outer point to the nearest one of the rectangle. For a point inside
    the distance is negative, to the nearest face, and the direction that face's inward normal. The
    last result is the boundary's radius of curvature there: 0 on a corner, ``FACE`` on a face.
    """
    across = max(abs(u) - half_width, 0.0)
    along = max(abs(v) - half_height, 0.0)
    to_left = -1.0 if u > 0.0 else 1.0
    down = -1.0 if v > 0.0 else 1.0
    if along == 0.0:
        depth = abs(u) - half_width
        if across == 0.0 and abs(v) - half_height > depth:
            return 0.0, down, abs(v) - half_height, FACE
        return to_left, 0.0, depth, FACE
    if across == 0.0:
        return 0.0, down, along, FACE
    distance = math.sqrt(across * across + along * along)
    return to_left * across / distance, down * along / distance, distance, 0.0


@inner_kernel
def nearest_on_polygon(memory: Pointer, u: float, v: float) -> tuple[float, float, float, float]:
    """As :func:`nearest_on_rectangle`, for the edges of layout.OUTLINE."""
    best = -math.inf
    face = layout.OUTLINE
    for k in range(4):
        edge = layout.OUTLINE + k * layout.EDGE
        out = (u - memory[edge + layout.EDGE_X]) * memory[edge + layout.EDGE_NORMAL_X]
        out += (v - memory[edge + layout.EDGE_Y]) * memory[edge + layout.EDGE_NORMAL_Y]
        if out > best:
            best = out
            face = edge
        if out > 0.0:
            # Edges run counter-clockwise: along an edge is its normal turned by a right angle.
            along = (v - memory[edge + layout.EDGE_Y]) * memory[edge + layout.EDGE_NORMAL_X]
            along -= (u - memory[edge + layout.EDGE_X]) * memory[edge + layout.EDGE_NORMAL_Y]
            if 0.0 <= along <= memory[edge + layout.EDGE_LENGTH]:
                best = out
                face = edge
                break
    else:
        if best > 0.0:
            distance = math.inf
            to_u = 0.0
            to_v = 0.0
            for k in range(4):
                edge = layout.OUTLINE + k * layout.EDGE
                way_u = memory[edge + layout.EDGE_X] - u
                way_v = memory[edge + layout.EDGE_Y] - v
                way = math.sqrt(way_u * way_u + way_v * way_v)
                if way < distance:
                    distance = way
                    to_u = way_u / way
                    to_v = way_v / way
            return to_u, to_v, distance, 0.0
    return -memory[face + layout.EDGE_NORMAL_X], -memory[face + layout.EDGE_NORMAL_Y], best, FACE


@inner_kernel
def nearest(memory: Pointer, u: float, v: float) -> tuple[float, float, float, float]:
    """As :func:`nearest_on_rectangle`, for whatever shape the object has; a disc's radius last."""
    shape = memory[layout.SHAPE]
    if shape == layout.RECTANGLE:
        found: tuple[float, float, float, float] = nearest_on_rectangle(
            u, v, memory[layout.HALF_WIDTH], memory[layout.HALF_HEIGHT]
        )
    elif shape == layout.POLYGON:
        found = nearest_on_polygon(memory, u, v)
    else:
        away = max(math.sqrt(u * u + v * v), _SMALLEST)
        radius = memory[layout.ROUNDNESS]
        found = (-u / away, -v / away, away - radius, radius)
    return found


@inner_kernel
def rim_on_plane(memory: Pointer, row: int, d: float, sine: float, cosine: float) -> float:
    """Press both ends of the rim into a plane; how deep the deeper one is [m], negative: a gap.

    They are d − a(1 ∓ sin θ) deep, each on a spring of its own, so that energy and forces are
    smooth also where the plate lies flat on the face. Writes energy and derivatives to the ``row``
    when the rim is met.
    """
    radius = memory[layout.RADIUS]
    deepest: float = d - radius * (1.0 - abs(sine))
    if deepest > 0.0:
        right = max(d - radius * (1.0 - sine), 0.0)
        left = max(d - radius * (1.0 + sine), 0.0)
        stiffness = memory[layout.RIM_STIFFNESS]
        memory[row + layout.RIM_ENERGY] = 0.5 * stiffness * (left * left + right * right)
        memory[row + layout.RIM_D] = stiffness * (left + right)
        memory[row + layout.RIM_THETA] = stiffness * radius * cosine * (right - left)
    return deepest


@inner_kernel
def rim_on_disc(
    memory: Pointer, row: int, away: float, roundness: float, sine: float, cosine: float
) -> float:
    """As :func:`rim_on_plane`, the plate's chord pressed into a disc by one spring.

    ``away`` is the distance of the disc's centre from the tip's. The chord is as deep in the disc
    as the disc's radius exceeds the distance of its centre from the chord, and that is smooth.
    """
    radius = memory[layout.RADIUS]
    across = away * sine
    up = away * cosine
    beyond = max(abs(across) - radius, 0.0)
    clear = math.sqrt(up * up + beyond * beyond)
    rim: float = roundness - clear
    if rim > 0.0:
        force = memory[layout.RIM_STIFFNESS] * rim
        inverse = 1.0 / max(clear, _SMALLEST)
        outwards = beyond if across > 0.0 else -beyond
        memory[row + layout.RIM_ENERGY] = 0.5 * force * rim
        # ∂(away)/∂d = −1.
        memory[row + layout.RIM_D] = force * inverse * (up * cosine + outwards * sine)
        memory[row + layout.RIM_THETA] = force * inverse * (up * across - outwards * up)
    return rim
