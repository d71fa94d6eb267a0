"""The record behind every contact table, and its polynomials.

A table is pieces of five polynomials in two variables, the lanes, evaluated together. What they
mean, and of which variables they are, depends on the tip's law: see `lookup` and `solid_lookup`.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger import SoftfingerError
from softfinger.kinematics.compiled.kernel import index, inlined_kernel
from softfinger.kinematics.compiled.layout import Record

FloatArray = NDArray[np.float64]
Lanes: TypeAlias = tuple[float, float, float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float, bool]
Triple: TypeAlias = tuple[float, float, float]

LANES = 5
POWERS_U, POWERS_V = 12, 6  # terms of a polynomial in either variable
PIECE = POWERS_V * POWERS_U * LANES  # numbers of a piece
OCTAVES = 3  # of the height over a face, which springs' pieces span
SLAB_BITS = 4  # 2^4 slabs to an octave
SPLITS_MAX = 4  # pieces of a slab
PIECES = OCTAVES * 2**SLAB_BITS * SPLITS_MAX


class TableError(SoftfingerError):
    """A table can't be built to the tolerance."""


class Table(Record):
    """Force and energy of one tip of one material."""

    is_solid: bool  # or measured: one energy, see `solid_lookup`; else springs
    is_closed: bool  # springs of a constant modulus, without pieces
    sticks: bool
    splits: int  # pieces of a slab
    radius: float  # [m]
    inverse_radius: float
    modulus: float  # at no strain [Pa]
    deepest: float  # d up to which it holds [m]
    tilt: float  # of a solid tip: |θ| likewise [rad]
    by_root: float  # 2/largest t
    by_square: float  # 2/largest sin² θ
    at_first: float  # g at t = 0: Hertz's
    tolerance: float
    max_error: float  # bound of the relative error; of a solid tip, of the data
    worst_d: float  # where the piece errs most that has the largest [m]
    worst_theta: float  # [rad]
    coefficients: Annotated[FloatArray, PIECES * PIECE]


@inlined_kernel
def lanes(table: Table, piece: int, u: float, v: float) -> Lanes:
    """Return the five polynomials of a ``piece`` at u and v, both from −1 to 1."""
    c = table.coefficients
    at = index((piece + 1) * PIECE)
    step = index(LANES)
    p0 = p1 = p2 = p3 = p4 = 0.0
    for _ in range(POWERS_V):
        q0 = q1 = q2 = q3 = q4 = 0.0
        for _ in range(POWERS_U):
            at -= step
            q0 = q0 * u + c[at]
            q1 = q1 * u + c[at + index(1)]
            q2 = q2 * u + c[at + index(2)]
            q3 = q3 * u + c[at + index(3)]
            q4 = q4 * u + c[at + index(4)]
        p0 = p0 * v + q0
        p1 = p1 * v + q1
        p2 = p2 * v + q2
        p3 = p3 * v + q3
        p4 = p4 * v + q4
    return p0, p1, p2, p3, p4


def set_piece(table: Table, piece: int, powers: FloatArray) -> None:
    """Store polynomials by rising powers, [lanes, u, v]."""
    count, in_u, in_v = powers.shape
    place = table.coefficients[piece * PIECE : (piece + 1) * PIECE]
    place.reshape(POWERS_V, POWERS_U, LANES)[:in_v, :in_u, :count] = powers.T
