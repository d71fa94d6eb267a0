"""Test that the mathematics of each calibration step recovers a simulated sensor's properties."""

import math
import sys

import numpy as np
import pytest

from softfinger.kinematics.calibration.calibration import (
    CalibrationError,
    above_zero,
    equilibrate,
    fit_curve,
    tare,
)
from softfinger.kinematics.calibration.press_fit import fit_centre, fit_modulus
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

TIP = Fingertip(0.020)
E = 0.304e6
LINEAR = Material.constant(E)
GRID = SensorGrid(32, 32, 0.058 / 32)
AREA = (0.058 / 32) ** 2
RNG = np.random.default_rng(11)


@pytest.fixture(autouse=True)
def own_noise(monkeypatch):
    """Reset the random source, so that a test does not depend on earlier tests."""
    monkeypatch.setattr(sys.modules[__name__], "RNG", np.random.default_rng(11))


def force(d: float, theta: float = 0.0) -> float:
    return math.pi * E * d * d / math.cos(theta)


def test_tare_is_the_mean_of_each_cell():
    zero = RNG.uniform(0, 20, (4, 5))
    noise = RNG.uniform(0.5, 2.0, (4, 5))
    found = tare(zero + noise * RNG.standard_normal((4000, 4, 5)))
    np.testing.assert_allclose(found.zero, zero, atol=0.2)
    np.testing.assert_allclose(found.noise, noise, rtol=0.08)


def test_a_tare_under_load_is_refused():
    frames = 10.0 + RNG.standard_normal((20, 8, 8))
    frames[:, 2:4, 3] *= 20.0  # The tare ignores two faulty cells.
    tare(frames)
    frames[10:, 4:6, 4:7] += 100.0
    with pytest.raises(CalibrationError, match="the readings of 8 cells are changing"):
        tare(frames)


def test_a_tare_measures_noise_correlation_and_common_drift():
    rng = np.random.default_rng(4)
    white = 2.0 * rng.standard_normal((100, 44, 45))
    plain = tare(50.0 + white)
    assert plain.correlation.size == 0
    assert plain.drift == 0.0
    # The noise of each cell is the sum of two sources, and a neighbour shares each source.
    shared = 50.0 + (white[:, :, 1:] + white[:, :, :-1]) / math.sqrt(2.0)
    shared[:, 3, 3] += 100.0 * rng.standard_normal(100)  # This cell is faulty.
    found = tare(shared + 0.7 * rng.standard_normal((100, 1, 1)))
    assert found.correlation.shape == (1, 2)
    np.testing.assert_allclose(found.correlation, [[1.0, 0.5]], atol=0.02)
    # With 100 frames, the estimate has a relative scatter of 0.07.
    assert found.drift == pytest.approx(0.7, rel=0.3)


@pytest.mark.parametrize("drift", [0.0, 2.0])
@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize(
    ("rows", "cols", "count", "dead"),
    [(4, 4, 400, 0), (7, 12, 400, 0), (8, 8, 2000, 0), (16, 16, 400, 8), (16, 16, 400, 14)],
)
def test_noise_of_few_cells_is_not_taken_for_drift(rows, cols, count, dead, correlated, drift):
    noise = 3.0 * RNG.standard_normal((count, rows, cols + 1))
    if correlated:
        noise[:, :, 1:] = (noise[:, :, 1:] + noise[:, :, :-1]) / math.sqrt(2.0)
    frames = np.round(500.0 + noise[:, :, 1:] + drift * RNG.standard_normal((count, 1, 1)))
    frames[:, :, :dead] = 0.0
    found = tare(frames)
    # With 400 frames, the estimate has a relative scatter of 0.05.
    assert found.drift == pytest.approx(drift, rel=0.2)
    assert (found.correlation.size > 0) == correlated
    if correlated:
        assert found.correlation[0, 1] == pytest.approx(0.5, abs=0.1)


def test_a_tare_of_a_few_readings_has_no_correlation():
    assert tare(RNG.normal(9.0, 1.0, (3, 2, 2))).correlation.size == 0


def test_equilibration_equalises_cells_and_finds_dead_ones():
    gain = 1.0 + 0.2 * RNG.standard_normal((8, 8))
    gain[2, 3] = 0.0
    loads = [5.0 + gain * level + 0.5 * RNG.standard_normal((50, 8, 8)) for level in (40, 90, 160)]
    found = equilibrate(loads, np.full((8, 8), 5.0))
    assert found.gain[2, 3] == 0.0
    made = found.gain * gain
    live = gain > 0
    assert np.ptp(made[live] / made[live].mean()) < 0.01
    assert found.spread == pytest.approx(np.std(gain[live]) / gain[live].mean(), rel=0.05)
    assert found.residual < 2e-3


def test_the_noise_of_an_unloaded_sensor_is_not_equilibrated():
    zero = RNG.uniform(10, 40, (32, 32))
    for _ in range(20):
        rest = np.round(zero + RNG.standard_normal((64, 32, 32)))
        with pytest.raises(CalibrationError, match="do not exceed the zero offsets and the noise"):
            equilibrate([rest], tare(np.round(zero + RNG.standard_normal((64, 32, 32)))).zero)


