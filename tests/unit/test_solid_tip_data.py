"""Test the data file and the finite elements of solid tips against another method."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import softfinger.kinematics.contact as contact
from research.solid_tip.fit import NU, SolidTip, cell_means, rms_difference
from research.solid_tip.green import Meridian

FILE = Path(contact.__file__).parent / "solid_tip.npz"
REFERENCE = Path(__file__).parents[1] / "golden" / "solid_frames.npz"
BASES = ("bonded", "lying", "bonded-sticking", "lying-sticking")
# Pitch in tip radii, number of cells, and a millimetre in tip radii.
PITCH, CELLS, MM = 58.0 / 44 / 20.0, 44, 1 / 20.0


def centroid_and_extent(frame: NDArray[np.float64], pitch: float) -> tuple[float, float, float]:
    """Return the centroid of a frame along x and its extents σ_x and σ_y."""
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


# Values from a different method, which uses Taylor-Hood triangles and tetrahedra with quadratic
# displacements and linear pressures. A penalty at points within the faces keeps the tip outside the
# plane. The tip is neo-Hookean and bonded, with ν = 0.49, a = 20 mm and E = 0.304 MPa.
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
def test_forces_match_taylor_hood_elements(arrays, d, tilt, force, tolerance):
    tip = SolidTip(arrays, "bonded", 0.49)
    push = tip.press(d * MM, np.radians(tilt))[0]
    assert push * 0.304 * 20**2 == pytest.approx(force, rel=tolerance)


@pytest.mark.parametrize("d", [1, 4, 6])
def test_the_extent_hardly_depends_on_the_depth(arrays, d):
    tip = SolidTip(arrays, "bonded", 0.49)
    pressure = tip.press(d * MM, 0.0)[2]
    _, _, sigma = centroid_and_extent(cell_means(pressure, PITCH, CELLS), PITCH)
    assert sigma == pytest.approx(9.5 * MM, abs=0.1 * MM)


@pytest.mark.extended
def test_frames_match_three_dimensional_elements(arrays):
    """Compare with the frames of tests/harness/solid_reference.py, which uses different meshes."""
    with np.load(REFERENCE) as data:
        names = ("base", "nu", "d", "theta", "push", "energy", "force", "frame")
        rows = list(zip(*(data[name] for name in names), strict=True))
    areas = np.pi * np.diff(arrays["ring_edges"] ** 2)
    place = (np.arange(CELLS) - (CELLS - 1) / 2) * PITCH
    inner = np.hypot(*np.meshgrid(place, place)) < 0.94  # The stress at the rim is singular.
    assert {str(row[0]) for row in rows} == set(BASES)
    assert max(row[3] for row in rows) > 0.2
    for base, poisson, d, theta, push, energy, force, frame in rows:
        tip = SolidTip(arrays, str(base), poisson)
        its_push, its_energy, pressure = tip.press(d, theta)
        assert its_push == pytest.approx(push, rel=0.01)
        assert its_energy == pytest.approx(energy, rel=0.01)
        assert pressure[0] @ areas == pytest.approx(force, rel=0.01)
        mine = cell_means(pressure, PITCH, CELLS)
        # The three-dimensional meshes are coarse, especially at the rim.
        assert rms_difference(mine[inner], frame[inner]) < (0.07 if theta else 0.015)
        moments = centroid_and_extent(mine, PITCH), centroid_and_extent(frame, PITCH)
        np.testing.assert_allclose(*moments, rtol=0, atol=0.1 * MM)


THETA, D = np.radians(20.0), 0.25


@pytest.mark.extended
def test_a_linear_contact_is_at_equilibrium_and_a_sticking_one_is_stiffer():
    from research.solid_tip.contact import TiltedPlane
    from research.solid_tip.fit import RING_EDGES, Samples
    from research.solid_tip.green import green

    surface = green(rings=12, poisson=0.48, bonded=True, base_harmonics=9)
    press = TiltedPlane(surface, THETA, D).press(D)
    plane = TiltedPlane(surface, THETA, D, sticking=True)
    stuck = [plane.press(d) for d in np.linspace(0.2, np.sqrt(D), 8) ** 2][-1]
    bases = Samples.of([press, stuck], surface.base_radius).base
    for each, base in zip((press, stuck), bases, strict=True):
        force = base[0] @ np.diff(RING_EDGES**2) * np.pi
        balance = each.push * np.cos(THETA) - each.shear * np.sin(THETA)
        assert force == pytest.approx(balance, rel=1e-9)
    assert 1.05 < stuck.push / press.push < 1.15
    assert -0.1 < stuck.shear / stuck.push < -0.05


def test_neo_hookean_elements_match_the_data_file():
    pytest.importorskip("pypardiso")
    from research.solid_tip.rubber import MIDDLES, Body

    with np.load(FILE) as data:
        tip = SolidTip(data, "lying", 0.48)
    mesh = Meridian(8, finer=2, widest=0.2)
    softer, press = (
        next(Body(mesh, 0.48, False, None, linear=linear).press([D])) for linear in (True, False)
    )
    push, energy, pressure = tip.press(D, 0.0)
    assert press.energy == pytest.approx(energy, rel=0.01)
    assert press.push == pytest.approx(push, rel=0.02)
    assert press.push > 1.07 * softer.push
    near = MIDDLES < 0.9
    assert rms_difference(press.base[0, near], pressure[0, near]) < 0.03
    spread = MIDDLES > 1.0
    assert press.base[0, spread].any()
    assert not softer.base[0, spread].any()
