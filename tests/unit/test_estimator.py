"""Test that the contact estimator reaches the Cramér-Rao bound and reports a correct covariance."""

import math
import re
import tracemalloc

import numpy as np
import pytest

from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimate, ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import (
    GRID,
    LINEAR,
    MEASURED,
    NOISE,
    PITCH,
    TIP,
    E,
    dense,
    errors,
    fisher,
    tilts,
)


@pytest.mark.parametrize("material", [LINEAR, MEASURED], ids=["constant", "table_i"])
@pytest.mark.parametrize("free_gain", [True, False])
def test_without_noise_the_bias_is_far_below_the_noise_level(material, free_gain):
    # The azimuth and the position of the tip are random. The noise level is 0.2 % of the modulus.
    rng = np.random.default_rng(7)
    noise = 0.002 * material.reference_modulus
    for _ in range(30):
        grid = SensorGrid(44, 44, PITCH, centre=tuple(rng.uniform(-0.5, 0.5, 2) * PITCH))
        d = 10 ** rng.uniform(math.log10(5e-4), math.log10(8e-3))
        truth = (d, *tilts(rng.uniform(0.0, math.radians(30)), rng.uniform(0, 7)), 1.0)
        estimator = ContactEstimator(TIP, material, grid, noise, free_gain=free_gain)
        estimator.state.options.tolerance = 1e-6
        e = estimator(grid.pressure(TIP, material, *truth[:3]))
        assert e.valid
        n = 4 if free_gain else 3
        sigma = np.sqrt(np.diag(e.covariance))[:n]
        # With other random seeds, the maximum ratio is 0.34.
        assert np.all(np.abs(errors(e, truth)[:n]) < 0.4 * sigma)
        assert abs(e.d - d) < 2e-3 * d


@pytest.mark.parametrize("free_gain", [True, False])
@pytest.mark.parametrize(
    ("d", "degrees", "share"), [(0.008, 25.0, 0.35), (0.008, 30.0, 1.0), (0.008, 33.5, 5.0)]
)
def test_the_bias_is_small_where_the_footprint_nearly_reaches_the_rim(d, degrees, share, free_gain):
    # Each outermost cell measures the mean of 1/√(a² − x² − y²), which is singular at the rim.
    rng = np.random.default_rng(1)
    noise = 0.002 * E
    for _ in range(12):
        grid = SensorGrid(44, 44, PITCH, centre=tuple(rng.uniform(-0.5, 0.5, 2) * PITCH))
        truth = (d, *tilts(math.radians(degrees), rng.uniform(0, 7)), 1.0)
        sigma = np.sqrt(np.diag(fisher(grid, LINEAR, truth, noise, free_gain)))
        estimator = ContactEstimator(TIP, LINEAR, grid, noise, free_gain=free_gain)
        estimator.state.options.tolerance = 1e-6
        e = estimator(grid.pressure(TIP, LINEAR, *truth[:3]))
        assert e.valid
        assert np.all(np.abs(errors(e, truth)[: len(sigma)]) < share * sigma)


