"""The solid tip's data file: limits, identities, and frames of another finite element method."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import softfinger.kinematics.contact as contact
from research.solid_tip.fit import NU, SolidTip, rms_difference

FILE = Path(contact.__file__).parent / "solid_tip.npz"
REFERENCE = Path(__file__).parents[1] / "golden" / "solid_frames.npz"
BASES = ("bonded", "lying", "bonded-sticking", "lying-sticking")
PITCH, CELLS, MM = 58.0 / 44 / 20.0, 44, 1 / 20.0  # in radii


def centroid_and_extent(frame: NDArray[np.float64], pitch: float) -> tuple[float, float, float]:
    """Centroid along x, and extents σ_x and σ_y, of a frame as the sensor sees it."""
    place = (np.arange(len(frame)) - (len(frame) - 1) / 2) * pitch
    total = frame.sum()
    x, y2 = (frame.sum(axis=0) @ place) / total, (frame.sum(axis=1) @ place**2) / total
    return x, np.sqrt((frame.sum(axis=0) @ (place - x) ** 2) / total), np.sqrt(y2)


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    with np.load(FILE) as data:
        return dict(data)


def tips(arrays: dict[str, np.ndarray]) -> list[SolidTip]:
    return [SolidTip(arrays, base, poisson) for base in BASES for poisson in (*NU, 0.49)]


def test_the_push_is_the_energy_s_slope_and_the_base_carries_it(
    arrays: dict[str, np.ndarray],
) -> None:
    areas = np.pi * np.diff(arrays["ring_edges"] ** 2)
    for tip in tips(arrays):
        for d in (0.01, 0.1, 0.39):
            for theta in (0.0, 0.3, -0.6):
                push, _, pressure = tip.press(d, theta)
                step = 1e-5 * d
                slope = (tip.press(d + step, theta)[1] - tip.press(d - step, theta)[1]) / (2 * step)
                assert push == pytest.approx(slope, rel=1e-7)
                if not tip.coef[0].any():  # without friction
                    assert pressure[0] @ areas == pytest.approx(push * np.cos(theta), rel=1e-6)


def test_a_shear_force_turns_the_base_by_its_height(arrays: dict[str, np.ndarray]) -> None:
    levers = np.pi * np.diff(arrays["ring_edges"] ** 3) / 3
    for base in BASES:
        each_nu, *others = arrays[f"{base}.shear"].T @ levers  # Chebyshev's, along ν
        assert each_nu == pytest.approx(0.992, abs=1e-3)  # mean height of the cap it acts on
        assert others == pytest.approx([0.0] * len(others), abs=1e-4)


# Of elements of another kind: triangles and tetrahedra, quadratic displacements with linear
# pressures (Taylor and Hood), and a plane that pushes by a penalty within the faces' points.
# Neo-Hookean, bonded, ν = 0.49, a = 20 mm, E = 0.304 MPa.
TAYLOR_HOOD = [  # d [mm], θ [°], N [N], tolerance
    (0.9985, 0, 2.8482, 3e-3),
    (1.9979, 0, 8.9695, 3e-3),
    (3.9966, 0, 31.512, 3e-3),
    (5.9950, 0, 74.250, 3e-3),
    (7.4931, 0, 127.53, 3e-3),
    (0.9980, 20, 2.842, 0.011),
    (2.9970, 20, 17.857, 0.006),
    (5.9948, 20, 69.644, 0.006),
    (6.9938, 20, 98.387, 0.006),
]


@pytest.mark.parametrize(("d", "tilt", "force", "tolerance"), TAYLOR_HOOD)
def test_forces_of_other_elements(
    arrays: dict[str, np.ndarray], d: float, tilt: float, force: float, tolerance: float
) -> None:
    tip = SolidTip(arrays, "bonded", 0.49)
    push = tip.press(d * MM, np.radians(tilt))[0]
    assert push * 0.304 * 20**2 == pytest.approx(force, rel=tolerance)


@pytest.mark.parametrize("d", [1, 4, 6])
def test_the_extent_hardly_tells_the_depth(arrays: dict[str, np.ndarray], d: float) -> None:
    tip = SolidTip(arrays, "bonded", 0.49)
    pressure = tip.press(d * MM, 0.0)[2]
    _, _, sigma = centroid_and_extent(tip.frame(pressure, PITCH, CELLS), PITCH)
    assert sigma == pytest.approx(9.5 * MM, abs=0.1 * MM)


def test_frames_of_three_dimensional_elements(arrays: dict[str, np.ndarray]) -> None:
    """tests/harness/solid_reference.py: other meshes, and no fit."""
    with np.load(REFERENCE) as data:
        names = ("base", "nu", "d", "theta", "push", "energy", "force", "frame")
        rows = list(zip(*(data[name] for name in names), strict=True))
    areas = np.pi * np.diff(arrays["ring_edges"] ** 2)
    place = (np.arange(CELLS) - (CELLS - 1) / 2) * PITCH
    inner = np.hypot(*np.meshgrid(place, place)) < 0.94  # the rim's stress is singular
    assert {str(row[0]) for row in rows} == set(BASES)
    assert max(row[3] for row in rows) > 0.2
    for base, poisson, d, theta, push, energy, force, frame in rows:
        tip = SolidTip(arrays, str(base), poisson)
        its_push, its_energy, pressure = tip.press(d, theta)
        assert its_push == pytest.approx(push, rel=0.01)
        assert its_energy == pytest.approx(energy, rel=0.01)
        assert pressure[0] @ areas == pytest.approx(force, rel=0.01)
        mine = tip.frame(pressure, PITCH, CELLS)
        # The three-dimensional meshes are coarse, at the rim above all.
        assert rms_difference(mine[inner], frame[inner]) < (0.07 if theta else 0.015)
        moments = centroid_and_extent(mine, PITCH), centroid_and_extent(frame, PITCH)
        np.testing.assert_allclose(*moments, rtol=0, atol=0.1 * MM)
