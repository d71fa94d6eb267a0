"""`bench estimator` and the campaign of its accuracy: figures against plain computation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.daemon.simulation.sensor.sensor_model import Board
from softfinger.tools.benchmarks import estimator, estimator_rivals
from softfinger.tools.benchmarks.campaigns import (
    accuracy,
    accuracy_detection,
    accuracy_envelope,
    accuracy_models,
    accuracy_trials,
)
from softfinger.tools.benchmarks.campaigns.accuracy_trials import (
    EIGHT_BITS,
    LINEAR,
    PITCH,
    SIXTEEN_BITS,
    SIZE,
    TIP,
    Place,
)
from softfinger.tools.benchmarks.estimator import D_ERROR


def test_errors_of_each_method_stand_beside_the_bound() -> None:
    (table,) = estimator.measure(brief=True, rounds=2)
    rows = {row["name"]: row for row in table.rows}
    limit = rows["Cramér-Rao bound, gain free"][D_ERROR]
    for way in ("warm, kernel", "cold, kernel", "warm, call"):
        assert 0.6 * limit < rows[f"ml, gain free: {way}"][D_ERROR] < 1.6 * limit
    assert rows["NumPy moments over a threshold"][D_ERROR] > 3 * limit
    assert rows["ml, gain free: warm, kernel"]["aim ≤"] == 15.0
    here = ("moments", "ml", "no contact", "decode", "NumPy", "SciPy")
    for name in estimator.PAGE[table.title]:
        assert not name.startswith(here) or any(row.startswith(name) for row in rows), name


def test_packages_that_are_missing_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ImportError

    monkeypatch.setattr(estimator_rivals, "_opencv", refuse)
    found, missing = estimator_rivals.rivals(TIP, LINEAR, estimator.GRID, 600.0)
    assert "opencv-python-headless" in missing
    assert "OpenCV moments" not in found


def test_the_same_model_by_least_squares_is_at_the_bound() -> None:
    place = Place(0.003, 0.1, 0.7)
    found, _ = estimator_rivals.rivals(TIP, LINEAR, place.grid, 600.0)
    frame = place.grid.pressure(TIP, LINEAR, *place.truth[:3])
    frame += 600.0 * np.random.default_rng(0).standard_normal(frame.shape)
    off = np.array(found["scipy least_squares, the same model"](frame)) - place.truth[:3]
    bound = accuracy_trials.bound(accuracy_trials.jacobian(place), 600.0, True)
    assert np.all(np.abs(off) < 4 * np.sqrt(np.diag(bound))[:3])


# The campaign


def test_errors_are_at_the_bound_and_the_covariance_is_honest() -> None:
    sweep = accuracy_envelope.Sweep(1, 200, 1, 1000, (0.001, 0.006), (0.0, 30.0), (608.0,))
    errors, honesty = accuracy_envelope.against_the_bound(sweep)
    assert sum("1 % dead" in row["name"] for row in errors.rows) >= 2
    for row in errors.rows:
        # 1000 frames: 2.2 % of scatter, and the largest of a few.
        assert 0.9 < row["d worst"] < row["aim ≤"]
        assert 0.9 < row["tilt worst"] < row["aim ≤"]
    for row in honesty.rows:
        if "small" in row["name"]:
            assert row["misfits"] == row["seldom seen"] == 0
            assert row["mean"] == pytest.approx(1.0, abs=0.15)


def test_other_models_and_flaws_show_in_bias_and_misfit() -> None:
    (other,) = accuracy_models.mismatches(10, (608.0,))
    found = {(row["name"], row["d mm"], row["θ °"]): row for row in other.rows}
    assert found[("Hertz", 4.0, 0.0)]["not valid %"] == 100.0
    radial = found[("radial springs", 4.0, 0.0)]
    assert radial["flagged %"] == 100.0
    # The covariance has what the misfit may hide.
    assert -4.0 * radial["± mm"] < radial["d off mm"] < -0.5
    assert found[("Table I's law", 2.0, 0.0)]["flagged %"] == 0.0
    (table,) = accuracy_models.flaws(4)
    flawed = {(r["name"], r["gain is"]): r for r in table.rows if r["d mm"] == 2.0}
    # Unloading reads more pressure: a gain if that is free, else a deeper contact.
    assert 1.01 < flawed[("hysteresis 10 %, unloading", "free")]["gain"] < 1.25
    assert flawed[("hysteresis 10 %, unloading", "known")]["d off mm"] > 0.04
    clean = flawed[("none", "free")]
    assert abs(clean["d off mm"]) < 4 * clean["± mm"] < flawed[("blur 1 mm", "free")]["d off mm"]


def test_frames_of_the_other_models_have_their_forces() -> None:
    a, d = 0.020, 0.004
    grid = Place(d, 0.0).grid
    frame = accuracy_models.projected(accuracy_models.radial)(grid, d, 0.0)
    # N = πE d² of radial springs, here with E = 1.
    assert frame.sum() * PITCH**2 == pytest.approx(math.pi * d * d, rel=2e-3)
    tilted = accuracy_models.projected(accuracy_models.hertz)(grid, d, 0.3)
    x = (np.arange(44) - 21.5) * PITCH
    assert tilted.sum(axis=0) @ x / tilted.sum() == pytest.approx((a - d) * math.sin(0.3), rel=1e-3)


def test_places_fill_the_circle_and_the_cell() -> None:
    found = list(accuracy_trials.places((0.001, 0.002), (0.0, 10.0), 16))
    for k in range(0, 64, 16):
        steps = np.diff(np.sort([each.azimuth for each in found[k : k + 16]]))
        np.testing.assert_allclose(steps, 2 * math.pi / 16, rtol=1e-9)
    offsets = np.array([each.offset for each in found])
    counts, _, _ = np.histogram2d(*offsets.T, bins=4, range=[[-0.5, 0.5]] * 2)
    assert counts.min() >= 2
    assert np.abs(offsets).max() <= 0.5


def test_the_bound_is_the_known_one_and_grows_by_the_cells_left_out() -> None:
    # Published figures of this model: 44 × 44 cells on 58 mm, 0.2 % of E.
    slopes = accuracy_trials.jacobian(Place(0.002, 0.0))
    for free, sigma in ((True, 7.2e-6), (False, 3.3e-6)):
        found = math.sqrt(accuracy_trials.bound(slopes, 608.0, free)[0, 0])
        assert found == pytest.approx(sigma, rel=0.03)
    live = np.ones((SIZE, SIZE), bool)
    live[:, : SIZE // 2] = False  # half of the footprint
    half = accuracy_trials.bound(slopes, 608.0, False, live)[0, 0]
    assert half > 2.0 * accuracy_trials.bound(slopes, 608.0, False)[0, 0]


@pytest.mark.parametrize("board", [None, SIXTEEN_BITS, EIGHT_BITS])
def test_a_trials_frames_are_what_such_a_board_would_send(board: Board | None) -> None:
    place = Place(0.003, 0.3, 1.0, (0.2, -0.3))
    clean = place.grid.pressure(TIP, LINEAR, *place.truth[:3])
    bank = np.random.default_rng(0).standard_normal((5, SIZE, SIZE))
    made, twin = (accuracy_trials.estimator(place, 900.0, True, board) for _ in range(2))
    out = accuracy_trials.run(made, clean, 900.0, bank, board)
    for k in range(5):
        frame = clean + 900.0 * bank[k]
        if board is not None:
            frame = np.clip(np.floor(frame / board.pascal_per_count + 0.5), 0, board.full_count)
            frame[frame < board.threshold] = 0
            frame = frame.astype(np.uint16)
        e = twin.update(frame, 1.0 if board is None else board.pascal_per_count)
        np.testing.assert_allclose(out[k, :4], (e.d, e.tilt_x, e.tilt_y, e.gain), rtol=1e-9)
        assert accuracy_trials.is_misfit(np.array([e.chi2]), np.array([e.cells])) == e.misfit
        np.testing.assert_allclose(out[k, 8:], e.covariance.ravel(), rtol=1e-9, atol=1e-18)


def test_the_misfit_limit_is_the_chi_squared_quantile() -> None:
    # P(χ²_ν > x) by its finite sum for even ν, at the limit for ν = cells − 4.
    for freedom in (10, 40, 200):
        cells = np.array([freedom + 4.0])
        low, high = 1.0, 10.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            flagged = accuracy_trials.is_misfit(np.array([middle]), cells)[0]
            low, high = (low, middle) if flagged else (middle, high)
        half = 0.5 * high * freedom
        term = total = math.exp(-half)
        for k in range(1, freedom // 2):
            term *= half / k
            total += term
        assert total == pytest.approx(2.9e-7, rel=0.5)


@pytest.mark.parametrize("board", [SIXTEEN_BITS, EIGHT_BITS, Board(500.0, 255, 0)])
def test_the_neighbours_distribution_is_that_of_the_sum(board: Board) -> None:
    noise = 1520.0 / board.pascal_per_count
    one = accuracy_detection.count_distribution(noise, board)
    assert one.sum() == pytest.approx(1.0, abs=1e-12)
    total = accuracy_detection.neighbours_distribution(one)
    weights = accuracy_detection._WEIGHTS[accuracy_detection._WEIGHTS > 0]
    k, m = np.arange(len(one)), np.arange(len(total))
    mean, square = one @ k, one @ k**2
    assert total @ m == pytest.approx(weights.sum() * mean, rel=1e-6)
    assert total @ (m - total @ m) ** 2 == pytest.approx(
        (weights**2).sum() * (square - mean**2), rel=1e-6
    )


def test_alarms_are_as_computed_and_faint_contacts_seen() -> None:
    # At a low level, where sampling is easy; frames with several alarming cells count once.
    frames = 4000
    expected = accuracy_detection.expected_alarms(608.0, patch_level=2.5) * frames
    counted = accuracy_detection.sampled((2.5,), frames, 608.0)[0]
    assert expected - 5.0 * math.sqrt(expected) < counted < expected + 4.0 * math.sqrt(expected)
    (table,) = accuracy_detection.detection(1, 100, 100)
    assert all(row["seen"] > 0.98 and row["95 % above"] < row["seen"] for row in table.rows)


def test_parts_are_chosen_by_name() -> None:
    assert accuracy.known("models")
    assert not accuracy.known("modles")
