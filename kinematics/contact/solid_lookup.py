"""Contact tables for solid and measured tips, and the lookup kernels for these tables.

All six outputs are derived from the energy U = E a³ t⁵ g (see `solid_data`). The function g(t, sin²
θ) is a polynomial in t = √(d/a) and sin² θ. All outputs are therefore consistent to within
rounding. For a sticking face, a second polynomial q_0 describes the reduction of the base force.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inlined_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import HALF_PI, Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.material_fit import MaterialError
from softfinger.kinematics.contact.solid_data import solid_data, with_partials
from softfinger.kinematics.contact.table_record import (
    Lanes,
    SixFloats,
    Table,
    ThreeFloats,
    lanes,
    set_piece,
)
from softfinger.kinematics.contact.tip_curves import TipCurves

ENERGY, STICK = range(2)  # pieces of the table: g and its partials, q_0 and its partials


def solid_table(tip: Fingertip, material: Material) -> Table:
    """Return the table of a solid or measured ``tip``; the material is ignored for a measured tip.

    Raises MaterialError if the tip is solid and the material is not linear.
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
    set_piece(table, STICK, data.stick)
    return table


def _measured_table(law: TipCurves) -> Table:
    """Return the table that represents measured curves, for a modulus of 1 Pa."""
    energy = with_partials(law.energy(), law.root, law.square)
    table = _table(law.radius, law.root, law.square, energy)
    table.modulus = 1.0
    table.max_error = law.force_error
    return table


def _table(radius: float, root: float, square: float, energy: FloatArray) -> Table:
    table = Table()
    table.is_solid = True
    table.radius, table.inverse_radius = radius, 1.0 / radius
    table.deepest = root**2 * radius
    table.tilt = math.asin(math.sqrt(square))
    table.by_root, table.by_square = 2.0 / root, 2.0 / square
    set_piece(table, ENERGY, energy)
    return table


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
def solid_lookup(table: Table, d: float, theta: float) -> SixFloats:
    """Evaluate `lookup.lookup`.

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
    return (
        c * area * normal * held,
        a * area * energy,
        c * area * (stiffness * held + normal * held_t * 0.5 / (a * t)),
        area * ((c * chain * normal_s - s * normal) * held + c * normal * chain * held_s),
        area * normal,
        chain * a * area * energy_s,
        inside,
    )


@inner_kernel
def solid_normal(table: Table, d: float, theta: float) -> ThreeFloats:
    """Evaluate `lookup.normal_at` for a sticking face."""
    within = abs(theta) <= table.tilt
    s = math.sin(theta)
    t = math.sqrt(d * table.inverse_radius)
    square = s * s if within else 2.0 / table.by_square
    normal, stiffness, normal_s, _, _ = normal_force(table, t, square)
    chain = 2.0 * s * math.cos(theta) if within else 0.0
    area = table.radius * table.radius
    return area * normal, area * stiffness, area * chain * normal_s
