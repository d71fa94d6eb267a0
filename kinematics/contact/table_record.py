"""Define the record type of contact tables, and evaluate their polynomials.

A table consists of pieces. Each piece has five polynomials (lanes) in two variables. The lanes are
evaluated together. The meaning of the polynomials and of their variables depends on the tip model;
see `lookup`.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias

from softfinger import SoftfingerError
from softfinger.kinematics.compiled.kernel import index, inlined_kernel
from softfinger.kinematics.compiled.layout import FloatArray, Record

__all__ = ["TableError"]

Lanes: TypeAlias = tuple[float, float, float, float, float]
ThreeFloats: TypeAlias = tuple[float, float, float]

LANES = 5
POWERS_U, POWERS_V = 12, 6  # terms in each variable
PIECE = POWERS_V * POWERS_U * LANES  # coefficients per piece
OCTAVES = 3  # number of octaves of h in the table of a spring tip
SLAB_BITS = 4  # Each octave has 2^4 slabs.
SPLITS_MAX = 4  # maximum number of pieces per slab
PIECES = OCTAVES * 2**SLAB_BITS * SPLITS_MAX


class TableError(SoftfingerError):
    """Error raised if a table cannot be built within the tolerance."""


class LookupResult(NamedTuple):
    """Force F and energy U of a tip at one displacement d and tilt θ, with their partials."""

    force: float  # F [N]
    energy: float  # U [J]
    force_d: float  # ∂F/∂d [N/m]
    force_theta: float  # ∂F/∂θ [N/rad]
    energy_d: float  # ∂U/∂d [N]
    energy_theta: float  # ∂U/∂θ [N·m/rad]
    inside: bool  # False if d or θ was clamped to the domain of the table


class Table(Record):
    """Contact table of one tip and material."""

    is_solid: bool  # True for a solid or measured tip
    is_closed: bool  # True for springs with a constant modulus, whose table has no pieces
    sticks: bool
    splits: int  # pieces per slab
    radius: float  # [m]
    inverse_radius: float
    modulus: float  # modulus at zero strain [Pa]
    deepest: float  # maximum d [m]
    tilt: float  # maximum |θ| of a solid tip [rad]
    by_root: float  # 2/(maximum t)
    by_square: float  # 2/(maximum sin² θ)
    at_first: float  # g at t = 0, from Hertz's theory
    tolerance: float
    max_error: float  # bound on the relative error; for a solid tip, relative error of its data
    worst_d: float  # d at which the error is largest [m]
    worst_theta: float  # θ at which the error is largest [rad]
    coefficients: Annotated[FloatArray, PIECES * PIECE]


@inlined_kernel
def lanes(table: Table, piece: int, u: float, v: float) -> Lanes:
    """Evaluate the five polynomials of a ``piece`` at u and v, both in [−1, 1]."""
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
    """Store the polynomials of a piece; ``powers`` [lanes, u, v] are ascending coefficients."""
    count, in_u, in_v = powers.shape
    place = table.coefficients[piece * PIECE : (piece + 1) * PIECE]
    place.reshape(POWERS_V, POWERS_U, LANES)[:in_v, :in_u, :count] = powers.T
