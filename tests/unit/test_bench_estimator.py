"""`bench estimator`: the rows it has, and the figures in them that must hold on any machine."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.tools.benchmarks import estimator, estimator_bounds, estimator_rivals


@pytest.fixture(scope="module")
def rows():
    return estimator.measure(estimator.Effort(rounds=3, frames=40, slow=False))


def test_each_rung_each_step_and_the_bound_have_rows(rows):
    times = {row.name: row for row in rows if isinstance(row, estimator.TimeRow)}
    for rung in ("moments", "ml, gain free", "ml, gain known"):
        assert {f"{rung}, warm: kernel", f"{rung}, cold: kernel"} <= set(times)
    assert times["ml, gain free, warm: kernel"].aim_us == 15.0
    for skip_on, skip_off in (
        ("no contact, activity test: kernel", "no contact, fitted all the same: kernel"),
        ("frame already seen: call", "ml, gain free, warm: call"),
        ("ml, gain free, warm: kernel", "ml, gain free, warm, no early stop: kernel"),
        (
            "moments' sums over the rows of the footprint's box: kernel",
            "moments' sums over the rows of the tip's disc: kernel",
        ),
        ("no contact, activity test: kernel", "no contact, the whole grid looked at: kernel"),
        ("ml, gain free, warm: kernel", "ml, gain free, blur 1 mm, warm: kernel"),
    ):
        assert {skip_on, skip_off} <= set(times)
    assert times["moments at (8 mm, 30°), warm: kernel"].d_rms < 8e-6
    assert times["ml, gain free, blur 1 mm, warm: kernel"].d_rms < 1e-5
    limit = times["the bound, gain free"].d_rms
    assert 0.6 * limit < times["ml, gain free, warm: call"].d_rms < 1.6 * limit
    assert times["NumPy moments over a threshold"].d_rms > 3 * limit
    skipped = times["no contact, activity test: kernel"].median_us
    assert skipped < times["no contact, fitted all the same: kernel"].median_us
    text = estimator.table(rows)
    assert all(row.name in text for row in rows)
    assert all(isinstance(row.as_dict()["name"], str) for row in rows)


def test_other_models_are_told_with_their_bias(rows):
    found = {
        (row.name, row.d): row for row in rows if isinstance(row, estimator_bounds.MismatchRow)
    }
    assert found["Hertz", 0.002].d_error < -2e-4
    assert abs(found["Table I's law", 0.002].d_error) < 1e-5


def test_frames_of_the_other_models_have_their_forces():
    a, d = 0.020, 0.004
    grid = estimator.GRID.__class__(44, 44, estimator_bounds.PITCH)
    frame = estimator_bounds._projected(grid, estimator_bounds._radial, d, 0.0)
    # N = πE d² of radial springs, here with E = 1.
    assert frame.sum() * estimator_bounds.PITCH**2 == pytest.approx(math.pi * d * d, rel=2e-3)
    tilted = estimator_bounds._projected(grid, estimator_bounds._hertz, d, 0.3)
    x = (np.arange(44) - 21.5) * estimator_bounds.PITCH
    assert tilted.sum(axis=0) @ x / tilted.sum() == pytest.approx((a - d) * math.sin(0.3), rel=1e-3)


def test_packages_that_are_missing_are_named(monkeypatch):
    def refuse(*_):
        raise ImportError

    monkeypatch.setattr(estimator_rivals, "_opencv", refuse)
    found, missing = estimator_rivals.rivals(
        estimator_bounds.TIP, estimator_bounds.LINEAR, estimator.GRID, 600.0
    )
    assert "opencv-python-headless" in missing
    assert "OpenCV moments" not in found


def test_the_same_model_by_least_squares_is_at_the_bound():
    rng = np.random.default_rng(0)
    truth = (0.003, 0.1, -0.05)
    found, _ = estimator_rivals.rivals(
        estimator_bounds.TIP, estimator_bounds.LINEAR, estimator.GRID, 600.0
    )
    frame = estimator.GRID.pressure(estimator_bounds.TIP, estimator_bounds.LINEAR, *truth)
    frame += 600.0 * rng.standard_normal(frame.shape)
    d, x, y = found["scipy least_squares, the same model"](frame)
    sigma = np.sqrt(
        np.diag(estimator_bounds.bound(estimator.GRID, estimator_bounds.LINEAR, truth, 600.0, True))
    )
    assert np.all(np.abs(np.array([d, x, y]) - truth) < 4 * sigma[:3])
