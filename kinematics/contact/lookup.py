"""Lookup kernels for contact tables, and the table formats.

The table of a spring tip stores ratios. Each quantity is divided by its closed form for the modulus
at zero strain. The ratios are smooth, close to 1 and finite as d → 0. For a constant modulus, the
ratios are exactly 1 and the table has no coefficients.

The first coordinate is the height h = (a − d)/a. The second is y = u/h with u = √(1 − ρ²/(a² cos²
θ)), where ρ is the footprint radius. In these coordinates, the ratios are analytic up to the edges
of the domain. The coordinate y is even in θ. The value of y is 1 at θ = 0 and 0 at the limit on θ.
The peak strain is 1 − u. The domain has 16 slabs per octave of h. Each slab is divided into as many
pieces of y as the tolerance requires. The domain ends at h = 1/8, because the ratios diverge as log
h for h → 0.

For solid and measured tips, all six outputs are derived from the energy U = E a³ t⁵ g (see
`solid_data`). The function g(t, sin² θ) is a polynomial in t = √(d/a) and sin² θ. All outputs are
therefore consistent to within rounding. For a sticking face, a second polynomial q_0 describes the
reduction of the base force.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inlined_kernel, inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray, Records
from softfinger.kinematics.contact.closed_form import HALF_PI
from softfinger.kinematics.contact.table_record import (
    OCTAVES,
    SLAB_BITS,
    Lanes,
    LookupResult,
    Table,
    ThreeFloats,
    lanes,
)

H_END = 0.5**OCTAVES  # h at the end of the domain
_H_MIN = H_END * (1.0 + 2.0**-52)  # smallest number above H_END
_END = H_END * (1.0 - 1e-12)  # h at which the domain ends, with a margin for rounding

ENERGY, STICK = range(2)  # pieces of a solid tip's table: g and its partials, q_0 and its partials

_MANTISSA = 52
_FRACTION = (1 << _MANTISSA) - 1
_ONE = 1023 << _MANTISSA  # bits of 1.0
_FIRST = ((1023 - OCTAVES) << _MANTISSA) + 1  # bit pattern of the smallest number above H_END


@inlined_kernel
def _slab(h: float) -> tuple[int, float]:
    """Return the slab index of h, and the position of h within the slab (−1 to 1).

    The height h must be in (H_END, 1]. The index and the position are computed from the bits of h.
    The exponent determines the octave. The mantissa determines the slab and the position. Each slab
    includes its upper end but not its lower end.
    """
    number = int(np.float64(h).view(np.int64)) - _FIRST
    fraction = ((number << SLAB_BITS) & _FRACTION) | _ONE
    position = 2.0 * float(np.int64(fraction).view(np.float64)) - 3.0
    return number >> (_MANTISSA - SLAB_BITS), position


@inlined_kernel
def _ratios(table: Table, h: float, y: float) -> Lanes:
    """Return the ratios of the five quantities to their closed forms."""
    slab, position = _slab(h)
    splits = table.splits
    place = y * splits
    split = min(int(place), splits - 1)
    return lanes(table, slab * splits + split, 2.0 * (place - split) - 1.0, position)


@inner_kernel
def _springs_lookup(table: Table, d: float, theta: float) -> LookupResult:
    """Evaluate :func:`lookup` for a spring tip."""
    radius = table.radius
    h = (radius - d) * table.inverse_radius
    inside = h >= _END
    if h < _H_MIN:
        h = _H_MIN
        d = radius * (1.0 - h)
    s = math.sin(theta)
    c = math.cos(theta)
    gap = c * c - d * table.inverse_radius * (1.0 + h)
    if not (gap >= 0.0 and abs(theta) <= HALF_PI):
        limit = math.atan2(h, math.sqrt(d * table.inverse_radius * (1.0 + h)))
        # Due to rounding, a point exactly at the limit may reach this branch.
        inside = inside and abs(theta) <= limit * (1.0 + 1e-12)
        angle = min(max(theta, -limit), limit)
        s = math.sin(angle)
        c = math.cos(angle)
        gap = 0.0
    inverse = 1.0 / c
    r_f, r_u, r_fd, r_ft, r_ut = 1.0, 1.0, 1.0, 1.0, 1.0
    if not table.is_closed:
        both = 1.0 / (c * h)
        inverse = both * h
        r_f, r_u, r_fd, r_ft, r_ut = _ratios(table, h, math.sqrt(gap) * both)
    slope = s * inverse
    force_by_d = math.pi * table.modulus * d * inverse
    force = force_by_d * d
    energy = force * inverse * d * (1.0 / 3.0)
    return LookupResult(
        force * r_f,
        energy * r_u,
        2.0 * force_by_d * r_fd,
        force * slope * r_ft,
        force * r_f * inverse,
        2.0 * energy * slope * r_ut,
        inside,
    )


@inlined_kernel
def normal_force(table: Table, t: float, square: float) -> Lanes:
    """Return the normal force N, the energy U and their partials.

    The values are N/a² [Pa] with its ∂/∂d and ∂/∂sin² θ, and U/a³ [Pa] with its ∂/∂sin² θ.
    """
    place = t * table.by_root - 1.0, square * table.by_square - 1.0
    g, g_t, g_tt, g_s, g_ts = lanes(table, ENERGY, *place)
    size = table.modulus * t * t * t
    by_d = 0.25 * table.modulus * table.inverse_radius * t * (15.0 * g + t * (9.0 * g_t + t * g_tt))
    by_square = size * (2.5 * g_s + 0.5 * t * g_ts)
    return size * (2.5 * g + 0.5 * t * g_t), by_d, by_square, size * t * t * g, size * t * t * g_s


@inlined_kernel
def _clamped(table: Table, t: float, square: float) -> ThreeFloats:
    """Return F/(N cos θ) = 1 − sin² θ q_0 and its partials with respect to t and sin² θ."""
    if not table.sticks:
        return 1.0, 0.0, 0.0
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    q, q_t, q_s, _, _ = lanes(table, STICK, x, y)
    return 1.0 - square * q, -square * q_t, -q - square * q_s


@inner_kernel
def _solid_lookup(table: Table, d: float, theta: float) -> LookupResult:
    """Evaluate :func:`lookup` for a solid or measured tip.

    If |θ| is beyond the range of the data, the energy is assumed to be independent of θ. The
    partials are consistent with this assumption. The force still varies with cos θ.
    """
    within = abs(theta) <= table.tilt
    inside = within and d <= table.deepest
    angle = min(max(theta, -HALF_PI), HALF_PI)
    s = math.sin(angle)
    c = math.cos(angle)
    t = math.sqrt(min(d, table.deepest) * table.inverse_radius)
    square = s * s if within else 2.0 / table.by_square
    # The chain rule gives d(sin² θ)/dθ = 2 sin θ cos θ.
    chain = 2.0 * s * c if within else 0.0
    a = table.radius
    area = a * a
    normal, stiffness, normal_s, energy, energy_s = normal_force(table, t, square)
    held, held_t, held_s = _clamped(table, t, square)
    return LookupResult(
        c * area * normal * held,
        a * area * energy,
        c * area * (stiffness * held + normal * held_t * 0.5 / (a * t)),
        area * ((c * chain * normal_s - s * normal) * held + c * normal * chain * held_s),
        area * normal,
        chain * a * area * energy_s,
        inside,
    )


@inner_kernel
def _solid_normal(table: Table, d: float, theta: float) -> ThreeFloats:
    """Evaluate :func:`normal_at` for a sticking face."""
    within = abs(theta) <= table.tilt
    s = math.sin(theta)
    t = math.sqrt(d * table.inverse_radius)
    square = s * s if within else 2.0 / table.by_square
    normal, stiffness, normal_s, _, _ = normal_force(table, t, square)
    chain = 2.0 * s * math.cos(theta) if within else 0.0
    area = table.radius * table.radius
    return area * normal, area * stiffness, area * chain * normal_s


@inner_kernel
def lookup_at(table: Table, d: float, theta: float) -> LookupResult:
    """Evaluate :func:`lookup` for a single table record."""
    if math.isnan(d) or math.isnan(theta):
        nan = math.nan
        return LookupResult(nan, nan, nan, nan, nan, nan, False)
    if d <= 0.0:
        return LookupResult(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True)
    if table.is_solid:
        return _solid_lookup(table, d, theta)
    return _springs_lookup(table, d, theta)


@inner_kernel
def normal_at(
    table: Table, d: float, theta: float, forces: ThreeFloats, tangent: float, inverse_cosine: float
) -> ThreeFloats:
    """Return N = ∂U/∂d, ∂N/∂d and ∂N/∂θ within the domain.

    ``forces`` contains F, ∂F/∂d and ∂F/∂θ at the same d and θ.
    """
    if table.sticks:
        return _solid_normal(table, d, theta)
    force, force_d, force_theta = forces
    more = force_theta + force * tangent
    return force * inverse_cosine, force_d * inverse_cosine, more * inverse_cosine


@inner_kernel
def stiffness_ahead(table: Table, scale: float, depth: float) -> float:
    """Return ∂F/∂d [N/m] of an upright tip at ``depth`` [m]; for solid tips, use Hertz's theory.

    ``scale`` is 2πE [Pa], where E is the modulus at zero strain.
    """
    if not table.is_solid:
        return scale * depth
    return 0.5 * scale / math.pi * 3.75 * table.at_first * math.sqrt(depth * table.radius)


@kernel
def lookup(tables: Records[Table], d: float, theta: float) -> LookupResult:
    """Return force, energy and their partials at displacement d [m] and tilt θ [rad].

    The values are zero for d ≤ 0 and NaN for NaN input. If d or θ is outside the domain, it is
    clamped to the domain and ``inside`` is False.
    """
    return lookup_at(tables[0], d, theta)


@kernel
def lookups(
    tables: Records[Table],
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
    inside: NDArray[np.bool_],
) -> None:
    """Evaluate :func:`lookup` at each d, θ [n] and write to ``out`` [6, n] and ``inside`` [n]."""
    table = tables[0]
    for k in range(d.shape[0]):
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k], out[5, k], inside[k] = lookup_at(
            table, d[k], theta[k]
        )
