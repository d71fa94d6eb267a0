"""Test that invalid frames and arguments cause a flagged estimate or a clear error."""

import math

import numpy as np
import pytest

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimator, Readings
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import GRID, LINEAR, MEASURED, NOISE, PITCH, TIP, A, errors


def test_saturated_cells_are_excluded():
    rng = np.random.default_rng(4)
    clean = GRID.pressure(TIP, LINEAR, 0.006, 0.1)
    noisy = clean + rng.normal(0.0, NOISE, GRID.shape)
    full = 0.75 * clean.max()
    plain = ContactEstimator(TIP, LINEAR, GRID, NOISE)(noisy)
    aware = ContactEstimator(TIP, LINEAR, GRID, NOISE, readings=Readings(full))
    aware = aware(np.minimum(noisy, full))
    assert aware.valid
    assert abs(aware.d - 0.006) < 4.0 * aware.d_std
    assert aware.d_std > plain.d_std
    assert aware.cells < plain.cells
    # For an 8-bit board, the data type of the frame determines the full scale.
    counts = np.minimum(np.round(clean / 300.0), 255).astype(np.uint8)
    assert counts.max() == 255
    board = ContactEstimator(TIP, LINEAR, GRID, 100.0)(counts, 300.0)
    assert board.d == pytest.approx(0.006, rel=2e-3)


def test_dead_cells_are_masked_regardless_of_their_readings():
    rng = np.random.default_rng(6)
    active = rng.random(GRID.shape) > 0.01
    truth = (0.003, 0.2, -0.2, 1.0)
    clean = GRID.pressure(TIP, LINEAR, *truth[:3])
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE, active=active)
    score = []
    for _ in range(300):
        frame = clean + rng.normal(0.0, NOISE, GRID.shape)
        frame[~active] = rng.choice([np.nan, np.inf, -np.inf, 1e9, 0.0], (~active).sum())
        e = estimator.update(frame)
        assert e.valid
        score.append(errors(e, truth) / np.sqrt(np.diag(e.covariance)))
    # With 300 frames, the ratio is 1 ± 0.04.
    assert np.all(np.sqrt(np.mean(np.square(score), axis=0)) < 1.2)


EMPTY = np.zeros((44, 44))


@pytest.mark.parametrize("physics", ["springs", "solid"])
@pytest.mark.parametrize("baseline", [0.0, 1000.0])
def test_without_contact_d_std_is_the_smallest_detectable_d(physics, baseline):
    tip, material = Fingertip(A, physics), Material.constant(0.3e6)
    known = Uncertainty(baseline=baseline)
    estimator = ContactEstimator(tip, material, GRID, 600.0, known=known)
    hidden = estimator(EMPTY).d_std
    assert 1e-4 < hidden < 6e-4
    rng = np.random.default_rng(4)
    for fraction, least, most in ((0.6, 0.0, 0.1), (1.5, 0.9, 1.0)):
        frame = GRID.pressure(tip, material, fraction * hidden, 0.05)
        felt = [estimator(frame + rng.normal(0.0, 600.0, (44, 44))).contact for _ in range(50)]
        assert least <= np.mean(felt) <= most


@pytest.fixture(params=[True, False], ids=["free gain", "known gain"])
def estimator(request):
    return ContactEstimator(TIP, MEASURED, GRID, 600.0, free_gain=request.param)


