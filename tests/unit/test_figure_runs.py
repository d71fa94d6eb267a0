"""The paper's experiments run in simulation: paths, and errors of what is estimated from frames."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.tools.paper import run_pages
from softfinger.tools.paper.model_pages import DEPTHS, TILTS
from softfinger.tools.paper.sheets import Sheet


@pytest.fixture(scope="module")
def compression() -> tuple[Sheet, ...]:
    return run_pages.compression()


@pytest.fixture(scope="module")
def path() -> tuple[Sheet, ...]:
    return run_pages.tilt_and_roll()


def test_compression_goes_to_8_mm_at_every_angle(compression: tuple[Sheet, ...]) -> None:
    for tilt, run in zip(TILTS, compression, strict=False):
        assert run["d"][0] == 0.0
        assert run["d"].max() == pytest.approx(8.0, abs=0.1)
        touching = run["d"] > 0.0
        np.testing.assert_allclose(run["theta"][touching], tilt, atol=1e-9)
        # The truth is the plant's: at the frames' instants it is the closed form's.
        expected = np.pi * 0.304 * run["d"] ** 2 / np.cos(np.radians(tilt))
        np.testing.assert_allclose(run["F"], expected, rtol=1e-9, atol=1e-12)


def test_compression_is_estimated(compression: tuple[Sheet, ...]) -> None:
    errors = compression[-1]
    assert (errors["d at the first estimate"] < 0.45).all()
    assert (errors["RMS error of d"] < 20.0).all()  # µm
    assert (errors["RMS error of d"] > 1.0).all(), "a sensor without noise was asked"
    assert (errors["RMS error of theta"] < 0.15).all()
    assert (np.abs(errors["mean error of F"]) < 0.15).all()
    assert (errors["RMS error of F"] < 1.2).all()
    assert (errors["RMS error of U"] < 2.0).all()


def test_the_path_is_the_papers(path: tuple[Sheet, ...]) -> None:
    rotation, rolling, _ = path
    assert rotation["theta"][0] == pytest.approx(0.0, abs=0.1)
    assert rotation["theta"][-1] == pytest.approx(-11.5, abs=0.15)
    assert rotation["d"][-1] == pytest.approx(4.0, abs=0.06)
    for depth in DEPTHS:
        theta = rolling[f"theta at {depth} mm"]
        assert theta[0] == pytest.approx(-11.5, abs=1e-6)
        assert theta[-1] == pytest.approx(9.2, abs=1e-6)
        np.testing.assert_allclose(rolling[f"d at {depth} mm"], depth, rtol=1e-9)


def test_force_and_energy_are_least_at_0_degrees(path: tuple[Sheet, ...]) -> None:
    _, rolling, least = path
    for depth in DEPTHS:
        for symbol in "FU":
            at = np.argmin(rolling[f"{symbol} at {depth} mm"])
            assert abs(rolling[f"theta at {depth} mm"][at]) < 0.2
    for symbol in "FU":
        # As far as noise lets the estimates say; ten seeds scatter by about these errors.
        found, error = (
            least[f"angle of the least {symbol} estimated"],
            least[f"its standard error, {symbol}"],
        )
        assert (np.abs(found) < 3.0 * error).all()
        np.testing.assert_allclose(error, (0.45, 0.14, 0.07, 0.05), rtol=0.35)
    assert (least["RMS error of theta"] < 0.15).all()
    assert (least["RMS error of F"] < 1.2).all()


def test_the_rotation_is_estimated_by_the_daemon(path: tuple[Sheet, ...]) -> None:
    rotation = path[0]
    deep = rotation["d"] > 1.0
    assert deep.sum() > 50
    off = rotation["theta estimated"][deep] - rotation["theta"][deep]
    assert np.sqrt(np.mean(off**2)) < 0.15
    np.testing.assert_allclose(rotation["F estimated"][deep], rotation["F"][deep], rtol=0.06)
