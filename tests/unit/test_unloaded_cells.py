"""Test how the cells outside the tip show a sensor's zero shift and noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from softfinger.daemon.perception.calibration_file import least_end
from softfinger.daemon.perception.finger_model import make_models
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.perception.unloaded_cells import UnloadedCells
from softfinger.daemon.profile.factory import make_grid, make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

PITCH = 0.058 / 44


def frames(zero: float, cells: int = 32, pressed: int = 200) -> np.ndarray:
    """Return the counts for a 20 mm tip with an indentation of 3 mm, plus a zero offset."""
    at = (np.arange(cells) - 0.5 * (cells - 1)) * 0.058 / cells
    inside = np.hypot(*np.meshgrid(at, at)) < 10.5e-3
    return np.where(inside, pressed + zero, zero).astype(np.uint16)


def unpressed(side: float = 0.058) -> UnloadedCells:
    grid = SensorGrid(32, 32, side / 32)
    return UnloadedCells(grid, 0.02, np.ones(grid.shape, np.bool_))


def test_a_rising_zero_offset_is_subtracted_and_saturated_cells_stay_saturated():
    cells = unpressed()
    for zero in (3, 4, 9):
        cells.update(frames(zero))
    assert cells.zero_shift == 6
    counts = frames(9)
    counts[16, 16] = 255
    corrected = cells.corrected(counts, 255)
    assert corrected[16, 16] == 255
    assert corrected[0, 0] == 3
    assert corrected[16, 14] == 203
    cells.reset_zero()
    assert cells.corrected(counts, 255) is counts


@pytest.mark.parametrize(
    ("spread", "dead"),
    [(1500.0, {}), (0.0, {(0, c): 60_000 for c in range(44)}), (0.0, {(20, 20): 50_000})],
    ids=["offsets that differ", "a dead row", "a dead cell under the tip"],
)
def test_tared_offsets_and_listed_dead_cells_do_not_count_as_noise(spread, dead):
    tactile = {"full_count": 65_535, "dead": (tuple(dead), ())}
    settings = Settings.model_validate({"loop": {"clock": "virtual"}, "tactile": tactile})
    sensor = SimpleNamespace(latest=lambda: None)
    finger = FingerPerception(sensor, make_models(settings)[0], settings, [])
    rng, grid = np.random.default_rng(1), make_grid(settings, 0)
    rest = 9000.0 + rng.normal(0.0, spread, grid.shape)
    scale, noise = settings.tactile.pascal_per_count, settings.tactile.noise
    pressed = grid.pressure(make_tip(settings), make_material(settings.material), 2e-3) / scale
    for k in range(120):
        counts = rest + rng.normal(0.0, noise / scale, grid.shape) + pressed * (k >= 100)
        for cell, value in dead.items():
            counts[cell] = value
        frame = Frame(k, 0.01 * k, 0.01 * k, True, np.rint(counts).astype(np.uint16))
        sensor.latest = lambda frame=frame: frame
        if k == 5:
            finger.tare()
        finger.update()
    assert finger.noise == pytest.approx(noise, rel=0.2)
    assert finger._estimator.saturation > 50_000
    assert finger.estimate.d == pytest.approx(2e-3, rel=0.05)


def test_a_second_contact_near_the_tip_is_not_a_zero_offset():
    cells = unpressed()
    cells.update(frames(3))
    touched = frames(3)
    touched[:, :6] = 100
    cells.update(touched)
    assert cells.zero_shift == 0


def test_a_sensor_covered_by_the_tip_gives_no_offset_and_no_noise():
    cells = unpressed(side=0.018)
    for zero in (3, 9):
        cells.update(frames(zero))
    assert cells.zero_shift == 0
    assert cells.noise == 0.0


@pytest.mark.parametrize("zero", [0, 40])
@pytest.mark.parametrize("sigma", [1.0, 3.0, 12.0])
def test_noise_is_measured_on_cells_without_contact(zero, sigma):
    cells, rng = unpressed(), np.random.default_rng(1)
    for _ in range(40):
        noisy = frames(zero) + rng.normal(0.0, sigma, (32, 32))
        cells.update(np.clip(np.rint(noisy), 0, 255).astype(np.uint16))
    assert cells.noise == pytest.approx(sigma, rel=0.25)


@pytest.mark.parametrize("zero", [0.0, 50.0, 3000.0])
@pytest.mark.parametrize("noise", [0.7, 5.0, 40.0])
def test_the_noise_of_a_sensor_as_small_as_its_tip_is_measured_between_frames(zero, noise):
    rng = np.random.default_rng(5)
    grid = SensorGrid(24, 24, PITCH)
    cells = UnloadedCells(grid, 0.020, np.ones(grid.shape, bool))
    press = 2000.0 * (np.hypot(*(np.indices(grid.shape) - 11.5)) < 5.0)
    for _ in range(60):
        frame = zero + press + noise * rng.standard_normal(grid.shape)
        cells.update(np.clip(np.round(frame), 0, 65535).astype(np.uint16))
    assert cells.noise == 0.0
    assert cells.scatter == pytest.approx(noise, rel=0.2, abs=0.4)


def distances(grid: SensorGrid) -> np.ndarray:
    """Return the distance of each cell from the centre of the grid [m]."""
    (pitch_x, pitch_y), (rows, cols) = grid.pitches, grid.shape
    x = (np.arange(cols) - 0.5 * (cols - 1)) * pitch_x
    y = (np.arange(rows) - 0.5 * (rows - 1)) * pitch_y
    return np.hypot(*np.meshgrid(x, y))


@pytest.mark.parametrize(("outer", "shift"), [(1.9, 0), (3.9, 6)])
def test_cells_within_two_pitches_of_the_rim_do_not_show_the_zero_offset(outer, shift):
    """The rubber may bulge or overhang, so a ring around the tip's rim rises by 6 counts."""
    grid = SensorGrid(48, 48, 0.001)
    rim = 1e3 * distances(grid) - 20.0  # distance from the rim, in pitches
    ring = (rim > 1.0) & (rim < outer)
    outside = (rim > 2.0) & (rim < 3.9)
    live = (ring | outside) if shift else (ring | (rim > 6.0) & (rim < 6.5))
    cells = UnloadedCells(grid, 0.020, live)
    cells.update(np.full(grid.shape, 3, np.uint16))
    cells.update(np.where(ring, 9, 3).astype(np.uint16))
    assert cells.zero_shift == shift