@pytest.mark.parametrize("free_gain", [True, False])
@pytest.mark.parametrize(
    ("material", "d", "degrees", "azimuth", "percent", "blur"),
    [
        (LINEAR, 0.0005, 0.0, 0.0, 0.1, 0.0),
        (LINEAR, 0.001, 20.0, 1.0, 0.2, 0.0),
        (LINEAR, 0.004, 30.0, 2.0, 0.2, 0.0),
        (LINEAR, 0.008, 10.0, -2.0, 2.0, 0.0),
        (MEASURED, 0.002, 15.0, 0.5, 0.5, 0.0),
        (MEASURED, 0.006, 30.0, -1.0, 0.2, 0.0),
        (LINEAR, 0.001, 20.0, 0.8, 0.2, 0.0006),
        (MEASURED, 0.002, 10.0, 0.8, 0.2, 0.0004),
        (MEASURED, 0.006, 25.0, 0.8, 0.2, 0.0016),
    ],
)
def test_errors_reach_the_cramer_rao_bound(material, d, degrees, azimuth, percent, blur, free_gain):
    grid = SensorGrid(44, 44, PITCH, centre=(2e-4, -5e-4), blur=blur)
    noise = percent / 100 * material.reference_modulus
    truth = (d, *tilts(math.radians(degrees), azimuth), 1.0)
    bound = fisher(grid, material, truth, noise, free_gain)
    clean = grid.pressure(TIP, material, *truth[:3])
    if blur:  # Use a forward model that is independent of the estimator.
        clean = dense(grid, material, truth[:3])
    estimator = ContactEstimator(TIP, material, grid, noise, free_gain=free_gain)
    rng = np.random.default_rng(3)
    n = 4 if free_gain else 3
    frames = 800
    miss = np.empty((frames, n))
    nees = np.empty(frames)
    for k in range(frames):
        e = estimator.update(clean + rng.normal(0.0, noise, grid.shape))
        assert e.contact
        assert e.valid
        miss[k] = errors(e, truth)[:n]
        nees[k] = miss[k] @ np.linalg.solve(e.covariance[:n, :n], miss[k])
    ratio = np.sqrt((miss**2).mean(axis=0) / np.diag(bound))
    # With 800 frames, the ratio has a standard deviation of 2.5 %. The limit of 1.12 allows 4.5
    # standard deviations.
    assert np.all(ratio < 1.12), ratio
    assert np.all(ratio > 0.85), ratio
    # The tolerance is four standard deviations of the mean, plus a quarter of a frame's standard
    # deviation for the bias.
    assert np.all(
        np.abs(miss.mean(axis=0)) < (4.0 / math.sqrt(frames) + 0.25) * np.sqrt(np.diag(bound))
    )
    # The tolerance is a model error of 5 % plus four standard deviations of χ² with 800 n degrees
    # of freedom.
    assert abs(nees.mean() / n - 1.0) < 4.0 * math.sqrt(2.0 / (frames * n)) + 0.05
    # The reported covariance equals the Cramér-Rao bound.
    np.testing.assert_allclose(
        np.sqrt(np.diag(e.covariance))[:n], np.sqrt(np.diag(bound)), rtol=0.12
    )


@pytest.mark.parametrize("material", [LINEAR, MEASURED], ids=["constant", "table_i"])
@pytest.mark.parametrize("cells", [32, 16])
@pytest.mark.parametrize(("d", "degrees"), [(0.001, 20.0), (0.006, 25.0), (0.008, 10.0)])
def test_errors_on_coarser_grids_are_near_the_cramer_rao_bound(material, cells, d, degrees):
    grid = SensorGrid(cells, cells, 44 * PITCH / cells, centre=(2e-4, -5e-4))
    noise = 0.002 * material.reference_modulus
    truth = (d, *tilts(math.radians(degrees), 0.8), 1.0)
    sigma = np.sqrt(np.diag(fisher(grid, material, truth, noise, True)))
    clean = grid.pressure(TIP, material, *truth[:3])
    estimator = ContactEstimator(TIP, material, grid, noise)
    rng = np.random.default_rng(3)
    frames = 400
    squares, nees = np.zeros(4), 0.0
    for _ in range(frames):
        found = estimator.update(clean + rng.normal(0.0, noise, grid.shape))
        assert found.valid
        miss = errors(found, truth)
        squares += miss**2 / frames
        nees += miss @ np.linalg.solve(found.covariance, miss) / (4.0 * frames)
    assert np.all(np.sqrt(squares) < 1.2 * sigma), np.sqrt(squares) / sigma
    assert 0.8 < nees < 1.3
    estimator.state.options.tolerance = 1e-6
    bias = errors(estimator(clean), truth)
    assert np.all(np.abs(bias) < 0.25 * sigma), bias / sigma


