"""The lookup kernel of contact tables, and the layout of the array that it reads.

What is tabulated is the ratio of each quantity to its closed form for the modulus at zero strain:
smooth, near 1, finite at d → 0, and exact for a constant modulus, which has no coefficients. The
coordinates make it analytic up to the edges of the domain: the height h = (a − d)/a, and y = u/h
with u = √(1 − ρ²/(a² cos² θ)), which is 1 at θ = 0, 0 at the limit, even in θ, and the peak strain
is 1 − u. The domain is cut into slabs of h, eight to an octave, which span all of y: where their
coefficients stand depends on d alone, so that they are read while θ's cosine is being computed. It
ends at h = 1/8, short of h = 0, towards which the ratios grow as log h.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias, cast

import numba
import numpy as np
from numba.extending import intrinsic
from numpy.typing import NDArray

from softfinger import SoftfingerError
from softfinger.kinematics.compiled.kernel import inlined_kernel, inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record
from softfinger.kinematics.compiled.simd import SIZES, Pointer, address, polynomials
from softfinger.kinematics.contact.closed_form import theta_limit

FloatArray = NDArray[np.float64]
Ratios: TypeAlias = tuple[float, float, float, float, float]
Triple: TypeAlias = tuple[float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float, bool]

HALF_PI = math.pi / 2
_NEAR = 0.25 * math.pi

START = 16  # of the coefficients in a table's array: a whole number of cache lines

OCTAVES = 3  # of h
SLAB_BITS = 3  # 2^3 slabs to an octave
LOWEST = 0.5**OCTAVES  # h where the domain ends
_H_MIN = LOWEST * (1.0 + 2.0**-52)  # the first number above it
_END = LOWEST * (1.0 - 1e-12)  # h that is outside, not by rounding alone

# The forms of a table, as numbers in SHAPES: the closed form, and slabs by rising degree.
CLOSED = 0
SLABS = (1, 2, 3)

_MANTISSA = 52
_FRACTION = (1 << _MANTISSA) - 1
_ONE = 1023 << _MANTISSA  # the bits of 1.0
_FIRST = ((1023 - OCTAVES) << _MANTISSA) + 1  # those of the first number above LOWEST


class TableHeader(Record):
    """Head of a table's array."""

    form: float  # CLOSED, or one of SLABS
    radius: float  # [m]
    modulus: float  # at no strain [Pa]
    inverse_radius: float
    tolerance: float
    max_error: float  # bound of the relative error
    worst_d: float  # where the piece errs most that has the largest [m]
    worst_theta: float  # [rad]


def header_of(data: FloatArray) -> TableHeader:
    """Return the header of a table's array."""
    size = TableHeader.dtype.itemsize // data.itemsize
    return TableHeader(data[:size].view(TableHeader.dtype))


def _header(context: Any, start: Any) -> Any:
    """Signature and code generator; see :data:`header`."""
    record = numba.from_dtype(TableHeader.dtype)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], codegen.get_value_type(record))

    return record(start), generate


# header(address): :func:`header_of` in kernels.
header: Callable[[Pointer], TableHeader] = cast(Any, intrinsic)(_header)


class TableError(SoftfingerError):
    """A table can't be built to the tolerance, or a file holds no valid table of this kind."""


def aligned(size: int) -> FloatArray:
    """Return zeros, float64 [size], from a cache line on: vector loads don't straddle two."""
    room = np.zeros(size + 8)
    skip = (-room.ctypes.data % 64) // 8
    return room[skip : skip + size]


@inlined_kernel
def _near_sine_cosine(theta: float) -> tuple[float, float]:
    """sin θ and cos θ to an ulp for |θ| ≤ π/4; inlined, unlike the C library's."""
    z = theta * theta
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
    half = 0.5 * z
    leading = 1.0 - half
    return theta + theta * z * p, leading + (((1.0 - leading) - half) + z2 * q)


@inlined_kernel
def _sine_cosine(theta: float) -> tuple[float, float]:
    """sin θ and cos θ to an ulp, both relative, for |θ| ≤ π/2."""
    size = abs(theta)
    far = size > _NEAR
    # π/2 − |θ| keeps its digits near π/2, and so does the cosine.
    sine, cosine = _near_sine_cosine((HALF_PI - size) + 6.123233995736766e-17 if far else size)
    if far:
        sine, cosine = cosine, sine
    return math.copysign(sine, theta), cosine


@inlined_kernel
def _slab(h: float) -> tuple[int, float]:
    """Number of the slab of h in (LOWEST, 1], and h's position in it from −1 to 1.

    From the float's own bits: its exponent is the octave, its mantissa the slab and the position. A
    slab has its upper end, not its lower one.
    """
    number = int(np.float64(h).view(np.int64)) - _FIRST
    fraction = ((number << SLAB_BITS) & _FRACTION) | _ONE
    position = 2.0 * float(np.int64(fraction).view(np.float64)) - 3.0
    return number >> (_MANTISSA - SLAB_BITS), position


