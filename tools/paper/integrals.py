"""The paper's double integrals, eqs. 3 and 10 as they are printed, by product Gauss quadrature.

The figures show them beside the closed forms, so that each is a check of the other.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

_NODES = 64


def double_integrals(
    radius: float, modulus: float, d: ArrayLike, theta: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """(F, U) [N], [J] of eqs. 3 and 10 at d [m] and θ [rad], which broadcast.

    Relative error ≤ 1e-10 within 6° of θ's limit and further in; zeros at d = 0.
    """
    points, weights = leggauss(_NODES)
    angle = 0.5 * np.pi * points  # x and y over the ellipse as sines: its rim costs no accuracy
    weight = 0.5 * np.pi * weights * np.cos(angle)
    depth, tilt = np.broadcast_arrays(np.asarray(d, float), np.asarray(theta, float))
    force = np.empty(depth.shape)
    energy = np.empty(depth.shape)
    for i in np.ndindex(depth.shape):
        s, c, h = np.sin(tilt[i]), np.cos(tilt[i]), radius - depth[i]
        rho = np.sqrt(depth[i] * (radius + h))
        x = (h * s + rho * c * np.sin(angle))[:, None]
        b = np.sqrt(np.maximum(rho**2 - ((x - h * s) / c) ** 2, 0.0))  # eq. 6
        y = b * np.sin(angle)
        area = (rho * c * weight)[:, None] * b * weight
        z = np.sqrt(radius**2 - x**2 - y**2)
        q = (h - x * s) / c  # height of the object's face over the base
        force[i] = modulus * np.sum((1.0 - q / z) * area)
        energy[i] = 0.5 * modulus * np.sum((z - 2.0 * q + q**2 / z) * area)  # eq. 9
    return force, energy
