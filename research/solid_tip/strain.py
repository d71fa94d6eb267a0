"""Add the effect of finite strain to the linear model of a solid tip.

``python -m research.solid_tip.strain LINEAR OUT --folder FOLDER`` reads the linear model, which
``python -m research.solid_tip`` has written. The command then writes the neo-Hookean model in the
same format. The effect of finite strain is computed by comparing linear and neo-Hookean elements of
`rubber`. The two kinds of elements use the same mesh, so the mesh error cancels. The ratio of the
two energies scales the energy of the linear model. Each base pressure is divided by the normal
force, and the difference between the two results is added to the base pressure of the linear model.
Upright presses use a fine mesh. Tilted presses use a coarse mesh and are compared with upright
presses on that mesh.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.interpolate import KroghInterpolator

from research.solid_tip import fit
from research.solid_tip.__main__ import NODES, differences
from research.solid_tip.fit import SolidTip
from research.solid_tip.green import RING_EDGES, FloatArray, Meridian
from research.solid_tip.rubber import HARMONICS, strained

NU = fit.chebyshev_nodes(*fit.NU, 3)
SINES = np.sin(fit.THETA_MAX) ** 2 * (1 - np.cos(np.pi * np.arange(5) / 4)) / 2  # sin²θ
AREAS = np.pi * np.diff(RING_EDGES**2)
# Computed tilts of each block, as indices of `SINES`. At the largest depth and tilt, the elements
# of lying rubber collapse, and the solution does not converge. The fit therefore extrapolates
# there.
TILTS = {
    "bonded": (1, 2, 4),
    "lying": (1, 2),
    "bonded-sticking": (2, 4),
    "lying-sticking": (2,),
}
TOLERANCE = 3e-3  # tolerance of the modes
IN_ROOT = 5  # number of terms in √(d/a) for the effect of strain, the first being d/a


NOTES = """Hemisphere of neo-Hookean rubber, W = μ/2 (J^(−2/3) tr FᵀF − 3) + κ/2 (J − 1)², pressed
by a rigid plane, computed by python -m research.solid_tip.strain. The plane either has no friction
or sticks. It moves along its normal, and a sticking plane holds each point where it first touched
it; T = N sin θ cos θ P[coef_0] is then the force along (cos θ, 0, −sin θ) on the tip.
Lengths are in units of a, stresses in units of E; d ≤ 0.4 a, θ ≤ 36°, ν 0.45 … 0.4995. s = √(d/a).
P is a product of Chebyshev series in 2 s/s_max − 1, 2 (sin θ/sin theta_max)² − 1 and ν (nu_range):
N = 4/(3 (1 − ν²)) s³ (1 + s P[push]), U = 8/(15 (1 − ν²)) s⁵ (1 + s P[energy]);
p = F B_0(r) + N Σ P[coef_k] sin^m_k θ B_k(r) cos m_k φ; basis: means of B_k over rings;
F = N cos θ (1 − sin² θ P[coef_0]), with coef_0 = 0 unless the face sticks.
A shear force T on the face adds T B_T(r) cos(φ − φ_T). shear contains the means of B_T over the
rings (for a force at the pole of undeformed rubber), as Chebyshev coefficients in ν.
Bonded base: u = 0. Lying base: u_z = 0 (held down, so tension is possible); it slides freely,
except that a uniform shear carries the tip's own shear. The pressure also acts outside the radius 1
where the base has slid. force_error and pressure_error are the errors of N and of the base pressure
where the pressure is smooth (within 0.95 a), compared with other meshes, for d up to 0.35 a and θ
up to 20°. Maximum and rms errors of the fit:
{errors}"""
# Errors determined from the results of tests/harness/solid_reference.py. A coarse mesh barely
# resolves the rim of a bonded base under tilt.
FORCE_ERROR = 0.005
PRESSURE_ERROR = {"bonded": 0.01, "lying": 0.004}


def in_root(s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the terms d/a T_i(s) at each s (n, i), and their derivatives with respect to d/a."""
    x = 2 * s / fit.S_MAX - 1
    value = chebyshev.chebvander(x, IN_ROOT - 1)
    slope = chebyshev.chebval(x, chebyshev.chebder(np.eye(IN_ROOT))).T * (2 / fit.S_MAX)
    return s[:, None] ** 2 * value, value + s[:, None] * slope / 2


