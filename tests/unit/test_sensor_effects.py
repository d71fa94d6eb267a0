"""Test each effect of the simulated sensor on the pressure against plain NumPy."""

import math
from dataclasses import replace

import numpy as np
import pytest

from softfinger.daemon.simulation import sensor_model
from softfinger.daemon.simulation.sensor_model import SensorModel
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import LINEAR, MEASURED, PITCH, TIP, E, board, dense, flawed

CONTACTS = [(0.0005, 0.1, -0.2), (0.002, 0.3, 0.1), (0.006, 0.0, -0.4)]


def sensor(grid=None, seed=0, **flaws):
    grid = grid or SensorGrid(44, 44, PITCH, (3e-4, -5e-4))
    return SensorModel(grid, TIP, LINEAR, board(), flawed(**flaws), gain=0.2, seed=seed)


def counts(model, contact, t=0.0):
    out = np.zeros(model.grid.shape, np.uint16)
    model.frame(*contact, out, t)
    return out.astype(float)


def test_without_defects_the_forward_model_is_rounded():
    model = sensor()
    for contact in CONTACTS:
        # A reading between two counts may be rounded up or down. At the outline, the sensor model's
        # error is 1e-4 of the modulus, because the model averages over fewer points.
        signal = 0.2 * model.grid.pressure(TIP, LINEAR, *contact)
        np.testing.assert_allclose(counts(model, contact), signal, rtol=0, atol=0.5 + 6.0)
    assert not counts(model, (0.0, 0.2, -0.1)).any()


def test_noise_has_the_configured_deviation_and_is_clipped_at_zero():
    model = sensor(noise=600.0)
    clean = 0.2 * model.grid.pressure(TIP, LINEAR, *CONTACTS[2])
    strong = clean > 4000.0
    rest = np.concatenate([(counts(model, CONTACTS[2]) - clean)[strong] for _ in range(20)])
    # For n numbers, the standard deviation has a relative scatter of 1/√(2n). The mean has a
    # scatter of 1/√n standard deviations.
    assert rest.std() == pytest.approx(600.0, rel=4.5 / np.sqrt(2 * rest.size))
    assert abs(rest.mean()) < 4.0 * 600.0 / np.sqrt(rest.size)
    free = counts(model, (0.0, 0.0, 0.0))
    assert (free == 0.0).mean() == pytest.approx(0.5, abs=0.05)
    # A clipped normal distribution has a mean of σ/√2π. With 1936 cells, the ratio is 1 ± 0.033.
    assert free.mean() == pytest.approx(600.0 / np.sqrt(2 * np.pi), rel=0.15)


def test_each_cell_has_its_own_gain_and_dead_cells_read_zero():
    flaws = flawed(gain_spread=0.05)
    grid = SensorGrid(44, 44, PITCH)
    model = SensorModel(grid, TIP, LINEAR, board(4.0), flaws, seed=5, dead=[(22, 24), (0, 0)])
    first = counts(model, CONTACTS[2])
    np.testing.assert_array_equal(first, counts(model, CONTACTS[2]))
    assert first[22, 24] == 0
    assert np.argwhere(~model.active).tolist() == [[0, 0], [22, 24]]
    clean = grid.pressure(TIP, LINEAR, *CONTACTS[2])
    strong = (clean > 4000.0) & model.active
    assert (4.0 * first[strong] / clean[strong]).std() == pytest.approx(0.05, rel=0.25)


@pytest.mark.parametrize("width", [1e-4, 2e-4, 5e-4, 1e-3, 2e-3])
def test_blur_is_the_continuous_convolution(width):
    # The grid is smaller than the footprint. Pressure beyond the edge of the grid also spreads onto
    # the grid.
    blurred = SensorGrid(16, 20, PITCH, (3e-4, 5.3e-3), blur=width)
    model = sensor(replace(blurred, blur=0.0), blur=width)
    for contact in CONTACTS:
        expected = dense(blurred, LINEAR, contact, margin=math.ceil(7 * width / PITCH))
        model.press(*contact)
        np.testing.assert_allclose(model._pressure, expected, rtol=0, atol=2.5e-4 * E)
        sharp = model.grid.pressure(TIP, LINEAR, *contact)
        assert np.abs(sharp - expected).max() > 10 * np.abs(model._pressure - expected).max() or (
            width < 3e-4
        )


