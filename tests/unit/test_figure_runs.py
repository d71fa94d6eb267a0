"""Test the paths and the estimation errors of the paper's experiments in simulation."""

import math
from functools import reduce

import numpy as np
import pytest

from softfinger.tools.paper import run_pages, sheared_pages
from softfinger.tools.paper.model_pages import DEPTHS, TILTS
from softfinger.tools.paper.sheets import Sheet


@pytest.fixture(scope="module")
def compression() -> tuple[Sheet, ...]:
    return run_pages.compression()


@pytest.fixture(scope="module")
def path() -> tuple[Sheet, ...]:
    return run_pages.tilt_and_roll()


def test_compression_reaches_8_mm_at_every_angle(compression):
    for tilt, run in zip(TILTS, compression[:-1], strict=True):
        assert run["d"][0] == 0.0
        assert run["d"].max() == pytest.approx(8.0, abs=0.1)
        touching = run["d"] > 0.0
        np.testing.assert_allclose(run["theta"][touching], tilt, atol=1e-9)
        # At the times of the frames, the plant's true values equal the closed form.
        expected = np.pi * 0.304 * run["d"] ** 2 / np.cos(np.radians(tilt))
        np.testing.assert_allclose(run["F"], expected, rtol=1e-9, atol=1e-12)


def test_compression_is_estimated_accurately(compression):
    errors = compression[-1]
    assert (errors["d at the first estimate"] < 0.45).all()
    assert (errors["RMS error of d"] < 20.0).all()  # µm
    assert (errors["RMS error of d"] > 1.0).all(), "the sensor has no noise"
    assert (errors["RMS error of theta"] < 0.15).all()
    assert (np.abs(errors["mean error of F"]) < 0.15).all()
    assert (errors["RMS error of F"] < 1.2).all()
    assert (errors["RMS error of U"] < 2.0).all()


def test_the_path_equals_that_of_the_paper(path):
    rotation, rolling, _ = path
    assert rotation["theta"][0] == pytest.approx(0.0, abs=0.1)
    assert rotation["theta"][-1] == pytest.approx(-11.5, abs=0.15)
    assert rotation["d"][-1] == pytest.approx(4.0, abs=0.06)
    for depth in DEPTHS:
        theta = rolling[f"theta at {depth} mm"]
        assert theta[0] == pytest.approx(-11.5, abs=1e-6)
        assert theta[-1] == pytest.approx(9.2, abs=1e-6)
        np.testing.assert_allclose(rolling[f"d at {depth} mm"], depth, rtol=1e-9)


@pytest.fixture(scope="module")
def sheets() -> tuple[Sheet, ...]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sheared_pages, "_SWING_TIME", 2.0)  # s
        sheared_pages.slow_turn.cache_clear()
        found = sheared_pages.slow_turn()
        sheared_pages.slow_turn.cache_clear()
    return found


def test_forces_are_energy_derivatives():
    """Compare the joint torques with finite differences of the energy along rolling motions."""
    here = reduce(sheared_pages.turned, np.radians([2.0, 4.0]), sheared_pages.gripped())
    step = 1e-6
    for k in range(5):
        moved = []
        for sign in (1.0, -1.0):
            x = np.r_[here.pose, here.q]
            x[k] += sign * step
            moved.append(sheared_pages.held(x[3:], x[:3], here).energy())
        slope = (moved[0] - moved[1]) / (2.0 * step)
        expected = 0.0 if k < 3 else here.torques()[k - 3]
        assert slope == pytest.approx(expected, abs=1e-5)


@pytest.mark.extended
def test_the_path_follows_the_valley_floor(sheets):
    equations, _, land = sheets
    for antisymmetric in sheared_pages.ANTISYMMETRIC_ANGLES:
        angle, v = land[f"angle at {antisymmetric} deg"], land[f"V at {antisymmetric} deg"]
        parabola = np.polyfit(angle[15:26], v[15:26], 2)
        assert parabola[0] > 0.1  # mJ/°²
        floor = -0.5 * parabola[1] / parabola[0]
        order = np.argsort(equations["lean"])
        path = np.interp(antisymmetric, equations["lean"][order], equations["angle"][order])
        assert floor == pytest.approx(path, abs=0.05)


@pytest.mark.extended
def test_the_simulated_hand_follows_the_path_of_the_equations(sheets):
    equations, plant, _ = sheets
    order = np.argsort(equations["angle"])
    assert math.degrees(sheared_pages.REACH) - 0.5 < np.max(plant["angle"])
    for name, within in (("lean", 0.01), ("energy of both tips", 0.02), ("shear force", 0.02)):
        there = np.interp(plant["angle"], equations["angle"][order], equations[name][order])
        assert np.abs(plant[name] - there).max() < within, name