def test_an_all_zero_frame_is_valid_without_contact(estimator):
    for kind in (np.uint8, np.uint16, np.float32, np.float64):
        e = estimator(EMPTY.astype(kind))
        assert (e.contact, e.valid, e.d) == (False, True, 0.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_one_nan_cell_makes_a_frame_invalid(estimator, bad):
    for frame in (EMPTY.copy(), GRID.pressure(TIP, MEASURED, 0.003, 0.1)):
        frame[22, 20] = bad
        e = estimator.update(frame)
        assert not e.valid
        assert not e.contact
        assert (e.d, e.tilt_x) == (0.0, 0.0)
    # An invalid frame has no effect on the next frame.
    assert estimator.update(GRID.pressure(TIP, MEASURED, 0.003, 0.1)).valid


def test_nan_outside_the_tip_is_ignored(estimator):
    frame = GRID.pressure(TIP, MEASURED, 0.003, 0.1)
    frame[0, 0] = math.nan
    assert estimator(frame).valid


def test_a_saturated_frame_is_invalid(estimator):
    for frame, scale in (
        (np.full((44, 44), 65535, np.uint16), 4.0),
        (np.full((44, 44), 255, np.uint8), 500.0),
        (np.full((44, 44), 1e5), 1.0),
    ):
        e = estimator(frame, scale)
        assert e.contact
        assert e.invalid == (Invalid.SATURATED if frame.dtype != float else Invalid.ABOVE_ZERO)


def test_a_sensor_without_a_tare_is_identified(estimator):
    rng = np.random.default_rng(8)
    for _ in range(20):
        zero = 20e3 + 3e3 * rng.standard_normal((44, 44))
        e = estimator(zero + rng.normal(0.0, 600.0, (44, 44)))
        assert (e.valid, e.invalid) == (False, Invalid.ABOVE_ZERO)


def test_a_baseline_far_below_zero_is_invalid(estimator):
    assert estimator(EMPTY - 5000.0).invalid == Invalid.BELOW_ZERO
    assert not estimator(-GRID.pressure(TIP, MEASURED, 0.004) - 2000.0).valid


@pytest.mark.parametrize("clipped", [False, True], ids=["floats", "counts above 0"])
@pytest.mark.parametrize("times", [1.0, 1.5, 2.0, 2.6, 4.0])
def test_more_noise_than_set_is_not_mistaken_for_no_contact(estimator, times, clipped):
    rng = np.random.default_rng(7)
    for _ in range(20):
        frame = rng.normal(0.0, times * 600.0 / 4.0, (44, 44))
        if clipped:
            frame = np.maximum(np.round(frame), 0.0).astype(np.uint16)
        e = estimator(frame, 4.0)
        if times < 2.0:
            assert (e.contact, e.valid) == (False, True)
        else:
            assert e.contact
            assert e.invalid in (Invalid.MODEL_MISMATCH, Invalid.NOT_CONVERGED)


def test_one_hot_cell_is_not_a_contact(estimator):
    rng = np.random.default_rng(1)
    frame = rng.normal(0.0, 600.0, (44, 44))
    frame[25, 20] = 1e5
    e = estimator(frame)
    assert (e.contact, e.d, e.rejected_count) == (False, 0.0, 1)


def test_one_hot_cell_near_or_in_a_contact_has_no_effect(estimator):
    rng = np.random.default_rng(2)
    for d in (0.001, 0.004):
        clean = GRID.pressure(TIP, MEASURED, d, 0.2, 0.1)
        clean += rng.normal(0.0, 600.0, (44, 44))
        without = estimator(clean)
        for cell in ((12, 30), (24, 24)):
            frame = clean.copy()
            frame[cell] = 1.2e5
            e = estimator(frame)
            assert e.valid
            assert e.rejected_count == 1
            assert abs(e.d - without.d) < 1.5 * without.d_std


@pytest.mark.parametrize(
    ("frame", "scale", "told"),
    [
        *((np.zeros(shape), 1.0, r"shape \(44, 44\)") for shape in ((44, 43), (44, 44, 1), 44)),
        *((EMPTY.astype(kind), 1.0, "uint8, uint16, float32 or float64")
          for kind in (np.int32, bool, np.complex128, ">u2", object)),
        (EMPTY.tolist(), 1.0, "list"),
        *((EMPTY, scale, "pascal_per_count") for scale in (0.0, -4.0, math.nan, math.inf)),
    ],
)  # fmt: skip
def test_arrays_that_are_not_frames_are_refused(frame, scale, told):
    with pytest.raises(ValueError, match=told):
        ContactEstimator(TIP, MEASURED, GRID, 600.0).update(frame, scale)


def test_anything_but_one_contact_is_invalid(estimator):
    rng = np.random.default_rng(3)
    press = [GRID.pressure(TIP, MEASURED, 0.002, side * 0.5) for side in (1.0, -1.0)]
    small = GRID.pressure(TIP, MEASURED, 0.001, -0.5)
    large = GRID.pressure(TIP, MEASURED, 0.003, 0.4)
    for frame in (
        press[0] + press[1],
        large + small,
        rng.uniform(0.0, 1e5, (44, 44)),
        1e4 * (np.indices((44, 44)).sum(axis=0) % 2),
        np.tile(np.linspace(0.0, 1e5, 44), (44, 1)),
        EMPTY + 5000.0,
    ):
        e = estimator(frame)
        assert e.contact
        assert not e.valid
    assert estimator(large + small).has_second_contact
    assert not estimator(large).has_second_contact


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": 0.0}, "noise"),
        ({"noise": math.nan}, "noise"),
        ({"active": np.ones((4, 4), bool)}, "active"),
    ],
)
def test_invalid_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ContactEstimator(TIP, LINEAR, GRID, **{"noise": 600.0, **options})
    # A frame of a single line is nearly equal for tilts of opposite sign across the line.
    for rows, cols in ((1, 30), (30, 1)):
        with pytest.raises(ValueError, match=f"two rows and two columns.*{rows} × {cols}"):
            ContactEstimator(TIP, LINEAR, SensorGrid(rows, cols, PITCH), 600.0)
    with pytest.raises(ValueError, match="threshold"):
        Readings(threshold=-1.0)
    with pytest.raises(ValueError, match="saturation"):
        Readings(saturation=0.0)