@pytest.mark.parametrize("kind", ["power", "cubic"])
def test_the_curve_is_recovered_from_known_weights(kind):
    # The response curve gives the pressure as a function of the reading x. The test inverts the
    # curve by interpolation.
    x = np.linspace(0, 1000, 4001)
    true = 0.9 * x**1.4 if kind == "power" else 60 * x + 0.08 * x**2 + 5e-5 * x**3
    depths = (0.001, 0.0015, 0.002, 0.003, 0.004)
    readings = [np.interp(GRID.pressure(TIP, LINEAR, d), true, x) for d in depths]
    # The pressures exceed the interpolation table, so use the exact inverse.
    if kind == "power":
        readings = [(GRID.pressure(TIP, LINEAR, d) / 0.9) ** (1 / 1.4) for d in depths]
    found = fit_curve(kind, readings, [force(d) for d in depths], AREA, 4000.0)
    assert found.residual < 1e-4
    if kind == "power":
        assert found.coefficients[:2] == pytest.approx((1.4, 0.9), rel=1e-3)
    else:
        assert found.coefficients == pytest.approx((1.0, 60, 0.08, 5e-5), rel=0.02)


@pytest.mark.parametrize("rotation", [0.0, 0.3, -2.0])
def test_centre_and_rotation_are_recovered_from_tilted_loads(rotation):
    true = SensorGrid(32, 32, 0.058 / 32, centre=(1.3e-3, -0.8e-3), rotation=rotation)
    tilts = np.radians([-15.0, -5.0, 0.0, 10.0, 20.0])
    noise = 600.0
    frames = [
        true.pressure(TIP, LINEAR, 0.004, t) + noise * RNG.standard_normal((32, 32)) for t in tilts
    ]
    found = fit_centre(frames, tilts, TIP, LINEAR, GRID, noise)
    assert found.centre == pytest.approx(true.centre, abs=2e-5)
    assert found.rotation == pytest.approx(rotation, abs=5e-3)
    assert found.residual < 3e-5
    assert 2e-5 < found.std < 2e-4  # The fit assumes that tilts have an error of 0.5°.


def test_upright_loads_determine_the_centre_but_not_the_rotation():
    true = SensorGrid(32, 32, 0.058 / 32, centre=(-2e-3, 1e-3))
    frames = [true.pressure(TIP, LINEAR, d) for d in (0.002, 0.004)]
    found = fit_centre(frames, [0.0, 0.0], TIP, LINEAR, GRID, 600.0)
    assert found.centre == pytest.approx(true.centre, abs=2e-6)
    assert found.rotation is None
    assert 2e-5 < found.std < 2e-4


@pytest.mark.parametrize("tilts", [[0.2, 0.2], [0.1, 0.12], [-0.3]])
def test_loads_with_the_same_tilt_do_not_count_as_upright(tilts):
    frames = [GRID.pressure(TIP, LINEAR, 0.004, t) for t in tilts]
    with pytest.raises(CalibrationError, match="tilt and position can't be separated"):
        fit_centre(frames, tilts, TIP, LINEAR, GRID, 600.0)


def test_the_modulus_is_recovered_from_a_compression_with_unknown_zero_offset():
    d = np.linspace(0.001, 0.008, 15)
    theta = np.where(np.arange(15) % 2, 0.3, 0.0)
    load = math.pi * E * (d - 2e-4) ** 2 / np.cos(theta)
    found = fit_modulus(d, theta, load, TIP)
    assert found.modulus == pytest.approx(E, rel=1e-9)
    assert found.offset == pytest.approx(2e-4, rel=1e-6)
    assert found.residual < 1e-9


def test_clipped_noise_far_from_the_contact_is_removed():
    noise = 3.0
    reading = np.maximum(3.0 * RNG.standard_normal((16, 32, 32)).mean(axis=0), 0.0)
    assert above_zero(reading, noise, 16).sum() <= 0.01 * reading.sum() + 8.0
    reading[4, 4] = 50.0
    assert above_zero(reading, noise, 16)[4, 4] == 50.0


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: tare(np.zeros((1, 4, 4))), "found one frame"),
        (lambda: tare(np.zeros((4, 4))), r"\[n, rows, cols\]"),
        (lambda: tare(np.full((3, 4, 4), np.nan)), "not finite"),
        (lambda: equilibrate([], np.zeros((4, 4))), "expected at least one uniform pressure"),
        (
            lambda: equilibrate([np.zeros((2, 4, 4))], np.zeros((4, 4))),
            "the readings of most cells do not exceed",
        ),
        (lambda: fit_curve("cubic", np.ones((2, 4, 4)), [1, 2], 1e-6, 10), "at least 3"),
        (lambda: fit_curve("power", np.ones((2, 4, 4)), [1, -2], 1e-6, 10), "above 0"),
        (lambda: fit_curve("power", np.zeros((2, 4, 4)), [1, 2], 1e-6, 10), "gives no reading"),
        (lambda: fit_curve("cubic", np.ones((3, 4, 4)), [1, 2, 3], 1e-6, 10), "too similar"),
        (lambda: fit_centre(np.zeros((1, 32, 32)), [0], TIP, LINEAR, GRID, 600), "press 1"),
        (lambda: fit_modulus([0.001, 0.002], [0, 0], [1, 2], TIP), "at least three"),
        (
            lambda: fit_modulus([0.001, 0.002, 0.003], [0, 0, 0], [3, 2, 1], TIP),
            "does not increase",
        ),
        (
            lambda: fit_modulus([0.002, 0.004, 0.006], [0, 0, 0], [1.0, 1.0, 1.01], TIP),
            "check that the tip touches the sensor",
        ),
    ],
)
def test_uninformative_data_are_refused(call, told):
    with pytest.raises(CalibrationError, match=told):
        call()
