"""One soft hemispherical fingertip of constant modulus against a plane: the exact formulas.

Holds the fingertip's geometry, the closed forms of force, energy, their partials and the contact's
moments over arrays, and as kernels those that other kernels call. The tip is a hemisphere of radius
a on a rigid base; a spring stands on each point of the base, normal to it. The object's face is
pressed in by d along its normal, which is tilted by θ against the base's normal. With h = a − d:

    F = πE d²/cos θ,    U = πE d³/(3 cos² θ),    ∂U/∂d = F/cos θ,    |θ| ≤ asin(h/a).

They hold because strain × area is an axisymmetric measure about the face's normal on the spherical
cap, so that all its moments are elementary. Beyond the limit of θ the face meets the base plate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

FloatArray = NDArray[np.float64]

HALF_PI = math.pi / 2


@dataclass(frozen=True)
class Fingertip:
    """A hemispherical soft tip of ``radius`` a [m]. Raises ValueError unless a is positive."""

    radius: float

    def __post_init__(self) -> None:
        radius = float(self.radius)
        if not (radius > 0.0 and math.isfinite(radius)):
            raise ValueError(f"the tip's radius must be positive and finite, not {self.radius!r}")
        object.__setattr__(self, "radius", radius)

    def theta_limit(self, d: ArrayLike) -> FloatArray:
        """Largest |θ| [rad] at displacement d [m], asin((a − d)/a); π/2 for d ≤ 0, 0 for d ≥ a."""
        return theta_limits(self.radius, d)


class Closed(NamedTuple):
    """Closed forms; arrays of the broadcast shape of d and θ, NumPy numbers for floats."""

    force: FloatArray  # F [N]
    energy: FloatArray  # U [J]
    force_d: FloatArray  # ∂F/∂d [N/m]
    force_theta: FloatArray  # ∂F/∂θ [N/rad]
    energy_d: FloatArray  # ∂U/∂d [N], the push along the face's normal
    energy_theta: FloatArray  # ∂U/∂θ [N·m/rad]


# For numbers, which the fields' types do not name; a call's overhead counts there.
_closed: Any = Closed


class Seconds(NamedTuple):
    """Second partials of the closed forms; arrays of the broadcast shape of d and θ."""

    force_dd: FloatArray
    force_dtheta: FloatArray
    force_thetatheta: FloatArray
    energy_dd: FloatArray
    energy_dtheta: FloatArray
    energy_thetatheta: FloatArray


class Moments(NamedTuple):
    """Pressure and footprint on the base plane; the tilt is along x. Free of the modulus."""

    centroid: FloatArray  # mean x of the pressure, (a − d/3) sin θ [m]
    variance_x: FloatArray  # second central moment along the tilt [m²]
    variance_y: FloatArray  # and across it, d(4a − d)/12 [m²]
    footprint_centre: FloatArray  # centre of the elliptic footprint, h sin θ [m]
    footprint_x: FloatArray  # its semi-axis along the tilt, ρ cos θ [m]
    footprint_y: FloatArray  # and across it, ρ = √(2ad − d²) [m]
    footprint_area: FloatArray  # πρ² cos θ [m²]
    peak_strain: FloatArray  # 1 − √(h² − a² sin² θ)/(a cos θ)
    peak_position: FloatArray  # x of the peak, a² sin θ/h [m]


@inner_kernel
def theta_limit(radius: float, d: float) -> float:
    """asin((a − d)/a) [rad], clamped to [0, π/2]; NaN for NaN."""
    if d <= 0.0:
        return HALF_PI
    if d >= radius:
        return 0.0
    h = radius - d
    # The angle's cosine is the footprint's radius over a: exact near d → 0, unlike asin(h/a).
    return math.atan2(h, math.sqrt(d * (radius + h)))


@kernel
def closed_form(
    modulus: float, d: float, theta: float
) -> tuple[float, float, float, float, float, float]:
    """(F, U, ∂F/∂d, ∂F/∂θ, ∂U/∂d, ∂U/∂θ) of a constant modulus E [Pa]; zeros for d ≤ 0.

    Free of the radius. Not clamped: past the limit of θ it continues the formulas, and NaN stays.
    """
    if d <= 0.0:
        zero = 0.0 * theta  # NaN in, NaN out
        return zero, zero, zero, zero, zero, zero
    inverse = 1.0 / math.cos(theta)
    slope = math.sin(theta) * inverse
    push = math.pi * modulus * d
    force_d = 2.0 * push * inverse
    force = 0.5 * d * force_d
    energy_d = force * inverse
    energy = energy_d * d * (1.0 / 3.0)
    return force, energy, force_d, force * slope, energy_d, 2.0 * energy * slope


def flatten(*values: ArrayLike) -> tuple[tuple[int, ...], list[FloatArray]]:
    """Broadcast to one shape; returns it and each argument flat, contiguous and in float64."""
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in values))
    shape = arrays[0].shape
    return shape, [np.ascontiguousarray(array).reshape(-1) for array in arrays]


# What is no number is told by NaN in the result.
_quiet = np.errstate(invalid="ignore", divide="ignore", over="ignore")


def _pressed(d: FloatArray, theta: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """``values`` where the tip is pressed (d > 0), zero where it is not, NaN for NaN."""
    nothing = 0.0 * theta + np.where(np.isnan(d), d, 0.0)
    return tuple(np.where(d > 0.0, value, nothing)[()] for value in values)


@_quiet
def closed_forms(modulus: float, d: ArrayLike, theta: ArrayLike) -> Closed:
    """Force, energy and first partials of a constant ``modulus`` [Pa]; d [m], θ [rad] broadcast.

    Zeros for d ≤ 0; NaN in gives NaN out. Valid up to θ's limit, continued past it.
    """
    if type(d) is float and type(theta) is float:
        return cast(Closed, _closed(*map(np.float64, closed_form(float(modulus), d, theta))))
    depth, tilt = _broadcast(d, theta)
    inverse, slope = 1.0 / np.cos(tilt), np.tan(tilt)
    force_d = 2.0 * np.pi * float(modulus) * depth * inverse
    force = 0.5 * depth * force_d
    energy_d = force * inverse
    energy = energy_d * depth / 3.0
    six = force, energy, force_d, force * slope, energy_d, 2.0 * energy * slope
    return Closed(*_pressed(depth, tilt, *six))


@_quiet
def closed_seconds(modulus: float, d: ArrayLike, theta: ArrayLike) -> Seconds:
    """Second partials of the closed forms; d [m], θ [rad] broadcast. Zeros for d ≤ 0."""
    depth, tilt = _broadcast(d, theta)
    inverse, slope = 1.0 / np.cos(tilt), np.tan(tilt)
    square = slope * slope
    force_dd = 2.0 * np.pi * float(modulus) * inverse
    energy_dd = force_dd * depth * inverse
    return Seconds(
        *_pressed(
            depth,
            tilt,
            force_dd,
            force_dd * depth * slope,
            0.5 * force_dd * depth**2 * (1.0 + 2.0 * square),
            energy_dd,
            energy_dd * depth * slope,
            energy_dd * depth**2 * (1.0 + 3.0 * square) / 3.0,
        )
    )


@_quiet
def moments(tip: Fingertip, d: ArrayLike, theta: ArrayLike) -> Moments:
    """Centroid, second moments, footprint and peak strain; d [m], θ [rad] broadcast.

    Centroid and moments are those of a constant modulus; the footprint and the peak strain are the
    geometry's own and hold for any. Zeros for d ≤ 0; the peak strain is NaN past θ's limit.
    """
    radius = tip.radius
    depth, tilt = _broadcast(d, theta)
    s, c = np.sin(tilt), np.cos(tilt)
    h = radius - depth
    across = depth * (4.0 * radius - depth) / 12.0
    along = across - s * s * depth * (12.0 * radius - 5.0 * depth) / 36.0
    rho2 = depth * (radius + h)
    rho = np.sqrt(rho2)
    # h² − a²s² = a²c² − ρ², and the peak strain is 1 − √(1 − g) with g = ρ²/(a²c²).
    g = rho2 / (radius * c) ** 2
    peak = g / (1.0 + np.sqrt(1.0 - g))
    position = np.where(h > 0.0, radius * radius * s / h, radius * s)
    return Moments(
        *_pressed(
            depth,
            tilt,
            (radius - depth / 3.0) * s,
            along,
            across,
            h * s,
            rho * c,
            rho,
            math.pi * rho2 * c,
            peak,
            position,
        )
    )


@_quiet
def tangential(
    modulus: float, d: ArrayLike, theta: ArrayLike, d_t: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """(U, T): energy [J] and stick force along the face [N] with tangential displacement d_t [m].

    U = πE[d³/(3 cos² θ) + d² d_t tan θ + d d_t²] and T = ∂U/∂d_t = πE(d² tan θ + 2 d d_t), the
    parallel-distributed model's forms: each spring is bent by d_t along the face as well as
    compressed. The normal force of the pair is N = ∂U/∂d − T tan θ. Arguments broadcast; zeros for
    d ≤ 0.
    """
    depth, tilt, shear = _broadcast(d, theta, d_t)
    slope, push = np.tan(tilt), np.pi * float(modulus) * depth
    energy = push * (depth**2 * (1.0 + slope**2) / 3.0 + depth * shear * slope + shear**2)
    force = push * (depth * slope + 2.0 * shear)
    energy, force = _pressed(depth, tilt, energy, force)
    return energy, force


def theta_limits(radius: float, d: ArrayLike) -> FloatArray:
    """Largest |θ| [rad] at displacement d [m], shape of d; π/2 for d ≤ 0, 0 for d ≥ a.

    To the bit what the kernels take for the limit.
    """
    shape, (depth,) = flatten(d)
    out = np.empty_like(depth)
    _limits(radius, depth, out)
    return out.reshape(shape)


@kernel
def _limits(radius: float, d: FloatArray, out: FloatArray) -> None:
    for i in range(d.shape[0]):
        out[i] = theta_limit(radius, d[i])


def _broadcast(*values: ArrayLike) -> list[FloatArray]:
    return list(np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in values)))
