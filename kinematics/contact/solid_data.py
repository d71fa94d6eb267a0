"""Precomputed finite element data for a solid rubber tip: energy and base pressure.

The rubber is neo-Hookean with strain energy W = μ/2 (J^(−2/3) tr FᵀF − 3) + κ/2 (J − 1)². The
small-strain moduli are μ = E/(2 + 2ν) and κ = E/(3 − 6ν). Contact is computed in the deformed
configuration.

The data file contains dimensionless polynomials in t = √(d/a), sin² θ and Poisson's ratio ν. The
polynomials are scaled by Young's modulus E and the radius a. The ``notes`` in the file describe the
computation and the remaining errors. This module evaluates the polynomials for one value of ν. The
energy is U = E a³ t⁵ g(t, sin² θ). The partials of U are the force along the face's normal, N =
∂U/∂d, and the moment ∂U/∂θ. With the base force F, the base pressure is

    p(r, φ) = F/a² B_0(r) + N/a² Σ_k q_k(t, sin² θ) Re((n_x + i n_y)^m e^{−i m φ}) B_k(r).

Without friction, F = N cos θ. A sticking face holds each point of the tip at the position where the
point first touched it. The plane moves straight along its normal. The relation N = ∂U/∂d still
holds. To obtain ∂U/∂θ, the energy of straight presses is differentiated with respect to tilt. A
shear force T = −N sin θ cos θ q_0 pulls the tip up the slope. The base force is then F = N cos θ (1
− sin² θ q_0).

A shear force T on the face in direction φ_T adds T/a² B_T(r) cos(φ − φ_T) to the base pressure. The
shear force T is assumed to act at a height of one radius a above the base. Its moment about the
base centre is therefore T·a.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip

_FILE = Path(__file__).with_name("solid_tip.npz")


@dataclass(frozen=True, eq=False)
class SolidData:
    """Data for a solid tip at one value of ν, scaled to E = a = 1.

    Element [i, j] of a polynomial is the coefficient of x^i y^j, with x = 2 t/``root`` − 1 and y =
    2 sin² θ/``square`` − 1.
    """

    root: float  # maximum t
    square: float  # maximum sin² θ
    energy: FloatArray  # g, ∂g/∂t, ∂²g/∂t², ∂g/∂sin² θ, ∂²g/∂t ∂sin² θ [5, i, j]
    harmonics: NDArray[np.int64]  # order m of each mode [k]; the first is 0
    ratios: FloatArray  # q [k, i, j]
    stick: FloatArray  # q_0, ∂q_0/∂t, ∂q_0/∂sin² θ [3, i, j]
    edges: FloatArray  # ring edges, r/a [rings + 1]
    modes: FloatArray  # B averaged over each ring [k, rings]
    shear: FloatArray  # B_T [rings]
    error: float  # relative difference in N between this and other meshes
    pressure_error: float  # rms difference in base pressure between this and other meshes


@lru_cache(maxsize=8)
def solid_data(tip: Fingertip) -> SolidData:
    """Return the data of a solid ``tip``, selected by its Poisson's ratio, base and face."""
    block = tip.base if tip.face == "frictionless" else f"{tip.base}-{tip.face}"
    with np.load(_FILE) as file:
        stored: dict[str, Any] = {
            name.removeprefix(f"{block}."): file[name]
            for name in file.files
            if "." not in name or name.startswith(f"{block}.")
        }
    low, high = stored["nu_range"]
    at = (2.0 * tip.poisson - low - high) / (high - low)

    def by_poisson(coefficients: FloatArray) -> FloatArray:
        return np.asarray(chebyshev.chebval(at, np.moveaxis(coefficients, -1, 0)))

    root = float(stored["s_max"])
    # Compute 1 + t P with t = root/2 (1 + x), using 2 x T_i = T_(i−1) + T_(i+1).
    more = 0.5 * root * np.pad(by_poisson(stored["energy"]), ((0, 1), (0, 0)))
    ratio = more.copy()
    ratio[:-1] += 0.5 * more[1:]
    ratio[1:] += 0.5 * more[:-1]
    ratio[1] += 0.5 * more[0]
    ratio[0, 0] += 1.0
    square = float(np.sin(stored["theta_max"]) ** 2)
    energy = powers(ratio * 8.0 / (15.0 * (1.0 - tip.poisson**2)))
    ratios = np.stack([powers(by_poisson(each)) for each in stored["coef"]])
    stick = ratios[0]
    return SolidData(
        root,
        square,
        with_partials(energy, root, square),
        stored["m"].astype(np.int64),
        ratios,
        np.stack([stick, 2.0 / root * _slope(stick), 2.0 / square * _slope(stick.T).T]),
        stored["ring_edges"],
        stored["basis"],
        by_poisson(stored["shear"]),
        float(stored["force_error"]),
        float(stored["pressure_error"]),
    )


def with_partials(energy: FloatArray, root: float, square: float) -> FloatArray:
    """Return g [i, j] and its partials, arranged as in `SolidData.energy`."""
    by_t = 2.0 / root * _slope(energy)
    by_square = 2.0 / square * _slope(energy.T).T
    by_both = 2.0 / square * _slope(by_t.T).T
    return np.stack([energy, by_t, 2.0 / root * _slope(by_t), by_square, by_both])


def powers(terms: FloatArray) -> FloatArray:
    """Convert Chebyshev coefficients [i, j] to power-series coefficients."""
    in_t, in_square = (to_powers(count) for count in terms.shape)
    return np.asarray(in_t @ terms @ in_square.T)


@cache
def to_powers(count: int) -> FloatArray:
    """Return the matrix that converts ``count`` Chebyshev coefficients to ascending powers."""
    columns = [chebyshev.cheb2poly(row) for row in np.eye(count)]
    return np.stack([np.pad(column, (0, count - len(column))) for column in columns], axis=1)


def _slope(rising: FloatArray) -> FloatArray:
    """Return the derivatives of the polynomials in the columns, padded to the same length."""
    factors = np.arange(1.0, len(rising))[:, None]
    return np.concatenate([rising[1:] * factors, np.zeros((1, rising.shape[1]))])
