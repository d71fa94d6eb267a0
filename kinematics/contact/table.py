"""Contact tables: force, energy and their partials by lookup, within a tolerance.

A table is one record, `table_record.Table`, whatever the tip's law. How springs' is built is in
`table_build`, with the bound of its error; the lookup itself is in `lookup`.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.contact.closed_form import Fingertip, flatten
from softfinger.kinematics.contact.lookup import lookup, lookups
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.solid_lookup import solid_table
from softfinger.kinematics.contact.table_build import build
from softfinger.kinematics.contact.table_record import Table

FloatArray = NDArray[np.float64]


class ContactForces(NamedTuple):
    """Values of a table: arrays of the broadcast shape of d and θ, plain numbers for floats."""

    force: FloatArray  # F [N]
    energy: FloatArray  # U [J]
    force_d: FloatArray  # ∂F/∂d [N/m]
    force_theta: FloatArray  # ∂F/∂θ [N/rad]
    energy_d: (
        FloatArray  # ∂U/∂d [N], F/cos θ unless the face sticks: the push along the face's normal
    )
    energy_theta: FloatArray  # ∂U/∂θ [N·m/rad]
    inside: NDArray[np.bool_]  # False where d or θ was clamped to the domain
    max_error: float  # bound of the relative error of any of the six, see Certificate


class Certificate(NamedTuple):
    """A bound of the relative error of any output, and where about the table errs most.

    Over the whole domain with its edges and with rounding; `table_build` says what it rests on.
    ∂F/∂θ may pass through zero where a law softens: it counts relative to F tan θ if that is more.
    """

    max_error: float
    d: float  # [m]
    theta: float  # [rad]


# Of numbers, which the fields' types do not name, in a quarter of the time of ContactForces(…).
_numbers: Any = tuple.__new__

_EDGE = 1.0 - 1e-12  # of d and θ: what is outside by rounding alone is inside with it

_LAW_ERROR = 0.05  # of F, by a law's misfit of its points


class ContactTable:
    """Force, energy and first partials of one tip of one material, by lookup.

    ``data`` is the array of one record that :func:`lookup` takes, ``header`` its fields by name,
    ``max_error`` the bound of the relative error of any output. The domain is 0 < d ≤ 7/8 a and
    |θ| ≤ asin((a − d)/a). A solid tip's table is exact for the data of `solid_data`, so that
    ``max_error`` is theirs, and the domain what they cover.
    """

    def __init__(self, table: Table) -> None:
        self.header = table
        self.data: Any = table.array
        self.is_solid = table.is_solid
        self.max_error = table.max_error
        self._error = (self.max_error,)

    @classmethod
    def build(cls, tip: Fingertip, material: Material, tolerance: float = 1e-9) -> ContactTable:
        """Build the table of fewest pieces within ``tolerance``, relative, on all outputs.

        ∂F/∂θ, which passes through zero for some laws, counts relative to F tan θ if that is more.

        The tolerance is that of the arithmetic alone: a modulus that is 1 % off makes F 1 % off.
        Warns where the law misses the points that it was made from by more than 5 % of F.
        Raises TableError, with the best that was reached, when the most pieces can't meet it.
        For a solid tip it says nothing; a solid tip raises MaterialError unless the modulus is
        constant. A measured tip has its own curves: neither tolerance nor material count.
        """
        if tip.physics != "springs":
            return cls(solid_table(tip, material))
        if material.worst_force_error > _LAW_ERROR:
            warnings.warn(
                f"the smooth law misses its points by up to {material.fit_error:.4g} Pa, which "
                f"makes {material.worst_force_error:.1%} of F; expected {_LAW_ERROR:.0%} at most",
                RuntimeWarning,
                stacklevel=2,
            )
        return cls(build(tip, material, tolerance))

    @property
    def tolerance(self) -> float:
        """The tolerance it was built to."""
        tolerance: float = self.header.tolerance
        return tolerance

    @property
    def certificate(self) -> Certificate:
        """Bound of the relative error, and the d and θ where the table errs most."""
        return Certificate(self.max_error, self.header.worst_d, self.header.worst_theta)

    @property
    def form(self) -> str:
        """Its representation: closed, springs with its pieces of a slab, or solid."""
        if self.is_solid:
            return "solid"
        return "closed" if self.header.is_closed else f"springs, {self.header.splits} a slab"

    @property
    def tip(self) -> Fingertip:
        """The tip that it was built for."""
        return Fingertip(self.header.radius)

    def __call__(self, d: ArrayLike, theta: ArrayLike, edge: bool = False) -> ContactForces:
        """Look up at displacement d [m] and tilt θ [rad]; they broadcast.

        Zeros for d ≤ 0, NaN for NaN; outside the domain the nearest inside, flagged, and with a
        RuntimeWarning unless ``edge`` asks for that. Raises TypeError for what is no real number.
        """
        if type(d) is float and type(theta) is float:
            found = lookup(self.data, d, theta)
            if not (found[6] or edge):
                self._warn(np.array([d]), np.array([theta]))
            numbers: ContactForces = _numbers(ContactForces, found + self._error)
            return numbers
        shape, (depth, tilt) = flatten(d, theta)
        out = np.empty((6, depth.size))
        within = np.empty(depth.size, dtype=np.bool_)
        lookups(self.data, depth, tilt, out, within)
        if not (edge or within.all()):
            self._warn(depth, tilt)
        f, u, f_d, f_theta, u_d, u_theta = (row.reshape(shape) for row in out)
        return ContactForces(
            f, u, f_d, f_theta, u_d, u_theta, within.reshape(shape), self.max_error
        )

    def _warn(self, d: FloatArray, theta: FloatArray) -> None:
        """Warn the caller's caller of points outside the domain, but for NaN."""
        within = np.empty(d.size, dtype=np.bool_)
        lookups(self.data, d * _EDGE, theta * _EDGE, np.empty((6, d.size)), within)
        outside = np.flatnonzero(~(within | np.isnan(d) | np.isnan(theta)))
        if outside.size:
            first = outside[0]
            warnings.warn(
                f"{outside.size} of {d.size} points are outside the contact table, the first at "
                f"d = {1e3 * d[first]:g} mm, θ = {math.degrees(theta[first]):.3g}°; they have the "
                "values of its edge, and `inside` is False",
                RuntimeWarning,
                stacklevel=3,
            )
