"""Compute the linear model of a solid tip: ``python -m research.solid_tip``.

The result is the input file for `strain`. The notes in the file that `strain` writes describe the
format.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.solid_tip import fit
from research.solid_tip.contact import TiltedPlane
from research.solid_tip.fit import SolidTip, rms_difference
from research.solid_tip.green import RING_EDGES, green, shear_response

Arrays = dict[str, NDArray[Any]]

STICKING = "-sticking"
# Number of elements along the arc for each combination of base and face.
BLOCKS = {"bonded": 64, "lying": 64, "bonded-sticking": 48, "lying-sticking": 48}
NODES = fit.chebyshev_nodes(*fit.NU, 4)  # fitted values of ν
# Values of ν and number of elements of the presses used only for validation. Their differences from
# the model include both the error of the fit and the error of the mesh.
HELD_OUT, HELD_OUT_RINGS = (0.458, 0.49, 0.4995), 32
TOLERANCE = 1.2e-3  # tolerance of the modes


def presses(which: tuple[str, int, float], folder: Path) -> fit.Samples:
    """Compute all presses of one block, mesh and ν, or load them from ``folder``."""
    block, rings, poisson = which
    base, sticking = block.removesuffix(STICKING), block.endswith(STICKING)
    file = folder / f"{block}-{rings}-{poisson:.6f}.npz"
    if not file.exists():
        surface = green(rings, poisson, base == "bonded", fit.HARMONICS)
        depths = fit.chebyshev_nodes(0, fit.S_MAX, 24) ** 2
        found = []
        for sine2 in fit.chebyshev_nodes(0, np.sin(fit.THETA_MAX) ** 2, 9):
            plane = TiltedPlane(surface, np.arcsin(np.sqrt(sine2)), fit.D_MAX, sticking)
            found += [plane.press(d) for d in depths if d > 0.003]
        np.savez(file, **fit.Samples.of(found, surface.base_radius)._asdict())
    with np.load(file) as data:
        return fit.Samples(**data)


def differences(tip: SolidTip, samples: fit.Samples) -> str:
    """Describe the relative errors in N, U and p for three depth ranges of ``samples``."""
    areas = np.sqrt(np.diff(tip.edges**2))
    rows = []
    for d, theta, push, energy, _, base in zip(*samples, strict=True):
        found = tip.press(d, theta)
        pressure = rms_difference(found[2] * areas, base[: len(found[2])] * areas)
        rows.append((found[0] / push - 1, found[1] / energy - 1, pressure))
    text = []
    for low, high in ((0.0, 0.02), (0.02, 0.05), (0.05, 0.4)):
        part = np.abs(np.array(rows)[(samples.d >= low) & (samples.d < high)])
        pairs = zip("NUp", part.max(axis=0), np.sqrt(np.mean(part**2, axis=0)), strict=True)
        text.append(f"d/a {low}-{high} " + ", ".join(f"{k} {x:.1e} {y:.1e}" for k, x, y in pairs))
    return "; ".join(text)


def main() -> None:
    """Compute the presses, fit the model, write the file and print the model's errors."""
    parser = argparse.ArgumentParser(prog="python -m research.solid_tip", description=__doc__)
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument(
        "--folder", type=Path, required=True, help="folder for the results of presses"
    )
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    work = [
        *((block, rings, poisson) for block, rings in BLOCKS.items() for poisson in NODES),
        *product(BLOCKS, [HELD_OUT_RINGS], HELD_OUT),
    ]
    with ProcessPoolExecutor(2) as pool:
        folders = [arguments.folder] * len(work)
        samples = dict(zip(work, pool.map(presses, work, folders), strict=True))
    arrays: Arrays = {
        "s_max": np.array(fit.S_MAX),
        "theta_max": np.array(fit.THETA_MAX),
        "nu_range": np.array(fit.NU),
        "ring_edges": RING_EDGES,
    }
    for block, rings in BLOCKS.items():
        part = [samples[block, rings, poisson] for poisson in NODES]
        found = fit.fit(part, NODES, np.pi / 2 / rings, TOLERANCE)
        shear = []
        for poisson in NODES:
            radius, pressure = shear_response(rings, poisson, block.startswith("bonded"))
            shear.append(fit.ring_means(radius) @ pressure)
        found["shear"] = fit.over_nu(np.array(shear)).astype(np.float32)
        arrays |= {f"{block}.{name}": value for name, value in found.items()}
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]
    for (block, rings, poisson), each in samples.items():
        told = " (not fitted)" if rings == HELD_OUT_RINGS else ""
        errors = differences(SolidTip(arrays, block, poisson), each)
        print(f"{block}, {rings} elements, ν {poisson:.4f}{told}: {errors}")


if __name__ == "__main__":
    main()