def _garbage(rng, grid):
    kind = rng.integers(8)
    shape = grid.shape
    size = 10.0 ** rng.uniform(-3, 8)
    if kind == 0:
        return rng.normal(0.0, size, shape)
    if kind == 1:
        return rng.integers(0, 256, shape).astype(np.uint8)
    if kind == 2:
        return rng.integers(0, 65536, shape).astype(np.uint16)
    if kind == 3:
        return np.where(rng.random(shape) < 0.05, size, 0.0)
    if kind == 4:
        at = rng.uniform(0.0, 0.0199), rng.uniform(-0.9, 0.9), rng.uniform(-0.6, 0.6)
        p = grid.pressure(TIP, MEASURED, *at, gain=10.0 ** rng.uniform(-2, 2))
        return p + rng.normal(0.0, 600.0, shape)
    if kind == 5:
        return rng.standard_cauchy(shape) * size
    if kind == 6:
        return np.frombuffer(rng.bytes(8 * grid.rows * grid.cols)).reshape(shape)
    return np.full(shape, rng.choice([1.0, -1.0]) * 10.0 ** rng.uniform(-300, 300))


@pytest.mark.parametrize("free_gain", [True, False])
@pytest.mark.parametrize(
    ("rows", "cols", "pitch"),
    [(44, 44, PITCH), (4, 4, 0.012), (5, 64, 0.0008), (64, 5, 0.003), (2, 2, 0.02), (2, 30, PITCH)],
)
def test_random_frames_give_finite_numbers_or_are_invalid(free_gain, rows, cols, pitch):
    rng = np.random.default_rng(21)
    grid = SensorGrid(rows, cols, pitch)
    estimator = ContactEstimator(TIP, MEASURED, grid, 600.0, free_gain=free_gain)
    for _ in range(200):
        e = estimator.update(_garbage(rng, grid), 10.0 ** rng.uniform(-2, 3))
        numbers = [e.d, e.tilt_x, e.tilt_y, e.gain, e.chi2, e.r_squared]
        assert np.all(np.isfinite(numbers))
        if e.valid:
            assert 0.0 <= e.d < 0.75 * A
            assert np.all(np.isfinite(e.covariance))
            assert np.all(np.linalg.eigvalsh(e.covariance) >= -1e-12 * np.trace(e.covariance))
            assert e.contact == (e.d > 0.0)