def test_a_rotated_oblong_sensor_gives_estimates_in_finger_axes():
    grid = SensorGrid(30, 50, (0.0012, 0.0017), centre=(0.001, -0.002), rotation=0.7)
    truth = (0.003, 0.25, -0.15, 1.0)
    clean = grid.pressure(TIP, LINEAR, *truth[:3])
    e = ContactEstimator(TIP, LINEAR, grid, 600.0)(clean)
    np.testing.assert_allclose(errors(e, truth), 0.0, atol=2e-4)
    bound = fisher(grid, LINEAR, truth, 600.0, True)
    scale = np.sqrt(np.diag(bound))
    np.testing.assert_allclose(
        e.covariance / np.outer(scale, scale), bound / np.outer(scale, scale), atol=0.02
    )


def test_gain_is_the_ratio_of_measured_to_modelled_pressure():
    p = GRID.pressure(TIP, LINEAR, 0.003, 0.2, gain=0.6)
    e = ContactEstimator(TIP, LINEAR, GRID, NOISE)(p)
    assert e.gain == pytest.approx(0.6, rel=1e-4)
    assert e.d == pytest.approx(0.003, rel=1e-4)
    softer = Material.constant(0.6 * LINEAR.reference_modulus)
    known = ContactEstimator(TIP, softer, GRID, NOISE, free_gain=False)(p)
    assert known.gain == 1.0
    assert known.d == pytest.approx(0.003, rel=1e-4)
    assert known.d_std < e.d_std
    assert np.all(known.covariance[3] == 0.0)


def test_warm_and_cold_starts_agree_within_the_noise():
    rng = np.random.default_rng(11)
    estimator = ContactEstimator(TIP, MEASURED, GRID, 700.0)
    truth = None
    for k in range(60):
        d = 0.004 + 0.003 * math.sin(0.5 * k)
        truth = (d, 0.3 * math.sin(0.3 * k), 0.2 * math.cos(0.2 * k), 1.0)
        frame = GRID.pressure(TIP, MEASURED, *truth[:3]) + rng.normal(0.0, 700.0, GRID.shape)
        warm = estimator.update(frame)
        assert warm.valid
        sigma = np.sqrt(np.diag(warm.covariance))
        cold = estimator(frame)
        apart = errors(warm, (cold.d, cold.tilt_x, cold.tilt_y, cold.gain))
        assert np.all(np.abs(apart) < 0.6 * sigma)
        assert np.all(np.abs(errors(warm, truth)) < 6.0 * sigma)


def test_a_jump_of_the_contact_is_followed_immediately():
    estimator = ContactEstimator(TIP, MEASURED, GRID, 300.0, free_gain=False)
    for truth in [
        (0.008, 0.5, 0.0),
        (0.0006, -0.5, 0.3),
        (0.006, 0.2, -0.4),
        (0.001, 0.0, 0.5),
        (0.008, -0.3, -0.3),
    ]:
        e = estimator.update(GRID.pressure(TIP, MEASURED, *truth))
        assert e.valid
        assert e.d == pytest.approx(truth[0], rel=2e-3)
        assert (e.tilt_x, e.tilt_y) == pytest.approx(truth[1:], abs=2e-3)


def test_update_reuses_one_result_and_skips_a_repeated_frame():
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    first = estimator.update(GRID.pressure(TIP, LINEAR, 0.003), seq=4)
    assert isinstance(first, ContactEstimate)
    d = first.d
    again = estimator.update(GRID.pressure(TIP, LINEAR, 0.005), seq=4)
    assert again is first
    assert again.d == d
    newer = estimator.update(GRID.pressure(TIP, LINEAR, 0.005), seq=5)
    assert newer is first
    assert newer.d == pytest.approx(0.005, rel=1e-4)
    # Calling the estimator directly neither uses nor changes the state of `update`.
    covariance = newer.covariance.copy()
    alone = estimator(GRID.pressure(TIP, LINEAR, 0.002))
    assert alone.d == pytest.approx(0.002, rel=1e-4)
    assert newer.d == pytest.approx(0.005, rel=1e-4)
    np.testing.assert_array_equal(newer.covariance, covariance)
    estimator.reset()
    assert estimator.update(GRID.pressure(TIP, LINEAR, 0.002), seq=5).d == alone.d


