"""Build contact tables for all tip models.

The tables of solid and measured tips reproduce their data. The tables of spring tips are fitted to
the reference integrals, with a certified error bound.

The error is bounded for each piece of the table, over the whole domain including its edges. The
bound is the sum of three terms: the Chebyshev coefficients that the piece omits, an estimate of the
higher coefficients, and rounding. The bound assumes that the reference integrals have only rounding
errors, and that the higher coefficients continue to decrease. Both assumptions hold for all
supported laws, because each law is a single polynomial. Pieces are halved until the bound is within
the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import ENERGY, H_END, STICK
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.material_fit import MaterialError
from softfinger.kinematics.contact.quadrature import ratios
from softfinger.kinematics.contact.solid_data import solid_data, to_powers, with_partials
from softfinger.kinematics.contact.table_record import (
    LANES,
    OCTAVES,
    POWERS_U,
    POWERS_V,
    SLAB_BITS,
    SPLITS_MAX,
    Table,
    TableError,
    set_piece,
)

# Rounding error of the closed forms and of the final products in the kernel.
_ROUNDING = 16.0 * np.finfo(float).eps
# Bound on the relative rounding error of a piece. For seven laws with degrees from 7 to 11, an
# error analysis found at most 3.5e-13 in any piece. The largest part is due to y², because the
# terms of cos² θ − ρ² cancel near the limit on θ.
_PIECE_ROUNDING = 1e-12
# Number of additional Chebyshev coefficients in h and y that are computed but not stored.
_EXTRA_V, _EXTRA_U = 4, 6
_SLAB_ENDS = np.arange(1, 1 + (1 << SLAB_BITS)) / (1 << SLAB_BITS)
# Slab edges in h, from H_END to 1.
_EDGES = [
    H_END,
    *(H_END * 2.0**k * (1.0 + piece) for k in range(OCTAVES) for piece in _SLAB_ENDS),
]


class _WorstError(NamedTuple):
    """Bound on the relative error of a piece, and the location of its maximum error."""

    bound: float
    h: float
    y: float


def build(tip: Fingertip, material: Material, tolerance: float) -> Table:
    """Build the smallest table that meets ``tolerance``; see ContactTable.build."""
    if not (0.0 < tolerance < 1.0):
        raise TableError(f"the tolerance must be between 0 and 1, got {tolerance!r}")
    splits = 1
    while True:
        last = material.is_linear or splits == SPLITS_MAX
        table = _build_pieces(tip, material, tolerance, splits, math.inf if last else tolerance)
        if table.max_error <= tolerance:
            return table
        if last:
            break
        splits *= 2
    raise TableError(
        f"no contact table for this material meets the tolerance {tolerance:.3g}; the smallest "
        f"error reached is {table.max_error:.4g}"
    )


def _build_pieces(
    tip: Fingertip, material: Material, tolerance: float, splits: int, limit: float
) -> Table:
    """Build a table with ``splits`` pieces per slab; stop if its error exceeds ``limit``."""
    table = Table()
    table.is_closed, table.splits, table.tolerance = material.is_linear, splits, tolerance
    table.radius, table.modulus = tip.radius, material.reference_modulus
    table.inverse_radius = 1.0 / tip.radius
    table.deepest = (1.0 - H_END) * tip.radius
    worst = _WorstError(_ROUNDING, 0.5, 0.0)
    for found in () if table.is_closed else _fill(table, material):
        worst = max(worst, found)
        if worst.bound > limit:
            break
    table.max_error = worst.bound
    table.worst_d, table.worst_theta = tip.radius * (1.0 - worst.h), _tilt(worst)
    return table


def _fill(table: Table, material: Material) -> Iterator[_WorstError]:
    """Set the coefficients piece by piece; yield the error bound of each piece."""
    # The additional coefficients in each direction determine the truncation error.
    rows, width = POWERS_V + _EXTRA_V, POWERS_U + _EXTRA_U
    mask = np.zeros((rows, width), dtype=np.bool_)
    mask[:POWERS_V, :POWERS_U] = True
    x, u = _nodes(rows)[0], 0.5 * (_nodes(width)[0] + 1.0)
    splits = table.splits
    for slab, (low, high) in enumerate(pairwise(_EDGES)):
        h = 0.5 * (low + high) + 0.5 * (high - low) * x
        for split in range(splits):
            y = (split + u) / splits
            terms = _terms(_ratios_at(material, h[:, None], y[None, :]))
            powers = np.einsum(
                "ai,bj,kij->kba",
                to_powers(POWERS_V),
                to_powers(POWERS_U),
                terms[:, :POWERS_V, :POWERS_U],
                optimize=True,
            )
            set_piece(table, slab * splits + split, powers)
            yield _bound(terms, terms * ~mask, h, y)


def _bound(terms: FloatArray, lost: FloatArray, h: FloatArray, y: FloatArray) -> _WorstError:
    """Return the bound on a piece's relative error and the approximate location of the maximum.

    ``terms`` [5, i, j] are the Chebyshev coefficients of the ratios. ``lost`` contains the
    coefficients of the difference between ratios and table. The difference is at most the sum of
    the magnitudes of these coefficients. Higher coefficients are not computed. Each coefficient is
    less than half the previous coefficient, because the ratios are analytic well beyond the piece.
    In each direction, the higher coefficients therefore contribute less than twice the last two
    coefficients.
    """
    everywhere = _dense_nodes(len(h)) @ terms @ _dense_nodes(len(y)).T
    size = np.abs(everywhere)
    size[3] = np.maximum(size[3], size[0])
    smallest = 0.99 * size.min(axis=(1, 2))
    each = np.abs(lost)
    beyond = each[:, -2:].sum(axis=(1, 2)) + each[:, :, -2:].sum(axis=(1, 2))
    bounds = (each.sum(axis=(1, 2)) + 2.0 * beyond) / smallest + _PIECE_ROUNDING
    k = int(np.argmax(bounds))
    here = np.abs(_dense_nodes(len(h)) @ lost[k] @ _dense_nodes(len(y)).T)
    i, j = np.unravel_index(int(np.argmax(here)), here.shape)
    # The dense points (four per node) are in ascending order, whereas the nodes are in descending
    # order.
    return _WorstError(float(bounds[k]), float(h[-1 - i // 4]), float(y[-1 - j // 4]))


def _terms(values: FloatArray) -> FloatArray:
    """Convert ``values`` [5, i, j] at the nodes to Chebyshev coefficients [5, i, j]."""
    in_x, in_y = _nodes(values.shape[1])[1], _nodes(values.shape[2])[1]
    return np.asarray(np.einsum("ai,bj,kij->kab", in_x, in_y, values, optimize=True))


@cache
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Return Chebyshev nodes on [−1, 1], and the matrix that maps node values to coefficients."""
    nodes: FloatArray = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    return nodes, np.asarray(inverse, dtype=np.float64)


