"""Test the estimator's kernels against plain NumPy, also with clipped counts and misfits."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import index, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.estimation import detection, gauss_newton
from softfinger.kinematics.estimation.estimator import ContactEstimator, Readings, cell_centres
from softfinger.kinematics.estimation.gauss_newton import CLIP_BELOW, free_noise
from softfinger.kinematics.estimation.state import GAIN, Cells, EstimatorState, new_cells
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import LINEAR, PITCH, TIP, E

FloatArray = NDArray[np.float64]


@kernel
def activity(states: Records[EstimatorState], frame: FloatArray, height: FloatArray) -> None:
    """Wrap :func:`detection.activity`."""
    detection.activity(states[0], frame, height)


@kernel
def compare(states: Records[EstimatorState], frame: FloatArray, cells: Cells) -> None:
    """Apply :func:`gauss_newton.compare` to all cells."""
    gauss_newton.compare(states[0], frame, cells, index(0), index(frame.shape[0]))


def test_activity_matches_plain_numpy():
    rng = np.random.default_rng(12)
    weights = np.outer([1, 2, 2, 2, 1], [1, 2, 2, 2, 1]).astype(float)
    weights[2, 2] = 0.0
    # Only the cells in columns 2 to 21 and rows 2 to 17 can contain a contact.
    active = np.zeros((20, 24), bool)
    active[2:18, 2:22] = True
    state = EstimatorState()
    grid = state.grid
    grid.radius, grid.pitch_x, grid.pitch_y, grid.rows, grid.cols = 1.0, 0.01, 0.01, 20, 24
    state.signal.patch_level, state.signal.noise, state.signal.scale = 4.0, 1.0, 1.0
    height, _, _ = cell_centres(grid, active, 2.0)
    state.signal.number = int((height >= 0.0).sum())
    assert state.signal.number == active.sum()
    seen = set()
    for k in range(200):
        frame = rng.normal(0.0, 1.0, (20, 24))
        i, j = rng.integers(4, 16), rng.integers(4, 20)
        frame[i - 1 : i + 2, j - 1 : j + 2] += 0.02 * k
        expected = False
        for r, c in np.argwhere(active & (frame > 3.0)):
            part = np.s_[r - 2 : r + 3, c - 2 : c + 3]
            w = weights * active[part]
            expected |= (w * frame[part]).sum() / math.sqrt((w**2).sum()) > 4.0
        frame[0, 5], frame[3, 0] = math.nan, 1e9
        activity(state.array, frame.ravel(), height)
        found = state.signal
        assert found.contact == expected
        assert found.is_finite
        inner = frame[active]
        assert found.mean == pytest.approx(inner.mean())
        assert found.energy == pytest.approx((inner**2).sum())
        assert found.peak == inner.max()
        if found.peak > 3.0:
            assert frame.flat[found.cell] == found.peak
        seen.add(expected)
    assert seen == {True, False}


free_noise = kernel(free_noise.py_func)

erfc = np.vectorize(math.erfc)


def mean_of(model, floor, noise):
    """Return E[max(model + noise · e, floor)] for e ~ N(0, 1), and its derivative."""
    z = (model - floor) / noise
    above = 0.5 * erfc(-z / math.sqrt(2.0))
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return floor + (model - floor) * above + noise * density, above


@pytest.mark.parametrize("floor", [0.0, 2000.0, 3250.0])
def test_cells_near_the_floor_are_compared_with_their_expected_reading(floor):
    noise = 1500.0
    state = EstimatorState()
    state.signal.scale, state.signal.saturation, state.signal.floor = 1.0, math.inf, floor
    state.fit.clip_noise, state.fit.contact[GAIN] = noise, 1.0
    cells = new_cells(1, 1)
    for model in np.linspace(max(floor - 1.9 * noise, 20.0), floor + 6.0 * noise, 9):
        cells.sensitivity[GAIN] = model
        compare(state.array, np.array([3300.0]), cells)
        mean, response = mean_of(np.array(model), floor, noise)
        residual = 3300.0 - mean
        misfit = pytest.approx(residual**2, abs=2 * abs(residual) * 1e-3 * noise)
        assert state.fit.misfit == misfit
        assert cells.factor[0] == pytest.approx(float(response), abs=5e-3)
        assert state.fit.counted_cells == 1.0
    below = floor - (CLIP_BELOW + 0.1) * noise
    if below > 0.0:
        cells.sensitivity[GAIN] = below
        compare(state.array, np.array([3300.0]), cells)
        assert state.fit.counted_cells == 0.0


@pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0, 2.0, 2.8])
def test_noise_is_estimated_from_cells_without_contact(ratio):
    noise = 900.0
    floor = ratio * noise
    readings = noise * np.random.default_rng(1).standard_normal(2_000_000)
    readings[readings < floor] = 0.0
    assert free_noise(float(np.mean(readings**2)), floor) == pytest.approx(noise, rel=0.03)
    # If all readings are zero, the noise is far below the floor.
    assert free_noise(0.0, floor) == pytest.approx(floor / 3.2, rel=0.02)


@pytest.mark.parametrize("free_gain", [True, False])
@pytest.mark.parametrize(("d", "percent"), [(0.001, 0.1), (0.001, 0.5), (0.002, 1.0), (0.004, 2.0)])
def test_a_threshold_of_three_8_bit_counts_leaves_d_unbiased(d, percent, free_gain):
    # The full scale is 204 kPa. The maximum pressure of the envelope is 188 kPa.
    scale, noise = 800.0, percent / 100.0 * E
    rng = np.random.default_rng(9)
    frames, ratios, deviations = 60, [], []
    for k in range(6):
        grid = SensorGrid(44, 44, PITCH, tuple(rng.uniform(-0.5, 0.5, 2) * PITCH))
        estimator = ContactEstimator(
            TIP, LINEAR, grid, noise, free_gain=free_gain, readings=Readings(255.0, 3)
        )
        clean = grid.pressure(TIP, LINEAR, d, 0.1 * k, 0.05 * k)
        for _ in range(frames):
            counts = np.clip(np.round((clean + rng.normal(0.0, noise, grid.shape)) / scale), 0, 255)
            counts[counts < 3] = 0
            e = estimator.update(counts.astype(np.uint8), scale)
            assert e.valid
            ratios.append(e.d / d - 1.0)
            deviations.append(e.d_std / d)
    scatter = 4.0 * float(np.mean(deviations)) / math.sqrt(len(ratios))
    assert abs(np.mean(ratios)) < 0.003 + scatter
    assert np.std(ratios) < 1.3 * np.mean(deviations)


def test_a_board_without_noise_is_not_corrected_for_clipping():
    grid = SensorGrid(44, 44, PITCH)
    estimator = ContactEstimator(TIP, LINEAR, grid, 1500.0, readings=Readings(threshold=3))
    for d in (0.001, 0.003):
        counts = np.round(grid.pressure(TIP, LINEAR, d, 0.1, 0.2) / 500.0)
        counts[counts < 3] = 0
        assert estimator(counts.astype(np.uint8), 500.0).d == pytest.approx(d, rel=0.015)


def test_noise_clipped_at_zero_raises_the_contact_threshold():
    # One strong cell, with neighbours whose weighted readings sum to 5.1 standard deviations
    frame = np.zeros((44, 44))
    weights = np.outer((1, 2, 2, 2, 1), (1, 2, 2, 2, 1)).astype(float)
    weights[2, 2] = 0.0
    root = math.sqrt((weights**2).sum())
    grid = SensorGrid(44, 44, PITCH)
    for height, floats, counts in ((5.3, True, False), (5.6, True, True), (4.7, False, False)):
        frame[20:25, 18:23] = height * root / weights.sum()
        frame[22, 20] = 3.5
        for scale, kind, expected in ((1.0, np.float64, floats), (0.001, np.uint16, counts)):
            estimator = ContactEstimator(TIP, LINEAR, grid, 1.0)
            assert estimator((frame / scale).astype(kind), scale).contact == expected


def test_the_covariance_grows_if_d_and_gain_are_hardly_distinguishable():
    grid = SensorGrid(44, 44, PITCH, (2e-4, 3e-4))
    rng = np.random.default_rng(2)
    truth = np.array([0.0006, 0.1, -0.1, 1.0])
    clean = grid.pressure(TIP, LINEAR, *truth[:3])
    noise = 0.01 * E
    estimator = ContactEstimator(TIP, LINEAR, grid, noise)
    nees = []
    for _ in range(1500):
        e = estimator.update(clean + rng.normal(0.0, noise, grid.shape))
        if e.contact and e.valid:
            error = np.array([e.d, e.tilt_x, e.tilt_y, e.gain]) - truth
            nees.append(error @ np.linalg.solve(e.covariance, error))
    assert len(nees) > 1450
    assert np.mean(nees) / 4.0 == pytest.approx(1.0, abs=0.08)


def test_a_misfit_is_flagged_and_valid_frames_are_not():
    grid = SensorGrid(44, 44, PITCH, (3e-4, -2e-4))
    rng = np.random.default_rng(5)
    noise = 0.002 * E
    x = (np.arange(44) - 21.5) * PITCH
    # Hertz pressure with the same force; its footprint is r² ≤ a d instead of r² ≤ 2 a d − d².
    r2 = (x[None, :] - 3e-4) ** 2 + (x[:, None] + 2e-4) ** 2
    hertz = np.sqrt(np.maximum(1.0 - r2 / (0.020 * 0.003), 0.0))
    good = grid.pressure(TIP, LINEAR, 0.003)
    hertz *= good.sum() / hertz.sum()
    estimator = ContactEstimator(TIP, LINEAR, grid, noise)
    for clean, expected in ((good, False), (hertz, True)):
        for _ in range(100):
            frame = clean + rng.normal(0.0, noise, grid.shape)
            e = estimator.update(frame)
            assert e.contact
            assert e.misfit is expected
            # The Hertz pressure causes an error of 38 % in d, but unequal cell gains cause less
            # than 5 %.
            assert e.valid is not expected
    unequal = good * rng.normal(1.0, 0.1, grid.shape)
    e = estimator(unequal)
    assert e.misfit
    assert e.valid
    assert abs(e.d / 0.003 - 1.0) < 0.05
    counts = np.clip(np.round((good + rng.normal(0.0, noise, grid.shape)) / 800.0), 0, 255)
    assert not estimator(counts.astype(np.uint8), 800.0).misfit
    assert not estimator(np.zeros(grid.shape)).misfit