def coefficients(
    arrays: Mapping[str, FloatArray], theta: float, step: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the effect of finite strain on the presses from `rubber.strained` at a single θ and ν.

    Returns the coefficients of the energy ratio (i,), of T/N (i,) and of the base pressure divided
    by N (i, H, R). ``step`` is the cell width.
    """
    d, push, shear, energy = (arrays[name] for name in ("d", "push", "shear", "energy"))
    force = push * np.cos(theta) - shear * np.sin(theta)
    found = arrays["base"][:, :, 0] @ AREAS
    base = arrays["base"] * (force / found / push)[..., None, None]
    ratio = shear / push
    s = np.sqrt(d[0])
    value, slope = in_root(s)
    scatter = 0.001 + 0.05 * (step / s) ** 2
    lever = energy[0] / (push[0] * d[0])
    left = np.concatenate([value, value + (lever * s**2)[:, None] * slope])
    right = np.concatenate([energy[1] / energy[0] - 1, push[1] / push[0] - 1])
    scatter = np.concatenate([scatter, 6 * scatter])

    def fitted(rows: FloatArray, values: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.lstsq(rows, values, rcond=None)[0], dtype=np.float64)

    more_base = base[1] - base[0]
    return (
        fitted(left / scatter[:, None], right / scatter),
        fitted(value, ratio[1] - ratio[0]),
        fitted(value, more_base.reshape(len(value), -1)).reshape(-1, *more_base.shape[1:]),
    )


class Strain:
    """Effect of finite strain in one block, for any d, θ and ν."""

    def __init__(self, block: str, tilts: Sequence[int], folder: Path) -> None:
        """Set up a block; ``tilts`` are the indices in `SINES` of the coarse tilted presses."""
        fine, coarse = Meridian(16), Meridian(8, finer=2, widest=0.2)

        def of(name: str, poisson: float, mesh: Meridian, theta: float | None) -> Any:
            file = folder / f"{block}-{name}-{poisson:.5f}.npz"
            found = strained(block, poisson, theta, mesh, file)
            return coefficients(found, theta or 0.0, np.pi / 2 / (16 if mesh is fine else 8))

        upright = [of("fine", poisson, fine, None) for poisson in NU]
        self.upright = [KroghInterpolator(NU, each) for each in zip(*upright, strict=True)]
        sines = SINES[list(tilts)]
        theta = np.arcsin(np.sqrt(sines))
        tilted = [
            of(f"tilt{k}", NU[1], coarse, angle) for k, angle in zip(tilts, theta, strict=True)
        ]
        energy, shear, base = (np.array(each) for each in zip(*tilted, strict=True))
        same_energy, _, same_base = of("coarse", NU[1], coarse, None)
        with_upright = np.append(0.0, sines)
        rise, first = energy - same_energy, base[:, :, 0] - same_base[:, 0]
        self.rise = KroghInterpolator(with_upright, [0 * rise[0], *rise])
        self.first = KroghInterpolator(with_upright, [0 * first[0], *first])
        self.shear = KroghInterpolator(sines, shear / (np.sin(theta) * np.cos(theta))[:, None])
        base /= np.sin(theta)[:, None, None, None] ** np.arange(HARMONICS)[:, None]
        self.harmonics = KroghInterpolator(sines, base)
        # At small tilts, the higher harmonics are very small. Division by sin^m θ would leave only
        # mesh errors.
        least = 1 if len(sines) > 1 else 0
        self.higher = KroghInterpolator(sines[least:], base[least:])

    def at(self, poisson: float, square: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the coefficients of energy ratio, T/(N sin θ cos θ) and base pressure.

        ``square`` is sin²θ.
        """
        energy, _, base = (each(poisson) for each in self.upright)
        powers = np.sqrt(square) ** np.arange(HARMONICS)[:, None]
        found = self.harmonics(square) * powers
        found[:, 2:] = (self.higher(square) * powers)[:, 2:]
        found[:, 0] = base[:, 0] + self.first(square)
        return energy + self.rise(square), self.shear(square), found

    def strain(self, tip: SolidTip) -> fit.Samples:
        """Return presses of the linear ``tip`` over the whole domain, with finite strain added."""
        rows = []
        for square in fit.chebyshev_nodes(0, np.sin(fit.THETA_MAX) ** 2, 9):
            theta = float(np.arcsin(np.sqrt(square)))
            ratio, more_shear, more_base = self.at(tip.poisson, square)
            for s in fit.chebyshev_nodes(0, fit.S_MAX, 28)[2:]:
                d = s**2
                push, energy, base = tip.press(d, theta)
                shear = tip.shear(d, theta)
                value, slope = (each[0] for each in in_root(np.array([s])))
                strained_push = push * (1 + value @ ratio) + energy * (slope @ ratio)
                shear += float(value @ more_shear) * np.sin(theta) * np.cos(theta)
                pattern = np.zeros((HARMONICS, AREAS.size))
                pattern[: len(base), : base.shape[1]] = base / push
                pattern += np.tensordot(value, more_base, axes=1)
                row = (d, theta, strained_push, energy * (1 + value @ ratio))
                rows.append((*row, shear * strained_push, pattern * strained_push))
        return fit.Samples(*(np.array(each) for each in zip(*rows, strict=True)))


def main() -> None:
    """Compute the presses that are missing from the folder, and write the data file."""
    parser = argparse.ArgumentParser(
        prog="python -m research.solid_tip.strain", description=__doc__
    )
    parser.add_argument("linear", type=Path, help="file of the linear law")
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument(
        "--folder", type=Path, required=True, help="folder for the results of presses"
    )
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with np.load(arguments.linear) as file:
        linear: dict[str, NDArray[Any]] = dict(file)
    arrays = {name: linear[name] for name in ("s_max", "theta_max", "nu_range")}
    arrays["ring_edges"] = RING_EDGES
    rows = []
    for block, tilts in TILTS.items():
        strain = Strain(block, tilts, arguments.folder)
        samples = [strain.strain(SolidTip(linear, block, poisson)) for poisson in NODES]
        found = fit.fit(samples, NODES, 0.02, TOLERANCE)
        found["shear"] = np.pad(
            linear[f"{block}.shear"], ((0, AREAS.size - linear["ring_edges"].size + 1), (0, 0))
        )
        arrays |= {f"{block}.{name}": value for name, value in found.items()}
        arrays[f"{block}.force_error"] = np.array(FORCE_ERROR)
        arrays[f"{block}.pressure_error"] = np.array(PRESSURE_ERROR[block.partition("-")[0]])
        for poisson, each in zip(NODES, samples, strict=True):
            tip = SolidTip(arrays, block, poisson)
            rows.append(f"{block}, ν {poisson:.4f}: {differences(tip, each)}")
        print(block, len(found["m"]), "modes")
    arrays["notes"] = np.array(NOTES.format(errors="\n".join(rows)))
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