@cache
def _dense_nodes(count: int) -> FloatArray:
    """Evaluate the first ``count`` Chebyshev polynomials at four times as many points."""
    return np.asarray(chebyshev.chebvander(np.cos(np.linspace(np.pi, 0.0, 4 * count)), count - 1))


def _tilt(at: _WorstError) -> float:
    """Return the tilt θ [rad] at the coordinates h and y of ``at``."""
    complement = 1.0 - (at.h * at.y) ** 2
    return math.asin(min(at.h * math.sqrt((1.0 - at.y) * (1.0 + at.y) / complement), 1.0))


def _ratios_at(material: Material, h: FloatArray, y: FloatArray) -> FloatArray:
    """Return the ratios [5, …] at broadcast coordinates h in (0, 1) and y in [0, 1]."""
    h, y = np.broadcast_arrays(h, y)
    delta = 1.0 - h
    # Compute 1 − u², where u = h y, in a form without cancellation for h and y near 1.
    complement = (1.0 - y + delta * y) * (1.0 + h * y)
    c = np.sqrt(delta * (1.0 + h) / complement)
    s = h * np.sqrt((1.0 - y) * (1.0 + y) / complement)
    found = ratios(material, delta.ravel(), h.ravel(), s.ravel(), c.ravel())
    return found.reshape(LANES, *h.shape)


def solid_table(tip: Fingertip, material: Material) -> Table:
    """Return the table of a solid or measured ``tip``; the material is ignored for a measured tip.

    Raises MaterialError if the tip is solid and the material is not linear.
    """
    table = Table()
    table.is_solid = True
    law = tip.law
    if law is not None:
        root, square = law.root, law.square
        energy = with_partials(law.energy(), root, square)
        table.radius, table.max_error = law.radius, law.force_error
        table.modulus = 1.0  # The coefficients of the measured energy are in Pa.
    elif material.is_linear:
        data = solid_data(tip)
        root, square, energy = data.root, data.square, data.energy
        table.radius, table.max_error = tip.radius, data.error
        table.modulus = material.reference_modulus
        table.at_first = 8.0 / (15.0 * (1.0 - tip.poisson**2))
        table.sticks = tip.face == "sticking"
        set_piece(table, STICK, data.stick)
    else:
        raise MaterialError("a solid tip's material must have a constant modulus")
    table.inverse_radius = 1.0 / table.radius
    table.deepest = root**2 * table.radius
    table.tilt = math.asin(math.sqrt(square))
    table.by_root, table.by_square = 2.0 / root, 2.0 / square
    set_piece(table, ENERGY, energy)
    return table
