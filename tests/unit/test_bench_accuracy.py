"""`bench accuracy` in a short form: its figures against each other and plain computation."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.tools import bench
from softfinger.tools.benchmarks import (
    accuracy,
    accuracy_detection,
    accuracy_envelope,
    accuracy_trials,
)
from softfinger.tools.benchmarks.accuracy_detection import EIGHT_BITS, SIXTEEN_BITS
from softfinger.tools.benchmarks.accuracy_flaws import FlawRow
from softfinger.tools.benchmarks.accuracy_mismatch import MismatchRow, mismatches
from softfinger.tools.benchmarks.accuracy_trials import FLOAT, Board, Place
from softfinger.tools.benchmarks.estimator_bounds import LINEAR, SIZE, TIP

SHORT = accuracy.Effort(
    envelope=accuracy_envelope.Effort(
        around=2,
        frames=200,
        again=1,
        again_frames=2000,
        depths=(0.001, 0.006),
        degrees=(0.0, 30.0),
        noises=(608.0, 3040.0),
    ),
    faint_around=1,
    faint_frames=200,
    faint_again=500,
    noise_frames=4000,
    samples=200,
    other_frames=20,
    other_noises=(608.0,),
    flaw_frames=10,
)


@pytest.fixture(scope="module")
def rows():
    return accuracy.measure(SHORT)


def of(kind, rows):
    return [row for row in rows if isinstance(row, kind)]


def test_errors_are_at_the_bound_and_the_covariance_is_honest(rows):
    envelope = of(accuracy_envelope.EnvelopeRow, rows)
    assert {row.name.split(",")[0] for row in envelope} == {"gain free", "gain known"}
    for row in envelope:
        # 2000 frames: 1.6 % of scatter, and the largest of a few.
        assert 0.9 < row.d_worst < row.aim
        assert 0.9 < row.tilt_worst < row.aim
        if "small" in row.name:
            assert row.lost == row.misfits == row.seldom == 0
            assert row.nees == pytest.approx(1.0, abs=0.15)
    assert sum("dead" in row.name for row in envelope) >= 2


def test_faint_contacts_are_seen_and_others_models_show(rows):
    for row in of(accuracy_detection.DetectionRow, rows):
        assert row.seen > 0.995
    found = {(row.name, row.d, row.theta): row for row in of(MismatchRow, rows)}
    for name in ("radial springs", "Hertz"):
        assert found[(name, 0.004, 0.0)].misfits == 1.0
        assert found[(name, 0.004, 0.0)].d_error < -5e-4
    assert found[("Table I's law", 0.002, 0.0)].misfits == 0.0


def test_flaws_are_told_with_what_they_do(rows):
    found = {(r.name, r.d, r.free): r for r in of(FlawRow, rows)}
    for d in (0.002, 0.004):
        clean = found[("none", d, True)]
        assert abs(clean.d_error) < 4 * clean.told
        assert clean.misfits == 0.0
        # Unloading reads more pressure: a gain if that is free, else a deeper contact.
        unloading = found[("hysteresis 10 %, unloading", d, True)]
        assert 1.01 < unloading.gain < 1.25
        assert found[("hysteresis 10 %, unloading", d, False)].d_error > 0.02 * d
        # A blur widens the footprint.
        assert found[("blur 1 mm", d, True)].d_error > 4 * clean.told


def test_sampled_alarms_are_as_computed(rows):
    for row in of(accuracy_detection.AlarmRow, rows):
        if row.frames and row.expected * row.frames > 5.0:
            # The expected number of alarming cells is above that of frames, by not much.
            assert row.sampled < row.expected * (1.0 + 4.0 / math.sqrt(row.expected * row.frames))
            assert row.upper > 0.8 * row.expected


def test_it_prints_and_writes_every_row(rows, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(accuracy, "measure", lambda: rows)
    file = tmp_path / "rows.json"
    parser = __import__("argparse").ArgumentParser()
    bench.add_arguments(parser)
    assert bench.run(parser.parse_args(["accuracy", "--json", str(file)])) == 0
    text = capsys.readouterr().out
    assert all(row.name in text for row in rows)
    written = json.loads(file.read_text())["rows"]
    assert len(written) == len(rows)
    assert {row["measurement"] for row in written} == {"accuracy"}
    assert "accuracy" not in bench.MEASUREMENTS


def test_places_fill_the_circle_and_the_cell():
    found = list(accuracy_trials.places((0.001, 0.002), (0.0, 10.0), 16))
    assert len(found) == 64
    for k in range(0, 64, 16):
        steps = np.diff(np.sort([each.azimuth for each in found[k : k + 16]]))
        np.testing.assert_allclose(steps, 2 * math.pi / 16, rtol=1e-9)
    offsets = np.array([each.offset for each in found])
    counts, _, _ = np.histogram2d(*offsets.T, bins=4, range=[[-0.5, 0.5]] * 2)
    assert counts.min() >= 2
    assert np.abs(offsets).max() <= 0.5


def test_the_bound_is_the_known_one_and_grows_by_the_cells_left_out():
    # Published figures of this model: 44 × 44 cells on 58 mm, 0.2 % of E.
    place = Place(0.002, 0.0, 0.0, (0.0, 0.0))
    slopes = accuracy_trials.jacobian(place)
    for free, sigma in ((True, 7.2e-6), (False, 3.3e-6)):
        found = math.sqrt(accuracy_trials.bound(slopes, 608.0, free)[0, 0])
        assert found == pytest.approx(sigma, rel=0.03)
    live = np.ones((SIZE, SIZE), bool)
    live[:, : SIZE // 2] = False  # half of the footprint
    half = accuracy_trials.bound(slopes, 608.0, False, live)[0, 0]
    whole = accuracy_trials.bound(slopes, 608.0, False)[0, 0]
    assert half > 2.0 * whole  # the tilt is told from d less well, too


@pytest.mark.parametrize("board", [FLOAT, SIXTEEN_BITS, EIGHT_BITS])
def test_a_trials_frames_are_what_such_a_board_would_send(board):
    place = Place(0.003, 0.3, 1.0, (0.2, -0.3))
    clean = place.grid.pressure(TIP, LINEAR, *place.truth[:3])
    bank = np.random.default_rng(0).standard_normal((5, SIZE, SIZE))
    out = accuracy_trials.run(
        accuracy_trials.estimator(place, 900.0, True, board), clean, 900.0, bank, board
    )
    twin = accuracy_trials.estimator(place, 900.0, True, board)
    for k in range(5):
        frame = clean + 900.0 * bank[k]
        if board.pascal_per_count:
            frame = np.clip(np.floor(frame / board.pascal_per_count + 0.5), 0, board.full_count)
            frame[frame < board.threshold] = 0
            frame = frame.astype(np.uint16)
        e = twin.update(frame, board.pascal_per_count or 1.0)
        expected = (e.d, e.tilt_x, e.tilt_y, e.gain, e.contact, e.valid, e.chi2, e.cells)
        np.testing.assert_allclose(out[k, :8], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(out[k, 8:], e.covariance.ravel(), rtol=1e-9, atol=1e-18)


def test_the_misfit_limit_is_the_chi_squared_quantile():
    # P(χ²_ν > x) by its finite sum for even ν, at the limit for ν = cells − 4.
    for freedom in (10, 40, 200):
        cells = np.array([freedom + 4.0])
        low, high = 1.0, 10.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            flagged = accuracy_envelope.is_misfit(np.array([middle]), cells)[0]
            assert flagged == ContactEstimate(chi2=middle, cells=freedom + 4).misfit
            low, high = (low, middle) if flagged else (middle, high)
        half = 0.5 * high * freedom
        term = total = math.exp(-half)
        for k in range(1, freedom // 2):
            term *= half / k
            total += term
        assert total == pytest.approx(2.9e-7, rel=0.5)


@pytest.mark.parametrize("board", [SIXTEEN_BITS, EIGHT_BITS, Board(500.0, 255, 0)])
def test_the_neighbours_distribution_is_that_of_the_sum(board):
    noise = 1520.0 / board.pascal_per_count
    one = accuracy_detection.count_distribution(noise, board)
    assert one.sum() == pytest.approx(1.0, abs=1e-12)
    total = accuracy_detection.neighbours_distribution(one)
    assert total.sum() == pytest.approx(1.0, abs=1e-9)
    weights = accuracy_detection._WEIGHTS[accuracy_detection._WEIGHTS > 0]
    k, m = np.arange(len(one)), np.arange(len(total))
    mean, square = one @ k, one @ k**2
    assert total @ m == pytest.approx(weights.sum() * mean, rel=1e-6)
    assert total @ (m - total @ m) ** 2 == pytest.approx(
        (weights**2).sum() * (square - mean**2), rel=1e-6
    )
    # Its tail, against counts drawn as the board makes them.
    rng = np.random.default_rng(4)
    counts = np.clip(np.floor(noise * rng.standard_normal((100_000, 24)) + 0.5), 0, 255e9)
    counts[counts < board.threshold] = 0
    sums = counts @ np.sort(weights)
    level = int(np.quantile(sums, 0.99))
    assert total[level + 1 :].sum() == pytest.approx(np.mean(sums > level), rel=0.1)


def test_importance_sampling_counts_each_frame_once():
    # At a low level frames often have several alarming cells, and sampling them is easy.
    frames = 20_000
    plain = accuracy_detection.sampled((2.5,), frames, 608.0)[0] / frames
    weighed = accuracy_detection.importance(800, 2.5)
    expected = accuracy_detection.expected_alarms(608.0, FLOAT, 2.5)
    assert weighed < expected
    assert plain == pytest.approx(weighed, abs=4.0 * math.sqrt(weighed / frames) + 0.02 * weighed)


@pytest.mark.parametrize("count", [0, 1, 5, 40])
def test_the_upper_bound_is_the_poisson_one(count):
    mean = accuracy_detection.upper_bound(count, 1000) * 1000
    tail = sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(count + 1))
    assert tail == pytest.approx(0.05, abs=0.004)


def test_a_mismatch_is_told_with_how_sure_the_fit_was():
    row = next(r for r in mismatches(20, (608.0,)) if r.name == "Hertz" and r.d == 0.004)
    assert abs(row.d_error) > 10 * row.told
    assert row.invalid == 0.0
