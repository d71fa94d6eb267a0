"""Fit of contact tables to the reference integrals, with certified error.

A table's error is bounded piece by piece, over the whole domain with its edges: by the sum of the
Chebyshev coefficients that the piece leaves out, what lies beyond them, and rounding. What it rests
on: that the integrals' own error is rounding, and that coefficients beyond those computed go on
falling. Both hold for every law here, since it is one polynomial. Pieces are halved until the bound
is within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import LOWEST
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import (
    circle_rule,
    gauss_rule,
    nodes_for,
    ratios_at,
)
from softfinger.kinematics.contact.solid_data import to_powers
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

FloatArray = NDArray[np.float64]

ROUNDING = 16.0 * np.finfo(float).eps  # of the closed forms and the kernel's last products
_MORE_V, _MORE_U = 4, 6  # Chebyshev coefficients in h and y beyond those kept
_SLAB_ENDS = np.arange(1, 1 + (1 << SLAB_BITS)) / (1 << SLAB_BITS)
# Of the slabs over h, from LOWEST to 1.
_EDGES = [
    LOWEST,
    *(LOWEST * 2.0**k * (1.0 + piece) for k in range(OCTAVES) for piece in _SLAB_ENDS),
]


class _Worst(NamedTuple):
    """Bound of the relative error of a piece, and where it errs most."""

    bound: float
    h: float
    y: float


@dataclass(frozen=True)
class LawTerms:
    """A material as the quadrature's kernels take it."""

    material: Material
    gauss: FloatArray
    circle: FloatArray
    polynomials: FloatArray
    modulus: float

    @classmethod
    def of(cls, material: Material) -> LawTerms:
        """Return rules and expansions for ``material``."""
        return cls(
            material,
            gauss_rule(nodes_for(material.degree)),
            circle_rule(material.degree),
            material.expansions(),
            material.reference_modulus,
        )


def build(tip: Fingertip, material: Material, tolerance: float) -> Table:
    """Build the table of fewest pieces within ``tolerance``; see ContactTable.build."""
    if not (0.0 < tolerance < 1.0):
        raise TableError(f"the tolerance must lie between 0 and 1, not {tolerance!r}")
    law, splits = LawTerms.of(material), 1
    while True:
        last = material.is_linear or splits == SPLITS_MAX
        table = _made(tip, law, tolerance, splits, math.inf if last else tolerance)
        if table.max_error <= tolerance:
            return table
        if last:
            break
        splits *= 2
    raise TableError(
        f"no contact table of this material reaches {tolerance:.3g}; the best reached "
        f"{table.max_error:.4g}"
    )


def _made(tip: Fingertip, law: LawTerms, tolerance: float, splits: int, limit: float) -> Table:
    """The table of so many pieces, left unfinished where its error's bound passes ``limit``."""
    table = Table()
    table.is_closed, table.splits, table.tolerance = law.material.is_linear, splits, tolerance
    table.radius, table.modulus = tip.radius, law.modulus
    table.inverse_radius = 1.0 / tip.radius
    table.deepest = (1.0 - LOWEST) * tip.radius
    worst = _Worst(ROUNDING, 0.5, 0.0)
    for found in () if table.is_closed else _filled(table, law):
        worst = max(worst, found)
        if worst.bound > limit:
            break
    table.max_error = worst.bound
    table.worst_d, table.worst_theta = tip.radius * (1.0 - worst.h), _tilt(worst)
    return table


def _filled(table: Table, law: LawTerms) -> Iterator[_Worst]:
    """Fill in the coefficients piece by piece; yields the bound of each one's error."""
    # More than needed in each direction, for what is left out.
    rows, width = POWERS_V + _MORE_V, POWERS_U + _MORE_U
    mask = np.zeros((rows, width), dtype=np.bool_)
    mask[:POWERS_V, :POWERS_U] = True
    x, u = _nodes(rows)[0], 0.5 * (_nodes(width)[0] + 1.0)
    splits = table.splits
    for slab, (low, high) in enumerate(pairwise(_EDGES)):
        h = 0.5 * (low + high) + 0.5 * (high - low) * x
        for split in range(splits):
            y = (split + u) / splits
            values = _ratios_at(law, h[:, None], y[None, :])
            terms = _terms(values)
            powers = np.einsum(
                "ai,bj,kij->kba",
                to_powers(POWERS_V),
                to_powers(POWERS_U),
                terms[:, :POWERS_V, :POWERS_U],
                optimize=True,
            )
            set_piece(table, slab * splits + split, powers)
            rounding = _rounding(terms * mask, (high + low) / (high - low), low, splits)
            yield _bound(values, terms * ~mask, rounding, h, y)


