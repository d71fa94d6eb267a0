"""Measured tip model, which consists of polynomial curves fitted to calibration presses.

With t = √(d/a) and q = sin² θ, each curve is a polynomial Σ c_ij t^i q^j:

    push     N, the force along the face's normal [N]; the force on the base is N cos θ
    shown    force summed over the sensor's frame [N]
    lever    frame centroid along the tilt direction, divided by sin θ [m]
    extent   mean squared radius of the frame [m²]

The lowest power of t in ``push`` is 3. The energy U = ∫ N dd therefore has the same polynomial form
as that of a solid tip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polyval2d
from numpy.typing import ArrayLike

from softfinger.kinematics.compiled.layout import FloatArray

POWERS = 6  # number of powers of t
SQUARES = 3  # number of powers of q
FIRST = 3  # lowest power of t in ``push``
_value: Any = polyval2d

Curve: TypeAlias = tuple[tuple[float, ...], ...]  # c [POWERS][SQUARES]


@dataclass(frozen=True)
class TipCurves:
    """Measured curves of one tip on its sensor; the module docstring defines the curves.

    The curves are valid up to ``deepest`` [m] and ``tilt`` [rad]. ``centre`` [m] and ``rotation``
    [rad] locate the tip on the sensor, as in `SensorGrid`. ``presses`` is the number of presses in
    the fit. Four sums over the cell forces describe a frame: the force [N], the first moments in x
    and y [N·m] and the second moment [N·m²]. A cell force is pressure times area. ``rest`` contains
    the sums for an unloaded tip, and ``noise`` [4][4] is the covariance of one frame's sums.
    ``force_error`` is the relative residual of ``push`` and ``shown``. ``lever_error`` [m] is the
    residual of the frame centroid. Raises ValueError if the curves are invalid.
    """

    radius: float
    deepest: float
    tilt: float
    push: Curve
    shown: Curve
    lever: Curve
    extent: Curve
    centre: tuple[float, float]
    rotation: float
    rest: tuple[float, ...]
    noise: Curve
    force_error: float
    lever_error: float
    presses: int

    def __post_init__(self) -> None:
        if not all(np.isfinite(getattr(self, each.name)).all() for each in fields(self)):
            raise ValueError("all numbers in a measured law must be finite")
        if not (0.0 < self.deepest <= self.radius and 0.0 < self.tilt < 0.5 * math.pi):
            raise ValueError("the maximum depth and tilt of a measured law must be above 0")
        shapes = dict.fromkeys(("push", "shown", "lever", "extent"), (POWERS, SQUARES))
        for name, shape in (shapes | {"rest": (4,), "noise": (4, 4)}).items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"{name} must have shape {shape}, got {np.shape(getattr(self, name))}"
                )
        for name in ("push", "shown"):
            if not rises(getattr(self, name), self.root, self.square):
                raise ValueError(f"{name} must increase with d")

    @property
    def root(self) -> float:
        """Maximum t for which the curves are valid."""
        return math.sqrt(self.deepest / self.radius)

    @property
    def square(self) -> float:
        """Maximum q for which the curves are valid."""
        return math.sin(self.tilt) ** 2

    def at(self, curve: Curve, d: ArrayLike, theta: ArrayLike) -> FloatArray:
        """Evaluate one of the curves; d [m] and θ [rad] are broadcast."""
        t, q = np.sqrt(np.asarray(d) / self.radius), np.sin(theta) ** 2
        return np.asarray(_value(*np.broadcast_arrays(t, q), np.array(curve)))

    def energy(self) -> FloatArray:
        """Return the coefficients [i, j] of g [Pa], where U = a³ t⁵ g.

        g is a polynomial in 2 t/root − 1 and 2 q/square − 1.
        """
        powers = np.arange(POWERS - FIRST)
        g = np.array(self.push)[FIRST:] * (2.0 / (5.0 + powers))[:, None] / self.radius**2
        return np.asarray(
            _shifted_polynomial(POWERS - FIRST, self.root).T
            @ g
            @ _shifted_polynomial(SQUARES, self.square)
        )


def _shifted_polynomial(count: int, end: float) -> FloatArray:
    """Expand the powers of u = end/2 (1 + x) in powers of x: [power of u, power of x]."""
    return np.array(
        [[(0.5 * end) ** i * math.comb(i, k) for k in range(count)] for i in range(count)]
    )


def rises(curve: ArrayLike, root: float, square: float) -> bool:
    """Return True if the curve is positive and increases with t on (0, root] × [0, square]."""
    t, q = np.meshgrid(np.linspace(0.0, root, 41), np.linspace(0.0, square, 9), indexing="ij")
    values = _value(t, q, np.asarray(curve))
    return bool((np.diff(values, axis=0) > 0.0).all() and (values[0] >= 0.0).all())