@pytest.mark.parametrize(("count", "shift"), [(40, 0), (70, 6)])
def test_a_zero_offset_is_measured_only_with_enough_cells(count, shift):
    grid = SensorGrid(44, 44, PITCH)
    live = np.zeros(grid.shape, bool)
    live.flat[np.argsort(distances(grid), axis=None)[-count:]] = True
    cells = UnloadedCells(grid, 0.020, live)
    for level in (3, 9):
        cells.update(np.full(grid.shape, level, np.uint16))
    assert cells.zero_shift == shift


def test_the_noise_is_averaged_over_about_eight_updates():
    cells, rng = unpressed(), np.random.default_rng(2)
    for _ in range(60):
        cells.update(np.rint(100.0 + rng.normal(0.0, 10.0, (32, 32))).astype(np.uint16))
    before = cells.noise
    for _ in range(8):
        cells.update(np.full((32, 32), 100, np.uint16))
    assert (cells.noise / before) ** 2 == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.parametrize("reads_zero", [0.15, 0.45])
def test_partly_clipped_noise_is_measured_to_within_a_third(reads_zero):
    """``reads_zero`` is the fraction of cells whose noise is clipped."""
    rng, sigma = np.random.default_rng(3), 40.0
    offset = sigma * {0.15: 1.036, 0.45: 0.126}[reads_zero]  # quantiles of the normal distribution
    grid = SensorGrid(24, 24, PITCH)
    cells = UnloadedCells(grid, 0.020, np.ones(grid.shape, bool))
    for _ in range(60):
        noisy = offset + rng.normal(0.0, sigma, grid.shape)
        cells.update(np.rint(np.maximum(noisy, 0.0)).astype(np.uint16))
    assert cells.scatter == pytest.approx(sigma, rel=0.33)


def test_a_cell_with_a_fifth_of_the_usual_range_counts_as_faulty():
    assert least_end(np.array([100.0, 99.0, 101.0, 15.0])) == 99.0
    assert least_end(np.array([100.0, 99.0, 101.0, 30.0])) == 30.0