def _bound(
    values: FloatArray, lost: FloatArray, rounding: FloatArray, h: FloatArray, y: FloatArray
) -> _Worst:
    """Bound of a piece's relative error, and where in ``h`` and ``y`` about most is lost.

    ``values`` [5, h, y] are the ratios at the piece's nodes, ``lost`` the Chebyshev coefficients of
    what the table leaves of them. Their sum bounds that; what lies beyond the coefficients is less
    than twice the last two in each direction, as they fall to less than half each, the ratios being
    analytic well beyond the piece. ``rounding`` [5] is absolute.
    """
    everywhere = _dense(len(h)) @ _terms(values) @ _dense(len(y)).T
    size = np.abs(everywhere)
    size[3] = np.maximum(size[3], size[0])
    smallest = 0.99 * size.min(axis=(1, 2))
    each = np.abs(lost)
    beyond = each[:, -2:].sum(axis=(1, 2)) + each[:, :, -2:].sum(axis=(1, 2))
    total = each.sum(axis=(1, 2)) + 2.0 * beyond + rounding
    bounds = total / smallest
    k = int(np.argmax(bounds))
    here = np.abs(_dense(len(h)) @ lost[k] @ _dense(len(y)).T)
    i, j = np.unravel_index(int(np.argmax(here)), here.shape)
    # The dense points run upwards, four to a node, and the nodes downwards.
    return _Worst(float(bounds[k]) + ROUNDING, float(h[-1 - i // 4]), float(y[-1 - j // 4]))


def _rounding(terms: FloatArray, steep: float, low: float, splits: int) -> FloatArray:
    """Bound of what rounding does to a piece's five ratios, from their Chebyshev ``terms``.

    Sums of powers, each over some 32 roundings at most; h, off by two ulps, ``steep`` being h over
    half the piece's width; and y², off by 4 ulps over h² as cos² θ − ρ² cancels towards the limit
    of θ. The ratios' slope in y is 0 there, so that the second derivative bounds that in y²; y is
    off by as many ulps as there are pieces of it.
    """
    i, j = np.arange(terms.shape[1])[:, None], np.arange(terms.shape[2])
    size = np.abs(terms)
    powers = np.abs(to_powers(len(i))), np.abs(to_powers(len(j)))
    sums = 32.0 * np.einsum("ai,bj,kij->k", *powers, size, optimize=True)
    by_h = 2.0 * (steep + 1.0) * (i**2 * size).sum(axis=(1, 2))
    by_y = 4.0 * splits * (j**2 * size).sum(axis=(1, 2))
    second = 4.0 * splits**2 * (j**2 * (j**2 - 1.0) / 3.0 * size).sum(axis=(1, 2))
    total: FloatArray = np.finfo(float).eps * (sums + by_h + by_y + 2.0 * second / low**2)
    return total


def _terms(values: FloatArray) -> FloatArray:
    """Chebyshev coefficients [5, i, j] of ``values`` [5, i, j] at the nodes of both directions."""
    in_x, in_y = _nodes(values.shape[1])[1], _nodes(values.shape[2])[1]
    return np.asarray(np.einsum("ai,bj,kij->kab", in_x, in_y, values, optimize=True))


@cache
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev nodes on [−1, 1] and the matrix from values there to Chebyshev coefficients."""
    nodes: FloatArray = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    return nodes, np.asarray(inverse, dtype=np.float64)


@cache
def _dense(count: int) -> FloatArray:
    """``count`` Chebyshev polynomials at points between which none of them does anything new."""
    return np.asarray(chebyshev.chebvander(np.cos(np.linspace(np.pi, 0.0, 4 * count)), count - 1))


def _tilt(at: _Worst) -> float:
    """θ [rad] at h and y."""
    complement = 1.0 - (at.h * at.y) ** 2
    return math.asin(min(at.h * math.sqrt((1.0 - at.y) * (1.0 + at.y) / complement), 1.0))


def _ratios_at(law: LawTerms, h: FloatArray, y: FloatArray) -> FloatArray:
    """Ratios [5, …] at the table's broadcast coordinates h in (0, 1) and y in [0, 1]."""
    h, y = np.broadcast_arrays(h, y)
    delta = 1.0 - h
    # 1 − u² with u = h y, written so that nothing cancels when h and y near 1.
    complement = (1.0 - y + delta * y) * (1.0 + h * y)
    c = np.sqrt(delta * (1.0 + h) / complement)
    s = h * np.sqrt((1.0 - y) * (1.0 + y) / complement)
    out = np.empty((LANES, h.size))
    ratios_at(
        law.gauss, law.circle, law.polynomials, delta.ravel(), h.ravel(), s.ravel(), c.ravel(), out
    )
    return out.reshape(LANES, *h.shape)