def test_the_frame_path_allocates_almost_nothing():
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    counts = np.round(GRID.pressure(TIP, LINEAR, 0.004, 0.2) / 4.0).astype(np.uint16)
    for _ in range(3):
        estimator.update(counts, 4.0)
    kept, used = [], []
    tracemalloc.start()
    try:
        # Threads of the test runner may also allocate memory, so use the least of several rounds.
        for _ in range(5):
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            for _ in range(50):
                estimator.update(counts, 4.0)
            now, peak = tracemalloc.get_traced_memory()
            kept.append(now - before)
            used.append(peak - before)
    finally:
        tracemalloc.stop()
    assert min(kept) < 1024
    assert min(used) < 8192  # A frame takes 15 kB.


def test_all_frame_types_and_layouts_give_the_same_estimate():
    scale = 500.0
    counts = np.round(GRID.pressure(TIP, LINEAR, 0.004, 0.2, 0.1) / scale)
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    reference = estimator(counts.astype(np.uint16), scale)
    frozen = counts.astype(np.uint8)
    frozen.flags.writeable = False
    wide = np.zeros((44, 88), np.uint16)
    wide[:, ::2] = counts
    for frame in (
        counts.astype(np.uint8),
        frozen,
        np.asfortranarray(counts.astype(np.uint16)),
        wide[:, ::2],
    ):
        # The machine code for each frame type may add numbers in a different order.
        assert estimator(frame, scale).d == pytest.approx(reference.d, abs=1e-3 * reference.d_std)
    # Frames of floats may contain negative values and have no quantum, so the estimates differ
    # slightly.
    for kind in (np.float32, np.float64):
        e = estimator(counts.astype(kind), scale)
        assert e.d == pytest.approx(reference.d, rel=1e-4)
        assert e.d_std < reference.d_std


def test_quantisation_increases_the_covariance():
    clean = GRID.pressure(TIP, LINEAR, 0.004, 0.2)
    estimator = ContactEstimator(TIP, LINEAR, GRID, 100.0)
    fine = estimator(np.round(clean / 4.0).astype(np.uint16), 4.0)
    coarse = estimator(np.round(clean / 1000.0).astype(np.uint8), 1000.0)
    expected = math.sqrt((100.0**2 + 1000.0**2 / 12) / (100.0**2 + 4.0**2 / 12))
    assert coarse.d_std / fine.d_std == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("free_gain", [True, False])
def test_counts_clipped_at_zero_cause_no_bias(free_gain):
    # The sensor clips the negative half of the noise, so weak cells at the outline read too high.
    noise = 1520.0
    rng = np.random.default_rng(9)
    estimator = ContactEstimator(TIP, MEASURED, GRID, noise, free_gain=free_gain)
    truth = (0.002, 0.2, -0.1, 1.0)
    clean = GRID.pressure(TIP, MEASURED, *truth[:3])
    score = []
    for _ in range(800):
        noisy = np.clip(np.round((clean + rng.normal(0.0, noise, GRID.shape)) / 4.0), 0, 65535)
        e = estimator.update(noisy.astype(np.uint16), 4.0)
        assert e.valid
        score.append(errors(e, truth)[:3] / np.sqrt(np.diag(e.covariance))[:3])
    assert np.all(np.abs(np.mean(score, axis=0)) < 4.0 / math.sqrt(800))
    assert np.all(np.sqrt(np.mean(np.square(score), axis=0)) < 1.12)


