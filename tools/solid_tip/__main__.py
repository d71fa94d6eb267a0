"""``python -m softfinger.tools.solid_tip``: compute the solid tip's data anew (extra ``fem``)."""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.tools.solid_tip import fit
from softfinger.tools.solid_tip.contact import TiltedPlane
from softfinger.tools.solid_tip.evaluate import SolidTip, rms_difference
from softfinger.tools.solid_tip.green import green, shear_response

Arrays = dict[str, NDArray[Any]]

BASES = ("bonded", "lying")
HELD_OUT = (0.458, 0.49, 0.4995)  # values of ν that are not fitted

NOTES = """Hemisphere of linear elastic rubber pressed by a rigid plane without friction, by finite
elements: python -m softfinger.tools.solid_tip, {rings} elements along the arc, {nodes} values of ν.
Lengths in a, stresses in E; d ≤ 0.4 a, θ ≤ 36°, ν 0.45 … 0.4995. s = √(d/a), P a product of
Chebyshev series in 2 s/s_max − 1, 2 (sin θ/sin theta_max)² − 1, and ν on nu_range:
N = 4/(3 (1 − ν²)) s³ (1 + s P[push]), U = 8/(15 (1 − ν²)) s⁵ (1 + s P[energy]), F = N cos θ;
p = N (cos θ B_0(r) + Σ P[coef_k] sin^m_k θ B_k(r) cos m_k φ); basis: means of B_k over rings.
A shear force T on the face adds T B_T(r) cos(φ − φ_T); shear holds B_T's means over the rings
(for a force at the pole), as Chebyshev coefficients in ν.
Base bonded: u = 0. Lying: u_z = 0 (held down: it may pull), free to slide but for a uniform shear
that carries N sin θ. error, force_error, pressure_error: largest differences in N and in a sensor's
frame from a file of a coarser mesh. Largest and rms differences between file and presses:
{errors}"""


def presses(which: tuple[str, int, float], folder: Path) -> fit.Samples:
    """Presses of one base, mesh and ν over the whole domain; kept in ``folder``."""
    base, rings, poisson = which
    file = folder / f"{base}-{rings}-{poisson:.6f}.npz"
    if not file.exists():
        surface = green(rings, poisson, base == "bonded", fit.HARMONICS)
        depths = fit.chebyshev_nodes(0, fit.S_MAX, 24) ** 2
        found = []
        for sine2 in fit.chebyshev_nodes(0, np.sin(fit.THETA_MAX) ** 2, 9):
            plane = TiltedPlane(surface, np.arcsin(np.sqrt(sine2)), fit.D_MAX)
            found += [plane.press(d) for d in depths if d > 0.003]
        np.savez(file, **fit.Samples.of(found, surface.base_radius)._asdict())
    with np.load(file) as data:
        return fit.Samples(**data)


def differences(tip: SolidTip, samples: fit.Samples) -> str:
    """N, U and p of the file against presses, over three ranges of depth."""
    areas = np.sqrt(np.diff(tip.edges**2))
    rows = []
    for d, theta, push, energy, base in zip(*samples, strict=True):
        found = tip.press(d, theta)
        pressure = rms_difference(found[2] * areas, base[: len(found[2])] * areas)
        rows.append((found[0] / push - 1, found[1] / energy - 1, pressure))
    text = []
    for low, high in ((0.0, 0.02), (0.02, 0.05), (0.05, 0.4)):
        part = np.abs(np.array(rows)[(samples.d >= low) & (samples.d < high)])
        pairs = zip("NUp", part.max(axis=0), np.sqrt(np.mean(part**2, axis=0)), strict=True)
        text.append(f"d/a {low}-{high} " + ", ".join(f"{k} {x:.1e} {y:.1e}" for k, x, y in pairs))
    return "; ".join(text)


def mesh_errors(arrays: Arrays, other: Arrays, base: str) -> tuple[float, float]:
    """Largest relative difference of two files in N, and in the frame of a sensor's cells."""
    force, pressure = [], []
    for poisson in (*fit.NU, 0.49):
        tip, second = SolidTip(arrays, base, poisson), SolidTip(other, base, poisson)
        for d in (0.005, 0.025, 0.1, 0.25, fit.D_MAX):
            for theta in (0.0, 0.3, fit.THETA_MAX):
                (push, _, one), (its_push, _, two) = tip.press(d, theta), second.press(d, theta)
                force.append(abs(its_push / push - 1))
                frames = (each.frame(p, 0.066, 44) for each, p in ((second, two), (tip, one)))
                pressure.append(rms_difference(*frames))
    return max(force), max(pressure)


def main() -> None:
    """Compute, fit, write, and print how far the file is from the presses."""
    parser = argparse.ArgumentParser(
        prog="python -m softfinger.tools.solid_tip", description=__doc__
    )
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument("--rings", type=int, default=64, help="elements along the arc")
    parser.add_argument("--coarser", type=int, default=32, help="elements to tell the mesh's error")
    parser.add_argument("--held-out", type=int, default=32, help="elements of presses not fitted")
    parser.add_argument("--nodes", type=int, default=4, help="values of ν")
    parser.add_argument("--tolerance", type=float, default=1.2e-3, help="of the modes")
    parser.add_argument("--folder", type=Path, required=True, help="where presses are kept")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    nodes = fit.chebyshev_nodes(*fit.NU, arguments.nodes)
    work = [
        *product(BASES, sorted({arguments.coarser, arguments.rings}), nodes),
        *product(BASES, [arguments.held_out], HELD_OUT),
    ]
    with ProcessPoolExecutor(arguments.processes) as pool:
        samples = dict(
            zip(work, pool.map(presses, work, [arguments.folder] * len(work)), strict=True)
        )
    shared = {
        "s_max": np.array(fit.S_MAX),
        "theta_max": np.array(fit.THETA_MAX),
        "nu_range": np.array(fit.NU),
        "ring_edges": fit.RING_EDGES,
    }
    files = {}
    for rings in (arguments.coarser, arguments.rings):
        files[rings] = dict(shared)
        for base in BASES:
            part = [samples[base, rings, poisson] for poisson in nodes]
            found = fit.fit(part, nodes, np.pi / 2 / rings, arguments.tolerance)
            shear = []
            for poisson in nodes:
                radius, pressure = shear_response(rings, poisson, base == "bonded")
                shear.append(fit.ring_means(radius) @ pressure)
            found["shear"] = fit.over_nu(np.array(shear)).astype(np.float32)
            files[rings] |= {f"{base}.{name}": value for name, value in found.items()}
    arrays = files[arguments.rings]
    for base in BASES:
        errors = mesh_errors(arrays, files[arguments.coarser], base)
        for name, value in zip(("force_error", "pressure_error"), errors, strict=True):
            arrays[f"{base}.{name}"] = np.array(value)
    arrays["error"] = np.array(max(arrays[f"{base}.force_error"] for base in BASES))
    rows = [
        f"{base}, {rings} elements, ν {poisson:.4f}{'' if poisson in nodes else ' (not fitted)'}: "
        + differences(SolidTip(files[rings], base, poisson), each)
        for (base, rings, poisson), each in samples.items()
    ]
    notes = NOTES.format(rings=arguments.rings, nodes=arguments.nodes, errors="\n".join(rows))
    arrays["notes"] = np.array(notes)
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]
    print(notes)


if __name__ == "__main__":
    main()
