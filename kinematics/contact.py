"""One soft hemispherical fingertip of constant modulus against a plane: the exact formulas.

Holds the fingertip's geometry, the closed forms of force, energy, their partials and the contact's
moments, as scalar kernels, and array front ends of them. The tip is a hemisphere of radius a on a
rigid base; a spring stands on each point of the base, normal to it. The object's face is pressed in
by d along its normal, which is tilted by θ against the base's normal. With h = a − d:

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

from kinematics.kernels import inner_kernel, kernel

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


@inner_kernel
def closed_form_seconds(
    modulus: float, d: float, theta: float
) -> tuple[float, float, float, float, float, float]:
    """(F_dd, F_dθ, F_θθ, U_dd, U_dθ, U_θθ) of a constant modulus; zeros for d ≤ 0."""
    if d <= 0.0:
        zero = 0.0 * theta
        return zero, zero, zero, zero, zero, zero
    c = math.cos(theta)
    slope = math.sin(theta) / c
    force = math.pi * modulus * d * d / c
    energy = force * d / (3.0 * c)
    slope2 = slope * slope
    return (
        2.0 * force / (d * d),
        2.0 * force * slope / d,
        force * (1.0 + 2.0 * slope2),
        6.0 * energy / (d * d),
        6.0 * energy * slope / d,
        energy * (2.0 + 6.0 * slope2),
    )


@inner_kernel
def contact_moments(
    radius: float, d: float, theta: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """The fields of :class:`Moments` in their order. Zeros for d ≤ 0; valid up to θ's limit."""
    if d <= 0.0:
        zero = 0.0 * theta
        return zero, zero, zero, zero, zero, zero, zero, zero, zero
    s = math.sin(theta)
    c = math.cos(theta)
    h = radius - d
    rho2 = d * (radius + h)
    rho = math.sqrt(rho2)
    across = d * (4.0 * radius - d) / 12.0
    along = across - s * s * d * (12.0 * radius - 5.0 * d) / 36.0
    # h² − a²s² = a²c² − ρ², and the peak strain is 1 − √(1 − g) with g = ρ²/(a²c²).
    g = rho2 / (radius * c) ** 2
    peak = g / (1.0 + math.sqrt(1.0 - g)) if g <= 1.0 else math.nan
    position = radius * radius * s / h if h > 0.0 else radius * s
    return (
        (radius - d / 3.0) * s,
        along,
        across,
        h * s,
        rho * c,
        rho,
        math.pi * rho2 * c,
        peak,
        position,
    )


@inner_kernel
def tangential_energy(modulus: float, d: float, theta: float, d_t: float) -> float:
    """U = πE[d³/(3 cos² θ) + d² d_t tan θ + d d_t²] [J] with tangential displacement d_t [m].

    The parallel-distributed model's form: each spring is bent by d_t along the face as well as
    compressed. Zero for d ≤ 0.
    """
    if d <= 0.0:
        return 0.0 * theta
    slope = math.tan(theta)
    square = 1.0 + slope * slope
    return math.pi * modulus * d * (d * d * square / 3.0 + d * d_t * slope + d_t * d_t)


@inner_kernel
def tangential_force(modulus: float, d: float, theta: float, d_t: float) -> float:
    """T = ∂U/∂d_t = πE(d² tan θ + 2 d d_t) [N], the stick contact's force along the face."""
    if d <= 0.0:
        return 0.0 * theta
    return math.pi * modulus * d * (d * math.tan(theta) + 2.0 * d_t)


@kernel
def _closed_forms(modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray) -> None:
    for i in range(d.shape[0]):
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i]) = closed_form(
            modulus, d[i], theta[i]
        )


@kernel
def _seconds(modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray) -> None:
    for i in range(d.shape[0]):
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i]) = closed_form_seconds(
            modulus, d[i], theta[i]
        )


@kernel
def _moments(radius: float, d: FloatArray, theta: FloatArray, out: FloatArray) -> None:
    for i in range(d.shape[0]):
        (
            out[0, i],
            out[1, i],
            out[2, i],
            out[3, i],
            out[4, i],
            out[5, i],
            out[6, i],
            out[7, i],
            out[8, i],
        ) = contact_moments(radius, d[i], theta[i])


@kernel
def _tangential(
    modulus: float, d: FloatArray, theta: FloatArray, d_t: FloatArray, out: FloatArray
) -> None:
    for i in range(d.shape[0]):
        out[0, i] = tangential_energy(modulus, d[i], theta[i], d_t[i])
        out[1, i] = tangential_force(modulus, d[i], theta[i], d_t[i])


@kernel
def _limits(radius: float, d: FloatArray, out: FloatArray) -> None:
    for i in range(d.shape[0]):
        out[i] = theta_limit(radius, d[i])


def flatten(*values: ArrayLike) -> tuple[tuple[int, ...], list[FloatArray]]:
    """Broadcast to one shape; returns it and each argument flat, contiguous and in float64."""
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in values))
    shape = arrays[0].shape
    return shape, [np.ascontiguousarray(array).reshape(-1) for array in arrays]


def _mapped(function: Any, rows: int, scalar: float, *values: ArrayLike) -> list[FloatArray]:
    shape, arrays = flatten(*values)
    out = np.empty((rows, arrays[0].size))
    function(scalar, *arrays, out)
    return [row.reshape(shape) for row in out]


def closed_forms(modulus: float, d: ArrayLike, theta: ArrayLike) -> Closed:
    """Force, energy and first partials of a constant ``modulus`` [Pa]; d [m], θ [rad] broadcast.

    Zeros for d ≤ 0; NaN in gives NaN out. Valid up to θ's limit, continued past it.
    """
    if type(d) is float and type(theta) is float:
        return cast(Closed, _closed(*map(np.float64, closed_form(float(modulus), d, theta))))
    return Closed(*_mapped(_closed_forms, 6, float(modulus), d, theta))


def closed_seconds(modulus: float, d: ArrayLike, theta: ArrayLike) -> Seconds:
    """Second partials of the closed forms; d [m], θ [rad] broadcast. Zeros for d ≤ 0."""
    return Seconds(*_mapped(_seconds, 6, float(modulus), d, theta))


def moments(tip: Fingertip, d: ArrayLike, theta: ArrayLike) -> Moments:
    """Centroid, second moments, footprint and peak strain; d [m], θ [rad] broadcast.

    Centroid and moments are those of a constant modulus; the footprint and the peak strain are the
    geometry's own and hold for any. Zeros for d ≤ 0; the peak strain is NaN past θ's limit.
    """
    return Moments(*_mapped(_moments, 9, tip.radius, d, theta))


def tangential(
    modulus: float, d: ArrayLike, theta: ArrayLike, d_t: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """(U, T): energy [J] and stick force along the face [N] with tangential displacement d_t [m].

    The normal force of the pair is N = ∂U/∂d − T tan θ. Arguments broadcast.
    """
    energy, force = _mapped(_tangential, 2, float(modulus), d, theta, d_t)
    return energy, force


def theta_limits(radius: float, d: ArrayLike) -> FloatArray:
    """Largest |θ| [rad] at displacement d [m], shape of d; π/2 for d ≤ 0, 0 for d ≥ a."""
    shape, (depth,) = flatten(d)
    out = np.empty_like(depth)
    _limits(radius, depth, out)
    return out.reshape(shape)
