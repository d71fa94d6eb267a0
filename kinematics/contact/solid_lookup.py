"""The lookup kernel of a solid or measured tip's contact table, and the record that it reads.

One polynomial g(t, sin² θ), t = √(d/a), and its partials give all six outputs from one energy
U = E a³ t⁵ g (see `solid_data`), so that they agree with each other to rounding. What a sticking
face takes off the force on the base is a second one, q_0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, TypeAlias, cast

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from softfinger.kinematics.compiled.kernel import inlined_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import Record
from softfinger.kinematics.compiled.simd import (
    SHAPES,
    SIZES,
    STRIDE,
    Pointer,
    address,
    polynomials,
)
from softfinger.kinematics.contact.closed_form import HALF_PI, Fingertip
from softfinger.kinematics.contact.lookup import Six, Triple, lookup_at, normal_at, stiffness_ahead
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.material_fit import MaterialError
from softfinger.kinematics.contact.solid_data import FloatArray, solid_data, with_partials
from softfinger.kinematics.contact.tip_curves import TipCurves

_SHAPE = 4

Lanes: TypeAlias = tuple[float, float, float, float, float]


class SolidTable(Record):
    """A solid tip's table: g and its partials by t, t twice, sin² θ, and both, in SIMD lanes."""

    radius: float  # [m]
    modulus: float  # [Pa]
    inverse_radius: float
    deepest: float  # d up to which it holds [m]
    tilt: float  # |θ| likewise [rad]
    by_root: float  # 2/largest t
    by_square: float  # 2/largest sin² θ
    at_first: float  # g at t = 0: Hertz's
    tolerance: float
    max_error: float  # of the data, relative
    worst_d: float
    worst_theta: float
    sticks: bool
    coefficients: Annotated[FloatArray, SIZES[_SHAPE]]
    stick: Annotated[FloatArray, SIZES[_SHAPE]]  # q_0 and its partials by t, sin² θ


def solid_table(tip: Fingertip, material: Material) -> SolidTable:
    """Return the table of a solid ``tip``, or of a measured one, whose material says nothing.

    Raises MaterialError unless a solid tip's is linear.
    """
    if tip.law is not None:
        return _measured_table(tip.law)
    if not material.is_linear:
        raise MaterialError("a solid tip's material must have a constant modulus")
    data = solid_data(tip)
    table = _table(tip.radius, data.root, data.square, data.energy)
    table.modulus = material.reference_modulus
    table.at_first = 8.0 / (15.0 * (1.0 - tip.poisson**2))
    table.max_error = data.error
    table.sticks = tip.face == "sticking"
    table.stick = _numbers(data.stick)
    return table


def _measured_table(law: TipCurves) -> SolidTable:
    """Return the table of measured curves, for a modulus of 1 Pa."""
    energy = with_partials(law.energy(), law.root, law.square)
    table = _table(law.radius, law.root, law.square, energy)
    table.modulus = 1.0
    table.max_error = law.force_error
    return table


def _table(radius: float, root: float, square: float, energy: FloatArray) -> SolidTable:
    table = SolidTable()
    table.radius, table.inverse_radius = radius, 1.0 / radius
    table.deepest = root**2 * radius
    table.tilt = math.asin(math.sqrt(square))
    table.by_root, table.by_square = 2.0 / root, 2.0 / square
    table.coefficients = _numbers(energy)
    return table


def _numbers(powers: FloatArray) -> FloatArray:
    """Polynomials [lanes, i, j] as the numbers that `compiled.simd` evaluates."""
    terms, rows = SHAPES[_SHAPE][0], len(SHAPES[_SHAPE])
    out = np.zeros((rows, terms, STRIDE))
    lanes, i, j = powers.shape
    out[:j, terms - i :, :lanes] = powers[:, ::-1].T
    return out.reshape(-1)


def _record(context: Any, start: Any) -> Any:
    """Signature and code generator; see :data:`solid_at`."""
    record = numba.from_dtype(SolidTable.dtype)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], codegen.get_value_type(record))

    return record(start), generate


# solid_at(address): the record at the address of an array of one.
solid_at: Callable[[Pointer], SolidTable] = cast(Any, intrinsic)(_record)


