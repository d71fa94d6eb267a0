"""The simulated pressure sensor: its imperfections, each by its statistics, and its seed."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.daemon.simulation.sensor.sensor_model import Board, Imperfections, SensorModel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

TIP = Fingertip(0.020)
MATERIAL = Material.table_i()
GRID = SensorGrid(44, 44, 0.058 / 44)


FLAWS = set(Imperfections.__dataclass_fields__) - {"dead"}


def model(scale=4.0, grid=GRID, **options):
    flaws = {name: options.pop(name) for name in list(options) if name in FLAWS}
    flaws["dead"] = options.pop("dead_share", 0.0)
    board = Board(
        scale,
        **{name: options.pop(name) for name in ("full_count", "threshold") if name in options},
    )
    return SensorModel(grid, TIP, MATERIAL, board, Imperfections(**flaws), **options)


def frame(sensor, d=0.004, tilt_x=0.2, tilt_y=-0.1):
    out = np.zeros(GRID.shape, np.uint16)
    sensor.frame(d, tilt_x, tilt_y, out)
    return out


def test_without_imperfections_it_rounds_the_forward_model():
    expected = np.round(GRID.pressure(TIP, MATERIAL, 0.004, 0.2, -0.1) / 4.0)
    np.testing.assert_array_equal(frame(model()), expected)
    assert not frame(model(), d=0.0).any()


def test_a_seed_gives_the_same_frames_and_another_does_not():
    first, second, other = (model(noise=600.0, seed=s) for s in ((1, 0), (1, 0), (1, 1)))
    for d in (0.0, 0.002, 0.004):
        a, b, c = (frame(sensor, d) for sensor in (first, second, other))
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.3


def test_noise_has_the_size_asked_for_and_ends_at_zero():
    sensor = model(noise=600.0, seed=3)
    clean = GRID.pressure(TIP, MATERIAL, 0.004, 0.2, -0.1)
    strong = clean > 4000.0
    rest = np.concatenate([(frame(sensor) * 4.0 - clean)[strong] for _ in range(20)])
    assert rest.std() == pytest.approx(600.0, rel=0.03)
    assert abs(rest.mean()) < 4.0 * 600.0 / np.sqrt(rest.size)
    free = frame(sensor, d=0.0) * 4.0
    assert (free == 0.0).mean() == pytest.approx(0.5, abs=0.05)
    # Half a normal distribution has the mean σ/√2π over all cells.
    assert free.mean() == pytest.approx(600.0 / np.sqrt(2 * np.pi), rel=0.1)


@pytest.mark.parametrize("full", [255, 4095, 65535])
def test_counts_end_at_the_converters_largest(full):
    counts = frame(model(scale=0.5, full_count=full), d=0.008)
    assert counts.max() == full
    assert (counts == full).sum() > 50


def test_gain_spread_is_fixed_per_cell_and_dead_cells_read_zero():
    sensor = model(gain_spread=0.05, seed=5, dead=[(22, 24), (0, 0)])
    first, second = frame(sensor), frame(sensor)
    np.testing.assert_array_equal(first, second)
    assert first[22, 24] == 0
    assert not sensor.active[22, 24]
    assert sensor.active.sum() == 44 * 44 - 2
    clean = GRID.pressure(TIP, MATERIAL, 0.004, 0.2, -0.1)
    strong = (clean > 4000.0) & sensor.active
    assert (first[strong] * 4.0 / clean[strong]).std() == pytest.approx(0.05, rel=0.25)


def test_a_gain_scales_the_pressure():
    half = frame(model(gain=0.5)).astype(float)
    np.testing.assert_allclose(half, frame(model()) / 2.0, atol=0.6)


def test_the_estimator_reads_it_back():
    sensor = SensorModel(
        SensorGrid(44, 44, 0.058 / 44, rotation=0.3),
        TIP,
        MATERIAL,
        Board(4.0),
        Imperfections(noise=600.0),
        seed=7,
    )
    estimator = ContactEstimator(TIP, MATERIAL, sensor.grid, 600.0, free_gain=False)
    out = np.zeros(GRID.shape, np.uint16)
    score = []
    for k in range(100):
        truth = (0.002 + 0.00004 * k, 0.3 - 0.004 * k, 0.1)
        sensor.frame(*truth, out)
        e = estimator.update(out, 4.0)
        assert e.valid
        miss = np.array([e.d, e.tilt_x, e.tilt_y]) - truth
        score.append(miss / np.sqrt(np.diag(e.covariance))[:3])
    assert np.all(np.sqrt(np.mean(np.square(score), axis=0)) < 1.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"full_count": 0}, "full_count"),
        ({"full_count": 65536}, "full_count"),
        ({"scale": 0.0}, "pascal_per_count"),
        ({"gain": -1.0}, "gain"),
        ({"noise": -1.0}, "noise"),
        ({"noise": float("nan")}, "noise"),
        ({"gain_spread": -0.1}, "gain_spread"),
        ({"dead_share": 1.1}, "dead"),
        ({"blur": -1e-3}, "blur"),
        ({"hysteresis": float("inf")}, "hysteresis"),
        ({"creep_time": 0.0}, "creep_time"),
        ({"drift_time": 0.0}, "drift_time"),
        ({"crosstalk": -0.1}, "crosstalk"),
    ],
)
def test_wrong_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        model(**options)
