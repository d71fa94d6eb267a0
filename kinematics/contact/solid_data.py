"""A tip of solid rubber, computed once by finite elements: elasticity and base pressure, scaled.

The rubber is neo-Hookean, of strain energy W = μ/2 (J^(−2/3) tr FᵀF − 3) + κ/2 (J − 1)² with the
μ = E/(2 + 2ν) and κ = E/(3 − 6ν) of small strains, and contact is made in the deformed state.
The file has them as polynomials in t = √(d/a), sin² θ and Poisson's ratio ν, with Young's modulus E
and the radius a taken out; its ``notes`` say how it was made and how far off it is. Here ν is put
in. The energy is U = E a³ t⁵ g(t, sin² θ), whose partials are the push along the face's normal
N = ∂U/∂d and the moment ∂U/∂θ. With the force F on the base,

    p(r, φ) = F/a² B_0(r) + N/a² Σ_k q_k(t, sin² θ) Re((n_x + i n_y)^m e^{−i m φ}) B_k(r).

Without friction F = N cos θ. A face that sticks holds each point of the tip where it touched, the
plane coming straight along its normal from first touch on. Then N = ∂U/∂d still, ∂U/∂θ compares
such presses, a shear T = −N sin θ cos θ q_0 pulls the tip up the slope, and
F = N cos θ (1 − sin² θ q_0).

A shear force T on the face, towards φ_T, adds T/a² B_T(r) cos(φ − φ_T), where T counts as if it
were at the height a: its moment about the base's middle is T a.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip

FloatArray = NDArray[np.float64]

_FILE = Path(__file__).with_name("solid_tip.npz")


@dataclass(frozen=True, eq=False)
class SolidData:
    """A solid tip of E = a = 1 and one ν.

    Polynomials are by powers of x = 2 t/``root`` − 1, then of y = 2 sin² θ/``square`` − 1.
    """

    root: float  # largest t
    square: float  # largest sin² θ
    energy: FloatArray  # g, and its partials by t, t twice, sin² θ, and both [5, i, j]
    harmonics: NDArray[np.int64]  # m of each mode [k]; 0 of the first
    ratios: FloatArray  # q [k, i, j]
    stick: FloatArray  # q_0, and its partials by t and sin² θ [3, i, j]
    edges: FloatArray  # of the rings in r/a [rings + 1]
    modes: FloatArray  # B [k, rings], means over the rings
    shear: FloatArray  # B_T [rings]
    error: float  # of N, relative, against other meshes
    pressure_error: float  # of the base pressure, likewise: rms over its rms


@lru_cache(maxsize=8)
def solid_data(tip: Fingertip) -> SolidData:
    """Return the data of a solid ``tip``'s ν, base and face."""
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
    # 1 + t P with t = root/2 (1 + x); 2 x T_i = T_(i−1) + T_(i+1).
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
    """Return g [i, j] and its partials, as `SolidData.energy` has them."""
    by_t = 2.0 / root * _slope(energy)
    by_square = 2.0 / square * _slope(energy.T).T
    by_both = 2.0 / square * _slope(by_t.T).T
    return np.stack([energy, by_t, 2.0 / root * _slope(by_t), by_square, by_both])


def powers(terms: FloatArray) -> FloatArray:
    """Return Chebyshev coefficients [i, j] as those of powers."""
    in_t, in_square = (to_powers(count) for count in terms.shape)
    return np.asarray(in_t @ terms @ in_square.T)


@cache
def to_powers(count: int) -> FloatArray:
    """Return the matrix from ``count`` Chebyshev coefficients to those of rising powers."""
    columns = [chebyshev.cheb2poly(row) for row in np.eye(count)]
    return np.stack([np.pad(column, (0, count - len(column))) for column in columns], axis=1)


def _slope(rising: FloatArray) -> FloatArray:
    """The derivative of polynomials of columns, as many powers."""
    factors = np.arange(1.0, len(rising))[:, None]
    return np.concatenate([rising[1:] * factors, np.zeros((1, rising.shape[1]))])
