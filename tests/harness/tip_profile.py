"""Reference integrals for any axisymmetric tip, and past the limit of θ: for plots and checks.

A tip's profile z(r) is the height of its surface over the base at radius r. Springs under a face
that reaches below the base plate are squeezed flat, ε = 1. There the sensor's sum F and the push of
the object ∂U/∂d part: F counts the flat springs, which no longer move.

    F = ∬ σ(ε) dS,   U = ∬ z w(ε) dS,   ∂U/∂d = ∬ σ(ε)/cos θ dS over the springs that still move.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material, stress_at

FloatArray = NDArray[np.float64]

_SCAN = 800  # points among which the face's crossings of the profile are bracketed


class Compression(NamedTuple):
    """What a tip gives at d and θ; arrays of their broadcast shape."""

    force: FloatArray  # what the sensor under the base sums to [N]
    energy: FloatArray  # elastic energy [J]
    push: FloatArray  # the object's force along its normal, ∂U/∂d [N]


class TipProfile:
    """A tip's surface z(r) through points from the apex (r = 0) to the rim (z = 0).

    z² is interpolated over r² by a monotone piecewise cubic (Fritsch and Carlson's slopes), so that
    a sphere is met exactly and the rim's vertical tangent is no trouble. ``radius`` and ``height``
    [m], at least two points. Raises ValueError for points that describe no tip.
    """

    def __init__(self, radius: ArrayLike, height: ArrayLike) -> None:
        r = np.asarray(radius, dtype=np.float64)
        z = np.asarray(height, dtype=np.float64)
        if r.ndim != 1 or r.shape != z.shape or r.size < 2:
            raise ValueError("a profile needs two lists of one length, of at least two points")
        if not (np.all(np.isfinite(r)) and np.all(np.isfinite(z))):
            raise ValueError("the profile's points must be finite")
        if r[0] != 0.0 or z[-1] != 0.0:
            raise ValueError("a profile starts at the apex, r = 0, and ends at the rim, z = 0")
        if np.any(np.diff(r) <= 0.0) or np.any(np.diff(z) >= 0.0):
            raise ValueError("from apex to rim, radius must rise and height must fall")
        self.radius = float(r[-1])
        # Per piece: start in r², then z² = Σ c_j t^j, t = r² − start; [pieces, 5].
        self.pieces = _monotone_cubic(r**2, z**2)

    @classmethod
    def sphere(cls, tip: Fingertip) -> TipProfile:
        """The hemisphere of a fingertip."""
        return cls([0.0, tip.radius], [tip.radius, 0.0])

    def height(self, radius: ArrayLike) -> FloatArray:
        """z [m] at radius r [m], shape of r; 0 beyond the rim."""
        r = np.asarray(radius, dtype=np.float64)
        square = r**2
        k = np.clip(np.searchsorted(self.pieces[:, 0], square, side="right") - 1, 0, None)
        start, c0, c1, c2, c3 = np.moveaxis(self.pieces[k], -1, 0)
        t = square - start
        value = c0 + t * (c1 + t * (c2 + t * c3))
        return np.asarray(np.where(r < self.radius, np.sqrt(np.maximum(value, 0.0)), 0.0))

    def reach(self, theta: float) -> float:
        """Distance [m] of the base's centre from the face that just touches, max(r s + z c)."""
        s, c = abs(math.sin(theta)), math.cos(theta)
        low, high = 0.0, self.radius
        for _ in range(8):
            r = np.linspace(low, high, 101)
            best = int(np.argmax(r * s + self.height(r) * c))
            low, high = float(r[max(best - 1, 0)]), float(r[min(best + 1, 100)])
        return float(np.max(r * s + self.height(r) * c))


def compress(
    profile: TipProfile, material: Material, d: ArrayLike, theta: ArrayLike
) -> Compression:
    """Force, energy and push of any profile and material, clipped at the base plate; to 1e-10.

    d [m] and θ [rad] broadcast, |θ| < π/2. Zeros for d ≤ 0, NaN for NaN.
    """
    depth, tilt = np.broadcast_arrays(
        np.asarray(d, dtype=np.float64), np.asarray(theta, dtype=np.float64)
    )
    if np.any(np.abs(tilt) >= math.pi / 2):
        raise ValueError("the face's tilt must stay below a right angle")
    out = np.empty((3, depth.size))
    for i, (one, angle) in enumerate(zip(depth.flat, tilt.flat, strict=True)):
        out[:, i] = _compress_once(profile, material, float(one), float(angle))
    return Compression(*(row.reshape(depth.shape) for row in out))


def _compress_once(
    profile: TipProfile, material: Material, d: float, theta: float
) -> tuple[float, float, float]:
    if math.isnan(d) or math.isnan(theta):
        return math.nan, math.nan, math.nan
    if d <= 0.0:
        return 0.0, 0.0, 0.0
    s, c = abs(math.sin(theta)), math.cos(theta)
    h = max(profile.reach(theta) - d, 0.0)
    breaks = _breaks(profile, s, c, h)
    return _integrate(profile.pieces, material.law, material.energy_law, breaks, s, c, h)


def _breaks(profile: TipProfile, s: float, c: float, h: float) -> FloatArray:
    """Radii where the integral over the angle changes its kind, and the profile its piece."""
    radii = [0.0, profile.radius, *np.sqrt(profile.pieces[1:, 0])]
    if s > 0.0 and h / s < profile.radius:
        radii.append(h / s)
    # Finer towards the rim, where the profile may be steep.
    grid = profile.radius * np.sin(np.linspace(0.0, math.pi / 2, _SCAN))
    for sign in (1.0, -1.0):
        value = profile.height(grid) * c + sign * grid * s - h
        for k in np.flatnonzero(value[:-1] * value[1:] < 0.0):
            low, high = float(grid[k]), float(grid[k + 1])
            for _ in range(60):
                middle = 0.5 * (low + high)
                there = float(profile.height(middle)) * c + sign * middle * s - h
                low, high = (middle, high) if there * value[k] > 0.0 else (low, middle)
            radii.append(0.5 * (low + high))
    return np.unique(np.asarray(radii))


@inner_kernel
def energy_density_at(energy_law: FloatArray, strain: float) -> float:
    """w(ε) = ∫₀^ε σ [J/m³] from ``energy_law``; 0 for ε ≤ 0, beyond ε = 1 as σ is continued."""
    if strain <= 0.0:
        return 0.0
    pieces, order = energy_law.shape
    if not strain < 1.0:
        value: float = 0.0
        slope: float = 0.0
        curve: float = 0.0
        for j in range(order):
            value += energy_law[pieces - 1, j]
            slope += j * energy_law[pieces - 1, j]
            curve += j * (j - 1) * energy_law[pieces - 1, j]
        more: float = pieces * (strain - 1.0)
        return value + more * (slope + 0.5 * more * curve)
    u = strain * pieces
    k = int(u)
    u -= k
    result: float = energy_law[k, order - 1]
    for j in range(order - 2, -1, -1):
        result = result * u + energy_law[k, j]
    return result


@inner_kernel
def _height(pieces: FloatArray, r: float) -> float:
    square = r * r
    k = pieces.shape[0] - 1
    while k > 0 and square < pieces[k, 0]:
        k -= 1
    t = square - pieces[k, 0]
    value = pieces[k, 1] + t * (pieces[k, 2] + t * (pieces[k, 3] + t * pieces[k, 4]))
    return math.sqrt(max(value, 0.0))


@kernel
def _integrate(
    pieces: FloatArray,
    law: FloatArray,
    energy_law: FloatArray,
    breaks: FloatArray,
    s: float,
    c: float,
    h: float,
) -> tuple[float, float, float]:
    """Double-exponential rules over r between the breaks and over the angle where ε > 0.

    They bear the roots and logarithms that the integrand has at the ends.
    """
    steps = 44
    step = 3.2 / steps
    full_stress = stress_at(law, 1.0)
    full_energy = energy_density_at(energy_law, 1.0)
    force = 0.0
    energy = 0.0
    push = 0.0
    for b in range(breaks.shape[0] - 1):
        low = breaks[b]
        width = breaks[b + 1] - low
        for i in range(-steps, steps + 1):
            e = math.exp(math.pi * math.sinh(i * step))
            part = e / (1.0 + e)  # from 0 to 1
            r = low + width * part
            weight_r = width * step * math.pi * math.cosh(i * step) * part / (1.0 + e) * r
            z = _height(pieces, r)
            if not weight_r > 0.0 or not z > 0.0:
                continue
            # Springs are pressed for ψ < ψ1, and flat for ψ < ψ0.
            psi1 = _angle(h - c * z, r * s)
            psi0 = _angle(h, r * s)
            if psi0 > 0.0:
                area = 2.0 * psi0 * weight_r
                force += area * full_stress
                energy += area * z * full_energy
            span = psi1 - psi0
            if not span > 0.0:
                continue
            for j in range(-steps, steps + 1):
                e = math.exp(math.pi * math.sinh(j * step))
                part = e / (1.0 + e)
                weight = span * step * math.pi * math.cosh(j * step) * part / (1.0 + e)
                psi = psi0 + span * part
                strain = 1.0 - (h - r * s * math.cos(psi)) / (c * z)
                strain = min(strain, 1.0)
                area = 2.0 * weight * weight_r
                stress = stress_at(law, strain)
                force += area * stress
                push += area * stress / c
                energy += area * z * energy_density_at(energy_law, strain)
    return force, energy, push


@inner_kernel
def _angle(distance: float, reach: float) -> float:
    """Half the angle over which reach·cos ψ > distance."""
    if distance >= reach:
        return 0.0
    if distance <= -reach:
        return math.pi
    return math.acos(distance / reach)


def _monotone_cubic(x: FloatArray, y: FloatArray) -> FloatArray:
    """Pieces [start, c0, c1, c2, c3] of a monotone C¹ interpolant."""
    width = np.diff(x)
    secant = np.diff(y) / width
    slope = np.empty_like(x)
    slope[0], slope[-1] = secant[0], secant[-1]
    for k in range(1, x.size - 1):
        # The harmonic mean, weighted by the neighbours' widths, keeps the curve monotone.
        w1 = 2.0 * width[k] + width[k - 1]
        w2 = width[k] + 2.0 * width[k - 1]
        slope[k] = (w1 + w2) / (w1 / secant[k - 1] + w2 / secant[k])
    rows = []
    for k in range(x.size - 1):
        d0, d1 = slope[k], slope[k + 1]
        c2 = (3.0 * secant[k] - 2.0 * d0 - d1) / width[k]
        c3 = (d0 + d1 - 2.0 * secant[k]) / width[k] ** 2
        rows.append([x[k], y[k], d0, c2, c3])
    return np.asarray(rows)
