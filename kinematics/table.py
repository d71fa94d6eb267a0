"""Contact tables: force, energy and their partials by lookup, to a tolerance.

A table is one flat float64 array, header and coefficients, which is a kernel's argument. What is
tabulated is the ratio of each quantity to its closed form for the modulus at zero strain: smooth,
near 1, finite at d → 0, and exact for a constant modulus.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinematics.contact import Fingertip, closed_form, flatten, theta_limit
from kinematics.kernels import kernel
from kinematics.material import Material
from kinematics.quadrature import circle_rule, gauss_rule, ratios

FloatArray = NDArray[np.float64]

HALF_PI = math.pi / 2
CLOSED = 0.0
GLOBAL = 1.0
_HEADER = 16
_DEEP = 1.0 / 16.0


@kernel
def lookup(
    data: FloatArray, d: float, theta: float
) -> tuple[float, float, float, float, float, float, bool]:
    """(F, U, ∂F/∂d, ∂F/∂θ, ∂U/∂d, ∂U/∂θ, inside) at displacement d [m] and tilt θ [rad].

    Zeros for d ≤ 0. Outside the domain d and θ are clamped to it and ``inside`` is False; NaN in
    gives NaN out.
    """
    if math.isnan(d) or math.isnan(theta):
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, False
    radius = data[2]
    modulus = data[3]
    if d <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
    inside = True
    if d > data[4] * radius:
        d = data[4] * radius
        inside = False
    if abs(theta) > HALF_PI or abs(math.sin(theta)) * radius > radius - d:
        limit = theta_limit(radius, d)
        inside = inside and abs(theta) <= limit
        theta = min(max(theta, -limit), limit)
    force, energy, force_d, force_theta, energy_d, energy_theta = closed_form(modulus, d, theta)
    if data[1] == CLOSED:
        return force, energy, force_d, force_theta, energy_d, energy_theta, inside
    delta = d / radius
    h = 1.0 - delta
    c = math.cos(theta)
    y = math.sqrt(max(c * c - delta * (1.0 + h), 0.0)) / (c * h)
    x = 2.0 * (delta / data[4]) - 1.0
    y = 2.0 * y - 1.0
    order = int(data[5])
    r0 = 0.0
    r1 = 0.0
    r2 = 0.0
    r3 = 0.0
    r4 = 0.0
    at = _HEADER
    for _ in range(order):
        q0 = 0.0
        q1 = 0.0
        q2 = 0.0
        q3 = 0.0
        q4 = 0.0
        for _ in range(order):
            q0 = q0 * y + data[at]
            q1 = q1 * y + data[at + 1]
            q2 = q2 * y + data[at + 2]
            q3 = q3 * y + data[at + 3]
            q4 = q4 * y + data[at + 4]
            at += 5
        r0 = r0 * x + q0
        r1 = r1 * x + q1
        r2 = r2 * x + q2
        r3 = r3 * x + q3
        r4 = r4 * x + q4
    force *= r0
    return (
        force,
        energy * r1,
        force_d * r2,
        force_theta * r3,
        force / math.cos(theta),
        energy_theta * r4,
        inside,
    )


@kernel
def _lookups(
    data: FloatArray,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
    inside: NDArray[np.bool_],
) -> None:
    for i in range(d.shape[0]):
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i], inside[i]) = lookup(
            data, d[i], theta[i]
        )


class Contact(NamedTuple):
    """What a table returns; arrays of the broadcast shape of d and θ."""

    force: FloatArray  # F [N]
    energy: FloatArray  # U [J]
    force_d: FloatArray  # ∂F/∂d [N/m]
    force_theta: FloatArray  # ∂F/∂θ [N/rad]
    energy_d: FloatArray  # ∂U/∂d = F/cos θ [N]
    energy_theta: FloatArray  # ∂U/∂θ [N·m/rad]
    inside: NDArray[np.bool_]  # False where d or θ was clamped
    max_error: float  # the certificate: largest relative error of any of the six


class ContactTable:
    """Force, energy and first partials of one tip of one material."""

    def __init__(self, data: FloatArray, max_error: float) -> None:
        self.data = data
        self.max_error = max_error

    @classmethod
    def build(cls, tip: Fingertip, material: Material, tolerance: float = 1e-9) -> ContactTable:
        """Build the cheapest table that meets ``tolerance``."""
        header = np.zeros(_HEADER)
        header[2:5] = tip.radius, material.reference_modulus, 1.0
        if material.is_linear:
            return cls(header, 4e-15)
        order = 14
        header[1] = GLOBAL
        header[4:6] = 1.0 - _DEEP, order
        nodes = np.cos(np.pi * (np.arange(order) + 0.5) / order)
        parts = material.expansions()
        gauss, circle = gauss_rule(), circle_rule(material.degree)
        values = np.empty((5, order, order))
        for i, x in enumerate(nodes):
            delta = 0.5 * (x + 1.0) * header[4]
            h = 1.0 - delta
            for j, y in enumerate(nodes):
                u = 0.5 * (y + 1.0) * h
                c = min(math.sqrt(delta * (1.0 + h) / (1.0 - u * u)), 1.0)
                s = math.sqrt((1.0 - c) * (1.0 + c))
                values[:, i, j] = ratios(gauss, circle, parts, delta, s, c)
        inverse = np.linalg.inv(np.vander(nodes, order))
        coefficients = np.einsum("ai,bj,kij->abk", inverse, inverse, values)
        return cls(np.concatenate([header, coefficients.reshape(-1)]), math.nan)

    def __call__(self, d: ArrayLike, theta: ArrayLike) -> Contact:
        """Look up at displacement d [m] and tilt θ [rad]; they broadcast."""
        shape, (depth, tilt) = flatten(d, theta)
        out = np.empty((6, depth.size))
        inside = np.empty(depth.size, dtype=np.bool_)
        _lookups(self.data, depth, tilt, out, inside)
        return Contact(*(row.reshape(shape) for row in out), inside.reshape(shape), self.max_error)
