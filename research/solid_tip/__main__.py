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

BASES = ("bonded", "lying")
STICKING = "-sticking"
BLOCKS = tuple(base + face for face in ("", STICKING) for base in BASES)
HELD_OUT = (0.458, 0.49, 0.4995)  # values of ν used only for validation


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


def mesh_errors(arrays: Arrays, other: Arrays, block: str) -> tuple[float, float]:
    """Return the maximum relative differences in N and in a sensor frame between two models."""
    force, pressure = [], []
    for poisson in (*fit.NU, 0.49):
        tip, second = SolidTip(arrays, block, poisson), SolidTip(other, block, poisson)
        for d in (0.005, 0.025, 0.1, 0.25, fit.D_MAX):
            for theta in (0.0, 0.3, fit.THETA_MAX):
                (push, _, one), (its_push, _, two) = tip.press(d, theta), second.press(d, theta)
                force.append(abs(its_push / push - 1))
                frames = (each.frame(p, 0.066, 44) for each, p in ((second, two), (tip, one)))
                pressure.append(rms_difference(*frames))
    return max(force), max(pressure)


def main() -> None:
    """Compute the presses, fit the model, write the file and print the model's errors."""
    parser = argparse.ArgumentParser(prog="python -m research.solid_tip", description=__doc__)
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument("--rings", type=int, default=64, help="number of elements along the arc")
    parser.add_argument(
        "--sticking", type=int, default=48, help="number of elements along a sticking face"
    )
    parser.add_argument(
        "--coarser", type=int, default=32, help="number of elements for estimating the mesh error"
    )
    parser.add_argument(
        "--held-out", type=int, default=32, help="number of elements for unfitted presses"
    )
    parser.add_argument("--nodes", type=int, default=4, help="number of values of ν")
    parser.add_argument("--tolerance", type=float, default=1.2e-3, help="tolerance of the modes")
    parser.add_argument(
        "--folder", type=Path, required=True, help="folder for the results of presses"
    )
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    nodes = fit.chebyshev_nodes(*fit.NU, arguments.nodes)
    finest = {each: arguments.sticking if STICKING in each else arguments.rings for each in BLOCKS}
    work = [
        *((block, rings, nu) for block in BLOCKS for rings in (arguments.coarser, finest[block])
          for nu in nodes),
        *product(BLOCKS, [arguments.held_out], HELD_OUT),
    ]  # fmt: skip
    with ProcessPoolExecutor(arguments.processes) as pool:
        samples = dict(
            zip(work, pool.map(presses, work, [arguments.folder] * len(work)), strict=True)
        )

    def fitted(block: str, rings: int) -> Arrays:
        part = [samples[block, rings, poisson] for poisson in nodes]
        found = fit.fit(part, nodes, np.pi / 2 / rings, arguments.tolerance)
        bonded, shear = block.startswith("bonded"), []
        for poisson in nodes:
            radius, pressure = shear_response(rings, poisson, bonded)
            shear.append(fit.ring_means(radius) @ pressure)
        found["shear"] = fit.over_nu(np.array(shear)).astype(np.float32)
        return shared | {f"{block}.{name}": value for name, value in found.items()}

    shared = {
        "s_max": np.array(fit.S_MAX),
        "theta_max": np.array(fit.THETA_MAX),
        "nu_range": np.array(fit.NU),
        "ring_edges": RING_EDGES,
    }
    arrays: Arrays = {}
    rows = []
    for block in BLOCKS:
        one, other = (fitted(block, rings) for rings in (finest[block], arguments.coarser))
        arrays |= one
        errors = mesh_errors(one, other, block)
        for name, value in zip(("force_error", "pressure_error"), errors, strict=True):
            arrays[f"{block}.{name}"] = np.array(value)
        for (its, rings, poisson), each in samples.items():
            if its == block:
                told = "" if poisson in nodes else " (not fitted)"
                tip = SolidTip(one if rings == finest[block] else other, block, poisson)
                rows.append(
                    f"{block}, {rings} elements, ν {poisson:.4f}{told}: {differences(tip, each)}"
                )
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]
    print("\n".join(rows))


if __name__ == "__main__":
    main()
