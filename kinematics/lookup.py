"""The lookup kernel of contact tables, and the layout of the array that it reads.

What is tabulated is the ratio of each quantity to its closed form for the modulus at zero strain:
smooth, near 1, finite at d → 0, and exact for a constant modulus. The coordinates make it analytic
up to the edges of the domain: the height h = (a − d)/a, in pieces that divide each octave evenly,
and y = u/h with u = √(1 − ρ²/(a² cos² θ)), which is 1 at θ = 0, 0 at the limit, even in θ, and the
peak strain is 1 − u. Towards h = 0 the ratios are A + B log h with smooth A and B; below the lowest
octave both are tabulated.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from kinematics.contact import theta_limit
from kinematics.kernels import kernel
from kinematics.lanes import slab, square

FloatArray = NDArray[np.float64]
Ratios: TypeAlias = tuple[float, float, float, float, float]

HALF_PI = math.pi / 2

# Header of a table's array, by index.
FORMAT, FORM, RADIUS, MODULUS, INVERSE_RADIUS = 0, 1, 2, 3, 4
LOWEST, SHIFT, FIRST, H_PIECES, Y_PIECES = 5, 6, 7, 8, 9
SIZE, CORNER, TOLERANCE, MAX_ERROR, WORST_D, WORST_THETA = 10, 11, 12, 13, 14, 15
CENTRES = 16  # of the pieces of h, each with the inverse of its half width

VERSION = 1.0

# The corner h → 0: pieces over y, and terms in h and y of A and B in each; the same for all forms.
CORNER_PIECES = 6
CORNER_TERMS = (8, 10)
CORNER_SIZE = 10 * CORNER_TERMS[0] * CORNER_TERMS[1]


class Form(NamedTuple):
    """One representation: degrees of its local polynomials and the grid of their pieces."""

    name: str
    nx: int  # degree in h
    ny: int  # degree in y; with ny = nx all powers, else the triangle between the two
    bits: int  # 2^bits pieces an octave of h
    y_pieces: int


# Forms by number, as the header has it, cheapest first. The slabs span all of y, so that where
# their coefficients stand depends on d alone: they are read while θ's cosine is being computed.
FORMS = (
    Form("closed", 0, 0, 0, 0),
    Form("bilinear", 1, 1, 3, 16),
    Form("bicubic", 3, 3, 2, 8),
    Form("quintic", 5, 5, 2, 4),
    Form("slab 6-11", 6, 11, 2, 1),
    Form("slab 7-18", 7, 18, 2, 1),
    Form("slab 10-21", 10, 21, 2, 1),
    Form("slab 12-28", 12, 28, 2, 1),
)
CLOSED = 0
_SLABS = 4  # the first form that spans all of y


@kernel
def _sine_cosine(theta: float) -> tuple[float, float]:
    """sin θ and cos θ to an ulp, both relative, for |θ| ≤ π/2; inlined, unlike the C library's."""
    size = abs(theta)
    far = size > 0.7853981633974483
    # π/2 − |θ| keeps its digits near π/2, and so does the cosine.
    r = (HALF_PI - size) + 6.123233995736766e-17 if far else size
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    p = (-0.16666666666666666 + z * 0.00833333333333095) + z2 * (
        -0.00019841269836759774 + z * 2.755731610309567e-06
    )
    p += z4 * (-2.505113194542731e-08 + z * 1.5918135792566938e-10)
    q = (0.041666666666666664 - z * 0.0013888888888887398) + z2 * (
        2.4801587298766353e-05 - z * 2.755731727203115e-07
    )
    q += z4 * (2.087614632409855e-09 - z * 1.1382636028190913e-11)
    sine = r + r * z * p
    half = 0.5 * z
    most = 1.0 - half
    cosine = most + (((1.0 - most) - half) + z2 * q)
    if far:
        sine, cosine = cosine, sine
    return math.copysign(sine, theta), cosine


_START_SLABS = CENTRES + 24  # three octaves of four pieces


@kernel
def _evaluate_slab(data: FloatArray, form: int, i: int, x: float, y: float) -> Ratios:
    """The five ratios of a piece of h. The degrees are literals, as FORMS says."""
    at = _START_SLABS + i * int(data[SIZE])
    if form == 5:
        ratios: Ratios = slab(data, at, 7, 18, x, y)
    elif form == 6:
        ratios = slab(data, at, 10, 21, x, y)
    elif form == 4:
        ratios = slab(data, at, 6, 11, x, y)
    else:
        ratios = slab(data, at, 12, 28, x, y)
    return ratios


@kernel
def _evaluate_local(data: FloatArray, form: int, i: int, x: float, y: float) -> Ratios:
    """The five ratios of the piece of h and y."""
    count = int(data[Y_PIECES])
    y *= count
    j = min(int(y), count - 1)
    y = 2.0 * (y - j) - 1.0
    at = CENTRES + 2 * int(data[H_PIECES]) + (i * count + j) * int(data[SIZE])
    if form == 1:
        ratios: Ratios = square(data, at, 1, x, y)
    elif form == 2:
        ratios = square(data, at, 3, x, y)
    else:
        ratios = square(data, at, 5, x, y)
    return ratios


