"""Compute frames of a solid tip with finite elements, for tests/golden/solid_frames.npz.

``python -m tests.harness.solid_reference OUT`` uses neo-Hookean elements. The program's meshes
differ from the meshes to which the data file was fitted. The program does not use the fit's
polynomials, modes or linear material law. The program requires pypardiso.
"""

import argparse
from pathlib import Path

import numpy as np

from research.solid_tip.fit import cell_means
from research.solid_tip.green import RING_EDGES, Meridian
from research.solid_tip.rubber import Body, Strained

POISSON, RADIUS, PITCH, CELLS = 0.49, 20.0, 58.0 / 44, 44  # mm
AREAS = np.pi * np.diff(RING_EDGES**2)
BLOCKS = ("bonded", "lying", "bonded-sticking", "lying-sticking")
# block, tilt [°], mesh and number of slices of each tilted contact
COARSE = Meridian(9, 2, 0.2)
TILTED = (
    ("bonded", 15.0, Meridian(9, 8, 0.2), 8),  # mesh that is refined at the rim
    ("bonded", 20.0, COARSE, 10),
    ("lying", 15.0, COARSE, 9),
)
UPRIGHT = Meridian(20, 6, 0.1)
KEPT = (1, 2, 4, 6, 7)


def row(block: str, theta: float, press: Strained) -> dict[str, object]:
    """Return one row of the data file, with lengths in tip radii and stresses in units of E."""
    force = press.push * np.cos(theta) - press.shear * np.sin(theta)
    pressure = press.base * (force / (press.base[0] @ AREAS))
    frame = cell_means(pressure, PITCH / RADIUS, CELLS)
    known = {"base": block, "nu": POISSON, "d": press.d, "theta": theta, "push": press.push}
    return known | {"energy": press.energy, "force": force, "frame": frame.astype(np.float32)}


def main() -> None:
    """Compute the contacts and write the data file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    rows = []
    presses = [(block, None, UPRIGHT, 1) for block in BLOCKS]
    presses += [(block, np.radians(tilt), mesh, slices) for block, tilt, mesh, slices in TILTED]
    for block, theta, mesh, slices in presses:
        base, _, face = block.partition("-")
        body = Body(mesh, POISSON, base == "bonded", theta, slices, sticking=bool(face))
        found = list(body.press(np.arange(1, 8) / RADIUS))
        rows += [row(block, theta or 0.0, found[d - 1]) for d in KEPT]
        print(block, theta, [each.push for each in found], flush=True)
    np.savez_compressed(
        arguments.out, **{name: np.array([each[name] for each in rows]) for name in rows[0]}
    )


if __name__ == "__main__":
    main()
