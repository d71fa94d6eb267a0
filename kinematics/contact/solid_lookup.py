"""Contact tables for solid and measured tips, and the lookup kernels for these tables.

All six outputs follow from the energy U = E a³ t⁵ g (see `solid_data`), where g(t, sin² θ) is a
polynomial and t = √(d/a). The outputs are therefore consistent with each other to within rounding.
For a sticking face, a second polynomial q_0 describes the reduction of the base force.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inlined_kernel, inner_kernel
from softfinger.kinematics.contact.closed_form import HALF_PI, Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.material_fit import MaterialError
from softfinger.kinematics.contact.solid_data import FloatArray, solid_data, with_partials
from softfinger.kinematics.contact.table_record import (
    Lanes,
    SixFloats,
    Table,
    ThreeFloats,
    lanes,
    set_piece,
)
from softfinger.kinematics.contact.tip_curves import TipCurves

ENERGY, STICK = range(2)  # pieces of the table: g with its partials, and q_0 with its partials


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
    """Return the table of measured curves, for a modulus of 1 Pa."""
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
def energy_lanes(table: Table, t: float, square: float) -> Lanes:
    """Return g(t, sin² θ), ∂g/∂t, ∂²g/∂t², ∂g/∂sin² θ, ∂²g/∂t ∂sin² θ."""
    return lanes(table, ENERGY, t * table.by_root - 1.0, square * table.by_square - 1.0)


@inlined_kernel
def _clamped(table: Table, t: float, square: float) -> ThreeFloats:
    """Return F/(N cos θ) = 1 − sin² θ q_0 and its partials in t and sin² θ."""
    if not table.sticks:
        return 1.0, 0.0, 0.0
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    q, q_t, q_s, _, _ = lanes(table, STICK, x, y)
    return 1.0 - square * q, -square * q_t, -q - square * q_s


@inner_kernel
def solid_lookup(table: Table, d: float, theta: float) -> SixFloats:
    """Evaluate `lookup.lookup`.

    If |θ| is beyond the data, the energy is assumed not to depend on θ, and the partials are those
    of this energy. The force continues to vary with cos θ.
    """
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
    # The chain rule gives d(sin² θ)/dθ = 2 sin θ cos θ.
    chain = 2.0 * s * c if within else 0.0
    a = table.radius
    size = table.modulus * a * a * t * t * t
    depth = a * t * t
    normal = size * (2.5 * g + 0.5 * t * g_t)
    stiffness = 0.25 * table.modulus * a * t * (15.0 * g + t * (9.0 * g_t + t * g_tt))
    normal_theta = chain * size * (2.5 * g_s + 0.5 * t * g_ts)
    held, held_t, held_s = _clamped(table, t, square)
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
def solid_stiffness_ahead(table: Table, scale: float, depth: float) -> float:
    """Evaluate `lookup.stiffness_ahead` using Hertz's ∂N/∂d at d = ``depth``."""
    stiffness = 0.5 * scale / math.pi * 3.75 * table.at_first
    return stiffness * math.sqrt(depth * table.radius)


@inner_kernel
def solid_normal(table: Table, d: float, theta: float) -> ThreeFloats:
    """Evaluate `lookup.normal_at` for a sticking face."""
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