def test_hysteresis_affects_only_unloading_and_loops_close():
    model = sensor(hysteresis=0.1)
    clean = sensor()

    def force(d):
        return counts(model, (d, 0.0, 0.0)).sum() / counts(clean, (d, 0.0, 0.0)).sum()

    assert force(0.002) == pytest.approx(1.0, abs=1e-9)
    assert force(0.004) == pytest.approx(1.0, abs=1e-9)
    assert force(0.0038) > 1.03
    assert force(0.002) == pytest.approx(1.1, abs=0.005)
    assert 1.0 < force(0.0021) < 1.07  # loading within the hysteresis loop
    assert force(0.004) == pytest.approx(1.0, abs=1e-3)  # The loop closes at the maximum d.
    assert force(0.006) == pytest.approx(1.0, abs=1e-9)
    assert not counts(model, (0.0, 0.0, 0.0)).any()


def test_a_lag_is_the_exact_response_to_linear_segments():
    time = 3.0
    memory = np.zeros((2, 2, 2))
    shape = np.array([[1.0, 2.0], [0.5, 0.0]])
    times = [0.0, 0.7, 0.7, 5.0, 5.001, 30.0]
    values = [0.0, 100.0, 40.0, 40.0, 0.0, 10.0]
    # Integrate dz/dt = (p − z)/time in small steps as a reference.
    z = 0.0
    for k in range(1, len(times)):
        elapsed = times[k] - times[k - 1]
        steps = 20000
        for m in range(steps):
            p = values[k - 1] + (values[k] - values[k - 1]) * (m + 0.5) / steps
            z += elapsed / steps * (p - z) / (time + 0.5 * elapsed / steps)
        lagged = sensor_model.lag(values[k] * shape, time, elapsed, memory)
        np.testing.assert_allclose(lagged, z * shape, rtol=1e-6, atol=1e-6)


def test_a_long_contact_creeps_and_its_residual_fades():
    model = sensor(creep=0.05, creep_time=10.0)
    contact = (0.004, 0.1, 0.0)
    counts(model, (0.0, 0.0, 0.0), 0.0)
    first = counts(model, contact, 0.01).sum()
    assert counts(model, contact, 10.01).sum() / first == pytest.approx(
        1 + 0.05 * (1 - math.exp(-1)), rel=1e-3
    )
    assert counts(model, contact, 100.0).sum() / first == pytest.approx(1.05, rel=1e-3)
    gone = counts(model, (0.0, 0.0, 0.0), 100.01).sum() / first
    assert gone == pytest.approx(0.05, rel=0.01)
    assert counts(model, (0.0, 0.0, 0.0), 110.01).sum() / first == pytest.approx(
        0.05 * math.exp(-1), rel=0.02
    )


def test_a_slow_cell_reaches_63_percent_of_a_step_in_its_response_time():
    model = sensor(response=0.06)
    assert model.has_memory
    final = counts(sensor(), CONTACTS[1]).sum()
    counts(model, (0.0, 0.0, 0.0), 0.0)
    begin = counts(model, CONTACTS[1], 1e-9).sum()
    assert begin == pytest.approx(0.0, abs=1.0)
    risen = counts(model, CONTACTS[1], 0.06).sum() / final
    assert risen == pytest.approx(1.0 - math.exp(-1.0), rel=1e-3)
    assert counts(model, CONTACTS[1], 2.0).sum() == pytest.approx(final, rel=1e-3)
    counts(model, (0.0, 0.0, 0.0), 2.0 + 1e-9)
    left = counts(model, (0.0, 0.0, 0.0), 2.06).sum() / final
    assert left == pytest.approx(math.exp(-1.0), rel=1e-3)


