"""Contact tables for fast lookup of force, energy and partials within a certified tolerance.

For every tip model, a table is a single `table_record.Table` record. The `table_build` module
builds the tables of spring tips and bounds their error. The `lookup` module evaluates tables.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip, flatten
from softfinger.kinematics.contact.lookup import lookup, lookups
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table_build import build, solid_table
from softfinger.kinematics.contact.table_record import Table

__all__ = ["Certificate", "ContactForces", "ContactTable"]


class ContactForces(NamedTuple):
    """Result of a lookup: arrays broadcast from d and θ, or floats.

    Attributes
    ----------
    force
        Elastic force F on the tip's base [N].
    energy
        Elastic potential energy U [J].
    force_d
        ∂F/∂d [N/m].
    force_theta
        ∂F/∂θ [N/rad].
    energy_d
        ∂U/∂d [N], the force along the object's normal: F/cos θ unless the face sticks.
    energy_theta
        ∂U/∂θ [N·m/rad].
    inside
        False if d or θ was clamped to the domain of the table.
    max_error
        Bound on the relative error of the six values; see `Certificate`.
    """

    force: FloatArray
    energy: FloatArray
    force_d: FloatArray
    force_theta: FloatArray
    energy_d: FloatArray
    energy_theta: FloatArray
    inside: NDArray[np.bool_]
    max_error: float


class Certificate(NamedTuple):
    """Bound on the relative error of all outputs, and the approximate location of the maximum.

    The bound includes rounding errors and covers the whole domain including its edges. The
    assumptions behind the bound are listed in `table_build`. For softening laws, ∂F/∂θ may pass
    through zero. The error of ∂F/∂θ is therefore relative to the larger of ∂F/∂θ and F tan θ.

    Attributes
    ----------
    max_error
        Bound on the relative error.
    d
        Displacement at which the error is largest [m].
    theta
        Tilt at which the error is largest [rad].
    """

    max_error: float
    d: float
    theta: float


# For plain floats, tuple.__new__ creates a ContactForces four times as fast as the constructor.
_numbers: Any = tuple.__new__

_EDGE_FACTOR = 1.0 - 1e-12  # moves points at the edge into the domain despite rounding

_LAW_ERROR = 0.05  # relative force error due to the law above which `build` warns


class ContactTable:
    """Lookup table of force, energy and their first partials for one tip and one material.

    Attributes
    ----------
    data
        Array with the single table record that :func:`lookup` takes as its argument.
    header
        The same record, with fields accessible by name.
    max_error
        Bound on the relative error of all outputs. For a solid tip, the bound is the error of the
        data.

    Notes
    -----
    The domain of a spring tip is 0 < d ≤ 7/8 a and |θ| ≤ asin((a − d)/a). The domain of a solid tip
    is the range covered by `solid_data`; the table reproduces these data exactly.
    """

    def __init__(self, table: Table) -> None:
        self.header = table
        self.data: Any = table.array
        self.max_error = table.max_error

    def __repr__(self) -> str:
        radius = f"radius {1e3 * self.header.radius:.4g} mm"
        return f"ContactTable: {self.form}, {radius}, relative error at most {self.max_error:.1e}"

    @classmethod
    def build(cls, tip: Fingertip, material: Material, tolerance: float = 1e-9) -> ContactTable:
        """Build the smallest table that meets a relative ``tolerance`` for all outputs.

        Parameters
        ----------
        tip
            Fingertip.
        material
            Material law. A solid tip requires a constant modulus. A measured tip has its own curves
            and ignores the material.
        tolerance
            Maximum relative numerical error, for spring tips only. The error of ∂F/∂θ is relative
            to the larger of ∂F/∂θ and F tan θ. Errors of the material law are not included: a
            modulus error of 1 % changes F by 1 %.

        Raises
        ------
        TableError
            If the tolerance cannot be met with the largest table.
        MaterialError
            If the tip is solid and the modulus is not constant.

        Warns
        -----
        RuntimeWarning
            If the misfit of a spring tip's material law changes F by more than 5 %.
        """
        if tip.physics != "springs":
            return cls(solid_table(tip, material))
        if material.worst_force_error > _LAW_ERROR:
            warnings.warn(
                "the material law deviates from the measured points by up to "
                f"{material.fit_error:.4g} Pa, which changes the force by up to "
                f"{material.worst_force_error:.1%}; expected at most {_LAW_ERROR:.0%}",
                RuntimeWarning,
                stacklevel=2,
            )
        return cls(build(tip, material, tolerance))

    @property
    def tolerance(self) -> float:
        """Tolerance passed to `build`."""
        tolerance: float = self.header.tolerance
        return tolerance

    @property
    def certificate(self) -> Certificate:
        """Bound on the relative error, and the d and θ at which the error is largest."""
        return Certificate(self.max_error, self.header.worst_d, self.header.worst_theta)

    @property
    def form(self) -> str:
        """Table type: "closed", "springs" with the number of pieces per slab, or "solid"."""
        if self.header.is_solid:
            return "solid"
        return "closed" if self.header.is_closed else f"springs, {self.header.splits} a slab"

    @property
    def tip(self) -> Fingertip:
        """Spring tip with the table's radius."""
        return Fingertip(self.header.radius)

    def __call__(self, d: ArrayLike, theta: ArrayLike, edge: bool = False) -> ContactForces:
        """Look up the forces at displacement ``d`` [m] and tilt ``theta`` [rad].

        Parameters
        ----------
        d, theta
            Numbers or arrays, which are broadcast. If both are numbers, the results are numbers.
            The results are zero for d ≤ 0 and NaN for NaN input.
        edge
            If True, clamp points outside the domain without a RuntimeWarning. Regardless of
            ``edge``, ``inside`` is False for clamped points.

        Raises
        ------
        TypeError
            If an argument is not a real number.
        """
        if type(d) is not float or type(theta) is not float:
            shape, (depth, tilt) = flatten(d, theta)
            if shape:
                out = np.empty((6, depth.size))
                within = np.empty(depth.size, dtype=np.bool_)
                lookups(self.data, depth, tilt, out, within)
                if not (edge or within.all()):
                    self._warn(depth, tilt)
                f, u, f_d, f_theta, u_d, u_theta = out.reshape(6, *shape)
                inside = within.reshape(shape)
                return ContactForces(f, u, f_d, f_theta, u_d, u_theta, inside, self.max_error)
            d, theta = depth.item(), tilt.item()
        found = lookup(self.data, d, theta)
        if not (found.inside or edge):
            self._warn(np.array([d]), np.array([theta]))
        numbers: ContactForces = _numbers(ContactForces, (*found, self.max_error))
        return numbers

    def _warn(self, d: FloatArray, theta: FloatArray) -> None:
        """Issue a RuntimeWarning if points are outside the domain. NaN does not cause a warning."""
        within = np.empty(d.size, dtype=np.bool_)
        lookups(self.data, d * _EDGE_FACTOR, theta * _EDGE_FACTOR, np.empty((6, d.size)), within)
        outside = np.flatnonzero(~(within | np.isnan(d) | np.isnan(theta)))
        if outside.size:
            first = outside[0]
            warnings.warn(
                f"{outside.size} of {d.size} points are outside the contact table, the first at "
                f"d = {1e3 * d[first]:g} mm, θ = {math.degrees(theta[first]):.3g}°; for these "
                "points, the values at the table's edge are returned and `inside` is False",
                RuntimeWarning,
                stacklevel=3,
            )