@pytest.mark.extended
def test_a_light_touch_is_detected_and_noise_is_not():
    rng = np.random.default_rng(8)
    missed = 0
    for k in range(1500):
        if k % 30 == 0:
            grid = SensorGrid(44, 44, PITCH, centre=tuple(rng.uniform(-0.5, 0.5, 2) * PITCH))
            estimator = ContactEstimator(TIP, LINEAR, grid, NOISE)
            at = tilts(rng.uniform(0.0, 0.5), rng.uniform(0, 7))
            clean = grid.pressure(TIP, LINEAR, 0.0002, *at)
        missed += not estimator(clean + rng.normal(0.0, NOISE, grid.shape)).contact
    assert missed <= 3
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    alarms = 0
    buffer = np.empty(GRID.shape)
    for _ in range(8_000):
        rng.standard_normal(out=buffer)
        buffer *= NOISE
        e = estimator.update(buffer)
        alarms += e.contact
        assert e.contact or (e.valid and e.d == 0.0 and e.tilt_x == 0.0)
    assert alarms == 0


def test_a_footprint_cut_off_by_the_sensor_edge_is_estimated():
    grid = SensorGrid(44, 44, PITCH, centre=(0.021, 0.0))
    rng = np.random.default_rng(5)
    truth = (0.004, 0.35, 0.1, 1.0)
    clean = grid.pressure(TIP, LINEAR, *truth[:3])
    assert clean[:, -1].max() > 0.05 * clean.max()
    estimator = ContactEstimator(TIP, LINEAR, grid, NOISE)
    whole = ContactEstimator(TIP, LINEAR, GRID, NOISE)(GRID.pressure(TIP, LINEAR, *truth[:3]))
    for _ in range(20):
        e = estimator(clean + rng.normal(0.0, NOISE, grid.shape))
        assert e.valid
        sigma = np.sqrt(np.diag(e.covariance))
        assert np.all(np.abs(errors(e, truth)) < 4.5 * sigma)
        assert e.d_std > 1.5 * whole.d_std


@pytest.mark.parametrize("degrees", [36.0, 40.0, 50.0])
def test_the_tilt_is_estimated_at_and_beyond_the_limit(degrees):
    # At d = 8 mm, the limit of the tilt is 36.87°. The estimator must also report larger tilts
    # correctly.
    estimator = ContactEstimator(TIP, MEASURED, GRID, 300.0, free_gain=False)
    e = estimator(GRID.pressure(TIP, MEASURED, 0.008, math.radians(degrees)))
    assert e.valid
    assert math.degrees(e.tilt_x) == pytest.approx(degrees, abs=0.4)
    assert e.d == pytest.approx(0.008, rel=0.01)


def test_a_wrong_model_increases_chi2_and_the_covariance():
    p = GRID.pressure(TIP, MEASURED, 0.005, 0.2)
    right = ContactEstimator(TIP, MEASURED, GRID, 50.0)(p)
    wrong = ContactEstimator(TIP, LINEAR, GRID, 50.0)(p)
    assert right.chi2 < 0.01
    assert wrong.chi2 > 2.0
    twice = ContactEstimator(TIP, Material.constant(2 * E), GRID, 200.0, free_gain=False)(p)
    assert twice.chi2 > 50.0
    ideal = ContactEstimator(TIP, Material.constant(2 * E), GRID, 200.0, free_gain=False)(
        GRID.pressure(TIP, Material.constant(2 * E), twice.d, twice.tilt_x, twice.tilt_y)
    )
    assert twice.d_std > 5.0 * ideal.d_std


def test_an_estimate_says_what_it_found():
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    assert repr(estimator) == f"ContactEstimator: 44 × 44 cells, noise {NOISE:g} Pa, free gain"
    pressed = repr(estimator(GRID.pressure(TIP, LINEAR, 0.004, 0.2, 0.0)))
    told = (
        r"ContactEstimate: d 4\.000 ± 0\.\d{3} mm, tilts 11\.46 ± 0\.\d\d°, 0\.00 ± .*, gain 1\.00"
    )
    assert re.fullmatch(told, pressed)
    air = repr(estimator(np.zeros(GRID.shape)))
    assert re.fullmatch(r"ContactEstimate: no contact deeper than 0\.\d+ mm", air)
    assert repr(estimator(np.full(GRID.shape, math.nan))).endswith(
        "not valid: readings are not finite"
    )
    assert repr(ContactEstimate()) == "ContactEstimate: not valid: no frame has arrived yet"