@kernel
def _evaluate_corner(data: FloatArray, h: float, y: float) -> Ratios:
    """The five ratios A + B log h below the lowest octave; slower, since no hand works there."""
    j = min(int(y * CORNER_PIECES), CORNER_PIECES - 1)
    y = 2.0 * (y * CORNER_PIECES - j) - 1.0
    x = 2.0 * h / data[LOWEST] - 1.0
    # At h = 0 the logarithm's factors vanish, or θ and with it the partial does.
    scale = math.log(max(h, 1e-300))
    rows, columns = CORNER_TERMS
    at = int(data[CORNER]) + j * CORNER_SIZE
    r0 = 0.0
    r1 = 0.0
    r2 = 0.0
    r3 = 0.0
    r4 = 0.0
    for _ in range(rows):
        q0 = 0.0
        q1 = 0.0
        q2 = 0.0
        q3 = 0.0
        q4 = 0.0
        for _ in range(columns):
            q0 = q0 * y + (data[at] + scale * data[at + 5])
            q1 = q1 * y + (data[at + 1] + scale * data[at + 6])
            q2 = q2 * y + (data[at + 2] + scale * data[at + 7])
            q3 = q3 * y + (data[at + 3] + scale * data[at + 8])
            q4 = q4 * y + (data[at + 4] + scale * data[at + 9])
            at += 10
        r0 = r0 * x + q0
        r1 = r1 * x + q1
        r2 = r2 * x + q2
        r3 = r3 * x + q3
        r4 = r4 * x + q4
    return r0, r1, r2, r3, r4


@kernel
def lookup(
    data: FloatArray, d: float, theta: float
) -> tuple[float, float, float, float, float, float, bool]:
    """(F, U, ∂F/∂d, ∂F/∂θ, ∂U/∂d, ∂U/∂θ, inside) at displacement d [m] and tilt θ [rad].

    Zeros for d ≤ 0. Outside the domain d and θ are clamped to it and ``inside`` is False; NaN in
    gives NaN out.
    """
    radius = data[RADIUS]
    inside = True
    h = (radius - d) * data[INVERSE_RADIUS]
    rho2 = d * data[INVERSE_RADIUS] * (1.0 + h)
    s, c = _sine_cosine(theta)
    gap = c * c - rho2  # cos² θ u², and h² − sin² θ
    if not (d > 0.0 and gap >= 0.0 and h >= 0.0 and abs(theta) <= HALF_PI):
        if math.isnan(d) or math.isnan(theta):
            nan = math.nan
            return nan, nan, nan, nan, nan, nan, False
        if d <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
        d, theta, inside = _clamp(radius, d, theta)
        h = (radius - d) * data[INVERSE_RADIUS]
        s, c = _sine_cosine(theta)
        gap = 0.0
    form = int(data[FORM])
    inverse = 1.0 / c
    slope = s * inverse
    push = math.pi * data[MODULUS] * d * inverse
    force = push * d
    energy = force * inverse * d * (1.0 / 3.0)
    if form == CLOSED:
        return (
            force,
            energy,
            2.0 * push,
            force * slope,
            force * inverse,
            2.0 * energy * slope,
            inside,
        )
    if h >= data[LOWEST]:
        # The float's own bits count the pieces: its exponent the octave, its mantissa within.
        bits = int(np.float64(h).view(np.int64)) >> int(data[SHIFT])
        i = min(bits - int(data[FIRST]), int(data[H_PIECES]) - 1)
        x = (h - data[CENTRES + 2 * i]) * data[CENTRES + 2 * i + 1]
        y = math.sqrt(gap) * (inverse * (1.0 / h))
        if form >= _SLABS:
            ratios = _evaluate_slab(data, form, i, x, 2.0 * y - 1.0)
        else:
            ratios = _evaluate_local(data, form, i, x, y)
    else:
        s = abs(s)
        y = math.sqrt((h - s) * (h + s)) * inverse / h if h > s else 0.0
        ratios = _evaluate_corner(data, h, y)
    r_f, r_u, r_fd, r_ft, r_ut = ratios
    force_theta = force * slope * r_ft
    force *= r_f
    return (
        force,
        energy * r_u,
        2.0 * push * r_fd,
        force_theta,
        force * inverse,
        2.0 * energy * slope * r_ut,
        inside,
    )


@kernel
def _clamp(radius: float, d: float, theta: float) -> tuple[float, float, bool]:
    """The nearest d and θ of the domain, and whether they were in it (rounding aside)."""
    inside = d <= radius
    d = min(d, radius)
    limit = theta_limit(radius, d)
    inside = inside and abs(theta) <= limit
    return d, min(max(theta, -limit), limit), inside


@kernel
def lookups(
    data: FloatArray,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
    inside: NDArray[np.bool_],
) -> None:
    """:func:`lookup` at each of d and θ [n] into ``out`` [6, n] and ``inside`` [n]."""
    for i in range(d.shape[0]):
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i], inside[i]) = lookup(
            data, d[i], theta[i]
        )
