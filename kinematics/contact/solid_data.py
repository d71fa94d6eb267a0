"""A tip of solid rubber, computed once by finite elements: elasticity and base pressure, scaled.

The file has them as polynomials in t = √(d/a), sin² θ and Poisson's ratio ν, with Young's modulus E
and the radius a taken out; its ``notes`` say how it was made and how far off it is. Here ν is put
in. The energy is U = E a³ t⁵ g(t, sin² θ), whose partials are the push along the face's normal
N = ∂U/∂d and the moment ∂U/∂θ. The face is frictionless, so the force on the base is N cos θ, and

    p(r, φ) = N/a² [cos θ B_0(r) + Σ_k q_k(t, sin² θ) Re((n_x + i n_y)^m e^{−i m φ}) B_k(r)].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
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
    """A solid tip of E = a = 1 and one ν; polynomials are Chebyshev's, rows by t, then by sin² θ.

    They are of x = 2 t/``root`` − 1 and of y = 2 sin² θ/``square`` − 1.
    """

    root: float  # largest t
    square: float  # largest sin² θ
    energy: FloatArray  # g [i, j]
    harmonics: NDArray[np.int64]  # m of each mode [k]; 0 of the first
    shares: FloatArray  # q [k, i, j]; none of the first
    edges: FloatArray  # of the rings in r/a [rings + 1]
    modes: FloatArray  # B [k, rings], means over the rings
    error: float  # of N, relative, against finer meshes


@lru_cache(maxsize=8)
def solid_data(tip: Fingertip) -> SolidData:
    """The data of a solid ``tip``'s ν and base."""
    with np.load(_FILE) as file:
        kept: dict[str, Any] = {
            name.removeprefix(f"{tip.base}."): file[name]
            for name in file.files
            if "." not in name or name.startswith(f"{tip.base}.")
        }
    low, high = kept["nu_range"]
    at = (2.0 * tip.poisson - low - high) / (high - low)

    def by_poisson(coefficients: FloatArray) -> FloatArray:
        return np.asarray(chebyshev.chebval(at, np.moveaxis(coefficients, -1, 0)))

    root = float(kept["s_max"])
    # 1 + t P with t = root/2 (1 + x); 2 x T_i = T_(i−1) + T_(i+1).
    more = 0.5 * root * np.pad(by_poisson(kept["energy"]), ((0, 1), (0, 0)))
    ratio = more.copy()
    ratio[:-1] += 0.5 * more[1:]
    ratio[1:] += 0.5 * more[:-1]
    ratio[1] += 0.5 * more[0]
    ratio[0, 0] += 1.0
    return SolidData(
        root,
        float(np.sin(kept["theta_max"]) ** 2),
        ratio * 8.0 / (15.0 * (1.0 - tip.poisson**2)),
        kept["m"].astype(np.int64),
        by_poisson(kept["coef"]),
        kept["ring_edges"],
        kept["basis"],
        float(kept.get("error", 0.0)),
    )


def powers(terms: NDArray[Any]) -> NDArray[Any]:
    """Chebyshev coefficients [i, j] as those of powers."""
    for axis in (0, 1):
        terms = np.apply_along_axis(_rising, axis, terms)
    return terms


def _rising(terms: NDArray[Any]) -> NDArray[Any]:
    found = chebyshev.cheb2poly(terms)
    return np.pad(found, (0, len(terms) - len(found)))