@pytest.mark.parametrize(
    ("exponent", "fold", "read"),
    [
        (0.5, 0.0, {0.0: 0.0, 100.0: 1000.0, 2500.0: 5000.0, 10000.0: 10000.0}),
        (1.0, 4000.0, {0.0: 0.0, 2000.0: 2000.0, 4000.0: 4000.0, 8000.0: 2000.0, 16000.0: 1000.0}),
        (0.5, 4000.0, {1600.0: 4000.0, 10000.0: 4000.0}),
    ],
)
def test_a_curve_preserves_full_scale_and_foldback_lowers_high_readings(exponent, fold, read):
    flaws = flawed(exponent=exponent, fold=fold)
    model = SensorModel(SensorGrid(4, 5, PITCH), TIP, LINEAR, board(full_count=10000), flaws)
    out = np.zeros(model.grid.shape, np.uint16)
    for pressure, expected in read.items():
        model.press_evenly(pressure)
        model.read(out)
        np.testing.assert_allclose(out, expected, atol=0.5)


def test_row_noise_is_equal_within_a_row_and_new_in_each_frame():
    grid = SensorGrid(200, 6, PITCH)
    flaws = flawed(row_noise=30.0)
    model = SensorModel(grid, TIP, LINEAR, board(), flaws)
    model.press_evenly(1000.0)
    seen = np.empty((50, *grid.shape), np.uint16)
    for out in seen:
        model.read(out)
    np.testing.assert_array_equal(seen, seen[:, :, :1].repeat(6, axis=2))
    rows = seen[:, :, 0] - 1000.0
    assert rows.std() == pytest.approx(30.0, rel=0.03)
    assert abs(np.mean(rows[1:] * rows[:-1])) < 0.05 * 30.0**2
    assert abs(np.mean(rows[:, 1:] * rows[:, :-1])) < 0.05 * 30.0**2


def test_gain_drift_is_common_to_all_cells_with_the_configured_deviation():
    grid = SensorGrid(4, 5, PITCH)
    ends = []
    for seed in range(400):
        flaws = flawed(gain_drift=0.02, drift_time=60.0)
        model = SensorModel(grid, TIP, LINEAR, board(), flaws, seed=seed)
        out = np.zeros(grid.shape, np.uint16)
        gains = []
        for t in (0.0, 0.6, 600.0):
            model.press(0.0, 0.0, 0.0, t)
            model.press_evenly(50000.0)
            model.read(out)
            assert (out == out[0, 0]).all()
            gains.append(out[0, 0] / 50000.0 - 1.0)
        ends.append(gains)
    begin, soon, late = np.std(ends, axis=0)
    assert begin == 0.0
    assert soon == pytest.approx(0.02 * math.sqrt(2 * 0.6 / 60.0), rel=0.15)
    assert late == pytest.approx(0.02, rel=0.15)


def test_offset_drift_has_the_configured_deviation_and_time_constant():
    offset = np.zeros((60, 60))
    rng = np.random.default_rng(2)
    sensor_model.drift(offset, 50.0, 60.0, 0.01, rng.standard_normal(offset.shape))
    # At first, the drift is a random walk with deviation · √(2 t / time).
    assert offset.std() == pytest.approx(50.0 * math.sqrt(2 * 0.01 / 60.0), rel=0.05)
    for _ in range(40):
        sensor_model.drift(offset, 50.0, 60.0, 20.0, rng.standard_normal(offset.shape))
    assert offset.std() == pytest.approx(50.0, rel=0.05)
    earlier = offset.copy()
    sensor_model.drift(offset, 50.0, 60.0, 60.0, rng.standard_normal(offset.shape))
    # With 3600 cells, the mean has a scatter of 0.018.
    assert np.mean(offset * earlier) / 50.0**2 == pytest.approx(math.exp(-1), abs=0.08)


def test_crosstalk_is_a_fraction_of_both_line_means():
    model = sensor(crosstalk=0.3)
    signal = counts(sensor(), CONTACTS[1])
    expected = signal + 0.3 * (signal.mean(axis=0) + signal.mean(axis=1)[:, None])
    np.testing.assert_allclose(counts(model, CONTACTS[1]), expected, atol=1.01)
    assert expected[0].max() > 100.0  # a cell in a ghost image, outside the contact