@inlined_kernel
def energy_lanes(table: SolidTable, t: float, square: float) -> Lanes:
    """Return g(t, sin² θ), ∂g/∂t, ∂²g/∂t², ∂g/∂sin² θ, ∂²g/∂t ∂sin² θ."""
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    lanes: Lanes = polynomials(address(table.coefficients), 0, 4, x, y)
    return lanes


@inlined_kernel
def _held(table: SolidTable, t: float, square: float) -> Triple:
    """F over N cos θ, which is 1 − sin² θ q_0, and its partials by t and sin² θ."""
    if not table.sticks:
        return 1.0, 0.0, 0.0
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    q, q_t, q_s, _, _ = polynomials(address(table.stick), 0, 4, x, y)
    return 1.0 - square * q, -square * q_t, -q - square * q_s


@inner_kernel
def _solid_lookup_at(p: Pointer, d: float, theta: float) -> Six:
    """Evaluate `lookup.lookup_at`; with |θ| beyond the data the energy stays with θ at fixed d.

    The partials are those of that energy, and the force goes on with cos θ.
    """
    table = solid_at(p)
    if math.isnan(d) or math.isnan(theta):
        nan = math.nan
        return nan, nan, nan, nan, nan, nan, False
    if d <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
    within = abs(theta) <= table.tilt
    inside = within and d <= table.deepest
    angle = min(max(theta, -HALF_PI), HALF_PI)
    s = math.sin(angle)
    c = math.cos(angle)
    t = math.sqrt(min(d, table.deepest) * table.inverse_radius)
    square = s * s if within else 2.0 / table.by_square
    g, g_t, g_tt, g_s, g_ts = energy_lanes(table, t, square)
    # Before t³ and its like; the chain from sin² θ to θ is 2 sin θ cos θ.
    chain = 2.0 * s * c if within else 0.0
    a = table.radius
    size = table.modulus * a * a * t * t * t
    depth = a * t * t
    normal = size * (2.5 * g + 0.5 * t * g_t)
    stiffness = 0.25 * table.modulus * a * t * (15.0 * g + t * (9.0 * g_t + t * g_tt))
    normal_theta = chain * size * (2.5 * g_s + 0.5 * t * g_ts)
    held, held_t, held_s = _held(table, t, square)
    return (
        c * normal * held,
        size * depth * g,
        c * (stiffness * held + normal * held_t * 0.5 / (a * t)),
        (c * normal_theta - s * normal) * held + c * normal * chain * held_s,
        normal,
        chain * size * depth * g_s,
        inside,
    )


@inner_kernel
def _solid_stiffness_ahead(p: Pointer, scale: float, depth: float) -> float:
    """Evaluate `lookup.stiffness_ahead`: Hertz's ∂N/∂d at d = ``depth``."""
    table = solid_at(p)
    stiffness = 0.5 * scale / math.pi * 3.75 * table.at_first
    return stiffness * math.sqrt(depth * table.radius)


@inner_kernel
def _solid_normal_at(
    p: Pointer, d: float, theta: float, forces: Triple, tangent: float, inverse_cosine: float
) -> Triple:
    """Evaluate `lookup.normal_at`."""
    table = solid_at(p)
    if not table.sticks:
        force, force_d, force_theta = forces
        more = force_theta + force * tangent
        return force * inverse_cosine, force_d * inverse_cosine, more * inverse_cosine
    within = abs(theta) <= table.tilt
    s = math.sin(theta)
    t = math.sqrt(d * table.inverse_radius)
    g, g_t, g_tt, g_s, g_ts = energy_lanes(table, t, s * s if within else 2.0 / table.by_square)
    chain = 2.0 * s * math.cos(theta) if within else 0.0
    a = table.radius
    size = table.modulus * a * a * t * t * t
    return (
        size * (2.5 * g + 0.5 * t * g_t),
        0.25 * table.modulus * a * t * (15.0 * g + t * (9.0 * g_t + t * g_tt)),
        chain * size * (2.5 * g_s + 0.5 * t * g_ts),
    )


def _is_solid(start: Any) -> bool:
    return isinstance(start.dtype, types.Record)


cast(Any, lookup_at).also(_solid_lookup_at, _is_solid)
cast(Any, normal_at).also(_solid_normal_at, _is_solid)
cast(Any, stiffness_ahead).also(_solid_stiffness_ahead, _is_solid)
