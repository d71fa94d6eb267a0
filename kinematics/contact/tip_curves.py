"""The law of a tip that fits no model: curves through calibration presses, and its contact table.

With t = √(d/a) and q = sin² θ each curve is a polynomial Σ c_ij t^i q^j:

    N = push, the force along the face's normal [N]; the force on the base is N cos θ,
    sums of the frame as the sensor shows them: shown [N],
    their centroid towards the tilt over sin θ: lever [m], and mean squared radius: extent [m²].

The push has no power of t below 3, so that its energy U = ∫ N dd is a polynomial, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polyval2d
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
POWERS = 6  # of t
SQUARES = 3  # of q
FIRST = 3  # power of t in the push
_value: Any = polyval2d

Curve: TypeAlias = tuple[tuple[float, ...], ...]  # c [POWERS][SQUARES]


@dataclass(frozen=True)
class TipCurves:
    """Curves of one tip on its sensor, of ``presses``; see the module.

    They hold to ``deepest`` [m] and ``tilt`` [rad]. ``centre`` [m] and ``rotation`` [rad] are the
    tip's place, as of a `SensorGrid`. A frame's sums are its cells' pressures times their area, and
    those times x, y [N·m] and their squared radius [N·m²]; ``rest`` are the sums of a tip that
    nothing touches, ``noise`` [4][4] is their covariance from frame to frame. What the curves
    leave: ``force_error`` relative, of push and shown; ``lever_error`` [m]. Raises ValueError for
    curves that are no law.
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
            raise ValueError("a measured law's numbers must be finite")
        if not (0.0 < self.deepest <= self.radius and 0.0 < self.tilt < 0.5 * math.pi):
            raise ValueError("a measured law must reach from 0 to some depth and tilt")
        shapes = dict.fromkeys(("push", "shown", "lever", "extent"), (POWERS, SQUARES))
        for name, shape in (shapes | {"rest": (4,), "noise": (4, 4)}).items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name}: expected the shape {shape}")
        for name in ("push", "shown"):
            if not rises(getattr(self, name), self.root, self.square):
                raise ValueError(f"{name} must rise with d")

    @property
    def root(self) -> float:
        """Largest t."""
        return math.sqrt(self.deepest / self.radius)

    @property
    def square(self) -> float:
        """Largest q."""
        return math.sin(self.tilt) ** 2

    def at(self, curve: Curve, d: ArrayLike, theta: ArrayLike) -> FloatArray:
        """Return one of the curves at d [m] and θ [rad]; they broadcast."""
        t, q = np.sqrt(np.asarray(d) / self.radius), np.sin(theta) ** 2
        return np.asarray(_value(*np.broadcast_arrays(t, q), np.array(curve)))

    def energy(self) -> FloatArray:
        """Return g of U = a³ t⁵ g(t, q) [Pa] in powers of 2 t/root − 1, 2 q/square − 1: [i, j]."""
        powers = np.arange(POWERS - FIRST)
        g = np.array(self.push)[FIRST:] * (2.0 / (5.0 + powers))[:, None] / self.radius**2
        return np.asarray(
            _shifted(POWERS - FIRST, self.root).T @ g @ _shifted(SQUARES, self.square)
        )


def _shifted(count: int, end: float) -> FloatArray:
    """Powers of u = end/2 (1 + x) by powers of x, [power of u, power of x]."""
    return np.array(
        [[(0.5 * end) ** i * math.comb(i, k) for k in range(count)] for i in range(count)]
    )


def rises(curve: ArrayLike, root: float, square: float) -> bool:
    """Return whether the curve is above 0 and rises with t all over (0, root] × [0, square]."""
    t, q = np.meshgrid(np.linspace(0.0, root, 41), np.linspace(0.0, square, 9), indexing="ij")
    values = _value(t, q, np.asarray(curve))
    return bool((np.diff(values, axis=0) > 0.0).all() and (values[0] >= 0.0).all())