@pytest.mark.parametrize("least", [0, 3])
def test_conversion_to_counts_rounds_clips_and_zeroes_weak_and_dead_cells(least):
    rng = np.random.default_rng(3)
    value = rng.normal(4.0, 5.0, (5, 7))
    live = rng.random((5, 7)) > 0.2
    out = np.zeros((5, 7), np.uint16)
    sensor_model.count(value, live, (least, 9), out)
    expected = np.clip(np.floor(value + 0.5), 0, 9)
    expected[(expected < least) | ~live] = 0
    np.testing.assert_array_equal(out, expected)


def test_undeclared_dead_cells_follow_the_fraction_and_the_seed():
    grid = SensorGrid(100, 100, PITCH)
    flaws = flawed(dead=0.05)
    first, again, other = (
        SensorModel(grid, TIP, LINEAR, board(), flaws, seed=seed).active for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (~first).mean() == pytest.approx(0.05, abs=0.01)


def test_all_effects_together_are_reproducible_for_a_seed():
    flaws = {
        "noise": 600.0,
        "gain_spread": 0.05,
        "dead": 0.01,
        "blur": 5e-4,
        "hysteresis": 0.05,
        "creep": 0.03,
        "response": 0.05,
        "exponent": 0.9,
        "fold": 60e3,
        "crosstalk": 0.02,
        "row_noise": 100.0,
        "drift": 200.0,
        "gain_drift": 0.01,
    }
    first, again, other = (sensor(seed=seed, **flaws) for seed in ((1, 0), (1, 0), (1, 1)))
    assert first.has_memory
    assert (counts(other, CONTACTS[1]) != counts(sensor(**flaws), CONTACTS[1])).any()
    for k, contact in enumerate(CONTACTS * 3):
        np.testing.assert_array_equal(
            counts(first, contact, 0.01 * k), counts(again, contact, 0.01 * k)
        )


COUNT = 2.5  # Pa


def frame(grid: SensorGrid, d: float, tilt: float, curvature: float) -> np.ndarray:
    sensor = SensorModel(grid, TIP, MEASURED, board(COUNT), flawed())
    out = np.zeros(grid.shape, np.uint16)
    sensor.frame(d, tilt, 0.0, out, curvature=curvature)
    return out * COUNT


def literal(d: float, tilt: float, radius: float, rotation: float, parts: int = 24) -> np.ndarray:
    """Return the mean pressure of 44 × 44 rotated cells, sampled at ``parts``² points per cell."""
    at = (np.arange(44 * parts) + 0.5) * PITCH / parts - 0.029
    sensor_x, sensor_y = np.meshgrid(at, at)
    x = math.cos(rotation) * sensor_x - math.sin(rotation) * sensor_y
    away = TIP.radius - d + radius
    root = np.sqrt(np.maximum(radius**2 - (x - away * math.sin(tilt)) ** 2, 0.0))
    face = np.where(root > 0.0, away * math.cos(tilt) - root, np.inf)
    length = np.sqrt(np.maximum(TIP.radius**2 - sensor_x**2 - sensor_y**2, 1e-30))
    pressure = MEASURED.stress(np.maximum(1.0 - np.minimum(face / length, 1.0), 0.0))
    return np.asarray(pressure.reshape(44, parts, 44, parts).mean(axis=(1, 3)))


@pytest.mark.parametrize("rotation", [0.0, 0.4])
@pytest.mark.parametrize(("d", "tilt"), [(0.001, -0.1), (0.004, 0.3), (0.006, -0.4)])
@pytest.mark.parametrize("radius", [0.012, 0.04])
def test_cells_under_a_cylinder_match_the_springs(radius, d, tilt, rotation):
    grid = SensorGrid(44, 44, PITCH, rotation=rotation)
    found = frame(grid, d, tilt, 1.0 / radius)
    expected = literal(d, tilt, radius, rotation)
    assert np.abs(found - expected).max() < 1.5e-3 * MEASURED.reference_modulus
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_an_almost_plane_face_gives_the_frame_of_a_plane():
    grid = SensorGrid(44, 44, PITCH, rotation=0.2)
    plane, curved = frame(grid, 0.004, 0.25, 0.0), frame(grid, 0.004, 0.25, 1e-5)
    assert np.abs(plane - curved).max() < 6e-4 * MEASURED.reference_modulus
    assert not frame(grid, 0.0, 0.25, 50.0).any()
    assert not frame(grid, -0.001, 0.25, 50.0).any()