@inlined_kernel
def _from_slab(p: Pointer, form: int, h: float, y: float) -> Ratios:
    """Return the five ratios. The numbers of shapes are literals."""
    i, x = _slab(h)
    y = 2.0 * y - 1.0
    if form == 1:
        ratios: Ratios = polynomials(p, START + i * SIZES[1], 1, x, y)
    elif form == 2:
        ratios = polynomials(p, START + i * SIZES[2], 2, x, y)
    else:
        ratios = polynomials(p, START + i * SIZES[3], 3, x, y)
    return ratios


@inlined_kernel
def _at(p: Pointer, d: float, h: float, s: float, c: float, gap: float, inside: bool) -> Six:
    """Evaluate :func:`lookup` inside the domain."""
    form = int(header(p).form)
    inverse = 1.0 / c
    r_f, r_u, r_fd, r_ft, r_ut = 1.0, 1.0, 1.0, 1.0, 1.0
    if form != CLOSED:
        both = 1.0 / (c * h)
        inverse = both * h
        r_f, r_u, r_fd, r_ft, r_ut = _from_slab(p, form, h, math.sqrt(gap) * both)
    slope = s * inverse
    force_by_d = math.pi * header(p).modulus * d * inverse
    force = force_by_d * d
    energy = force * inverse * d * (1.0 / 3.0)
    return (
        force * r_f,
        energy * r_u,
        2.0 * force_by_d * r_fd,
        force * slope * r_ft,
        force * r_f * inverse,
        2.0 * energy * slope * r_ut,
        inside,
    )


@inner_kernel
def _slowly(p: Pointer, d: float, theta: float) -> tuple[float, float, float, float, float, bool]:
    """d, h, sin θ, cos θ, gap and ``inside`` at any d > 0 and θ, clamped to the domain."""
    radius = header(p).radius
    h = (radius - d) * header(p).inverse_radius
    inside = h >= _END
    if h < _H_MIN:
        h = _H_MIN
        d = radius * (1.0 - h)
    if abs(theta) <= HALF_PI:
        s, c = _sine_cosine(theta)
        gap = c * c - d * header(p).inverse_radius * (1.0 + h)
        if gap >= 0.0:
            return d, h, s, c, gap, inside
    limit = theta_limit(radius, d)
    # At the limit itself, rounding may have led here.
    inside = inside and abs(theta) <= limit * (1.0 + 1e-12)
    s, c = _sine_cosine(min(max(theta, -limit), limit))
    return d, h, s, c, 0.0, inside


@inlined_kernel
def lookup_at(p: Pointer, d: float, theta: float) -> Six:
    """Evaluate :func:`lookup` in the table whose :func:`~compiled.simd.address` is ``p``.

    For kernels that call often: an array argument costs a reference count at each call.
    """
    h = (header(p).radius - d) * header(p).inverse_radius
    rho2 = d * header(p).inverse_radius * (1.0 + h)
    s, c = _near_sine_cosine(theta)
    gap = c * c - rho2
    inside = True
    if not (d > 0.0 and gap >= 0.0 and h > LOWEST and abs(theta) <= _NEAR):
        if math.isnan(d) or math.isnan(theta):
            nan = math.nan
            return nan, nan, nan, nan, nan, nan, False
        if d <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
        d, h, s, c, gap, inside = _slowly(p, d, theta)
    return _at(p, d, h, s, c, gap, inside)


@inlined_kernel
def normal_at(
    p: Pointer, d: float, theta: float, forces: Triple, tangent: float, inverse_cosine: float
) -> Triple:
    """Return N = ∂U/∂d in the domain, ∂N/∂d and ∂N/∂θ, for ``forces``: F, ∂F/∂d and ∂F/∂θ there."""
    force, force_d, force_theta = forces
    more = force_theta + force * tangent
    return force * inverse_cosine, force_d * inverse_cosine, more * inverse_cosine


@kernel
def lookup(data: FloatArray, d: float, theta: float) -> Six:
    """Return (F, U, ∂F/∂d, ∂F/∂θ, ∂U/∂d, ∂U/∂θ, inside) at displacement d [m] and tilt θ [rad].

    Zeros for d ≤ 0. Outside the domain d and θ are clamped to it and ``inside`` is False; NaN in
    gives NaN out.
    """
    return lookup_at(address(data), d, theta)


@inlined_kernel
def stiffness_ahead(p: Pointer, scale: float, depth: float) -> float:
    """Return ∂F/∂d [N/m] of an upright tip at d = ``depth`` [m]; ``scale`` is 2πE [Pa].

    E is the modulus at no strain.
    """
    return scale * depth


@kernel
def lookups(
    data: FloatArray,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
    inside: NDArray[np.bool_],
) -> None:
    """Evaluate :func:`lookup` at each d, θ [n] into ``out`` [6, n] and ``inside`` [n]."""
    p = address(data)
    for k in range(d.shape[0]):
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k], out[5, k], inside[k] = lookup_at(
            p, d[k], theta[k]
        )
