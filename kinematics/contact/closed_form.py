"""Exact formulas for contact between a plane and a soft hemispherical tip of constant modulus.

The module defines the fingertip's geometry and computes force, energy and partial derivatives. The
tip is a hemisphere of radius a on a rigid base. The tip consists of independent springs that are
normal to the base, one at every point. The object's face is displaced by d along the face's normal,
which is tilted by θ from the base normal. With h = a − d:

    F = πE d²/cos θ,    U = πE d³/(3 cos² θ),    ∂U/∂d = F/cos θ,    |θ| ≤ asin(h/a).

The formulas are exact. On the spherical cap, strain × area is an axisymmetric measure about the
face's normal. The moments of this measure are elementary functions. Beyond the limit on θ, the face
touches the base plate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.tip_curves import TipCurves

__all__ = ["ClosedForms", "Fingertip", "closed_forms"]


HALF_PI = math.pi / 2
RADIUS_MAX = 1.0  # maximum radius [m]; larger values were probably given in millimetres
POISSON = (0.45, 0.4995)  # range of Poisson's ratio in the data for solid tips


Physics = Literal["springs", "solid", "measured"]
Base = Literal["bonded", "lying"]
Face = Literal["frictionless", "sticking"]


@dataclass(frozen=True)
class Fingertip:
    """Hemispherical soft fingertip.

    Parameters
    ----------
    radius
        Radius a [m], at most 1 m.
    physics
        Deformation model: "springs" for independent springs, "solid" for linear elastic rubber, or
        "measured" for curves from calibration presses.
    poisson
        Poisson's ratio of a solid tip, 0.45 to 0.4995.
    base
        "bonded" if a solid tip is bonded to the sensor, "lying" if it lies on the sensor.
    face
        Contact of a solid tip with the object: "frictionless" or "sticking".
    law
        Measured curves; required if ``physics`` is "measured", otherwise None.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    radius: float
    physics: Physics = "springs"
    poisson: float = 0.49
    base: Base = "bonded"
    face: Face = "frictionless"
    law: TipCurves | None = None

    def __post_init__(self) -> None:
        for name, kind in (("physics", Physics), ("base", Base), ("face", Face)):
            known = get_args(kind)
            if getattr(self, name) not in known:
                expected = " or ".join(map(repr, known))
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")
        if not POISSON[0] <= self.poisson <= POISSON[1]:
            low, high = POISSON
            raise ValueError(f"poisson must be between {low} and {high}, got {self.poisson!r}")
        if (self.physics == "measured") != (self.law is not None):
            raise ValueError(
                "law must be given if and only if physics is 'measured', got physics "
                f"{self.physics!r}"
            )
        radius = float(self.radius)
        if not (radius > 0.0 and math.isfinite(radius)):
            raise ValueError(f"the tip's radius must be positive and finite, got {self.radius!r}")
        if radius > RADIUS_MAX:
            raise ValueError(
                f"the tip's radius must be in metres, at most {RADIUS_MAX:g}, got {radius:g}; "
                f"{radius:g} mm is {radius * 1e-3:g} m"
            )
        object.__setattr__(self, "radius", radius)

    def theta_limit(self, d: ArrayLike) -> FloatArray:
        """Return the maximum |θ| [rad] at d [m].

        The result is asin((a − d)/a), or π/2 for d ≤ 0 and 0 for d ≥ a. It is a scalar or an array,
        like ``d``.
        """
        depth = np.clip(np.asarray(d, np.float64), 0.0, self.radius)
        h = self.radius - depth
        # At the limit, cos θ is the footprint radius divided by a. Unlike asin(h/a), this form is
        # accurate for small d.
        limit: FloatArray = np.arctan2(h, np.sqrt(depth * (self.radius + h)))
        return limit


class ClosedForms(NamedTuple):
    """Results of the closed forms: arrays broadcast from d and θ, or NumPy scalars."""

    force: FloatArray  # F [N]
    energy: FloatArray  # U [J]
    force_d: FloatArray  # ∂F/∂d [N/m]
    force_theta: FloatArray  # ∂F/∂θ [N/rad]
    energy_d: FloatArray  # ∂U/∂d, the force along the face's normal [N]
    energy_theta: FloatArray  # ∂U/∂θ [N·m/rad]


def flatten(*values: ArrayLike) -> tuple[tuple[int, ...], list[FloatArray]]:
    """Broadcast the arguments; return the common shape and the arguments as flat float64 arrays.

    Raises TypeError for arguments that are not real numbers.
    """
    arrays = np.broadcast_arrays(*map(_real, values))
    shape = arrays[0].shape
    return shape, [array.flatten() for array in arrays]


def _real(value: ArrayLike) -> FloatArray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"d and θ must be real numbers, got {value!r} ({array.dtype})")
    return np.asarray(array, dtype=np.float64)


# NaN and infinite inputs result in NaN without a warning.
@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def closed_forms(modulus: float, d: ArrayLike, theta: ArrayLike) -> ClosedForms:
    """Return force, energy and partials for a constant ``modulus`` [Pa].

    ``d`` [m] and ``theta`` [rad] are broadcast. The results are zero for d ≤ 0 and NaN for NaN
    input. The formulas are valid up to the limit on θ, but the function also evaluates them beyond
    the limit.
    """
    depth, tilt = np.broadcast_arrays(_real(d), _real(theta))
    inverse, slope = 1.0 / np.cos(tilt), np.tan(tilt)
    force_d = 2.0 * np.pi * float(modulus) * depth * inverse
    force = 0.5 * depth * force_d
    energy_d = force * inverse
    energy = energy_d * depth / 3.0
    six = force, energy, force_d, force * slope, energy_d, 2.0 * energy * slope
    nothing = 0.0 * tilt + np.where(np.isnan(depth), depth, 0.0)  # propagates NaN
    return ClosedForms(*(np.where(depth > 0.0, each, nothing)[()] for each in six))
