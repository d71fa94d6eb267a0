"""Test the model of the elastomer's blur against a convolution; test estimates with blur."""

import math

import numpy as np
import pytest

from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.simulated_tactile import make_sensor_model
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.blur import stencil
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import LINEAR, MEASURED, PITCH, TIP, E, dense, tilts

NOISE = 0.002


@pytest.mark.parametrize(
    ("material", "blur"), [(LINEAR, 0.0002), (MEASURED, 0.0006), (LINEAR, 0.0016)]
)
def test_the_forward_model_is_a_convolution_of_the_pressure(material, blur):
    for contact in ((0.0005, 0.1, 0.0), (0.002, 0.3, -0.1), (0.006, 0.3, 0.2)):
        grid = SensorGrid(44, 44, PITCH, (0.0004, -0.0003), blur=blur)
        found = grid.pressure(TIP, material, *contact)
        miss = np.abs(found - dense(grid, material, contact)) / material.reference_modulus
        assert miss.max() < 1.5e-4


def test_blur_includes_pressure_beyond_the_edge_of_a_rotated_oblong_sensor():
    grid = SensorGrid(20, 30, (0.0013, 0.0017), (0.013, 0.002), rotation=0.6, blur=0.0012)
    contact = (0.005, 0.2, 0.1)
    found = grid.pressure(TIP, LINEAR, *contact)
    assert found[:, -1].max() > 0.2 * found.max()
    np.testing.assert_allclose(found, dense(grid, LINEAR, contact), atol=1e-4 * E)


def test_stencils_have_the_moments_of_the_gaussian():
    for width in (0.05, 0.3, 0.6, 0.74, 0.76, 1.0, 3.0):
        w = stencil(width)
        k = np.arange(len(w)) - len(w) // 2
        assert w.sum() == pytest.approx(1.0, abs=1e-12)
        assert w @ k**2 == pytest.approx(width**2, rel=1e-3)
        assert w @ k**4 == pytest.approx(3.0 * width**4, rel=5e-3)
    assert stencil(0.0).tolist() == [1.0]


def test_an_unmodelled_blur_increases_the_residuals():
    grid = SensorGrid(44, 44, PITCH, blur=0.001)
    truth = (0.004, *tilts(math.radians(15.0), 0.3))
    frame = grid.pressure(TIP, LINEAR, *truth)
    sharp = ContactEstimator(TIP, LINEAR, SensorGrid(44, 44, PITCH), NOISE * E)(frame)
    aware = ContactEstimator(TIP, LINEAR, grid, NOISE * E)(frame)
    assert abs(aware.d - truth[0]) < 0.1 * aware.d_std
    assert abs(sharp.d - truth[0]) > 5.0 * aware.d_std
    assert sharp.chi2 > 10 * aware.chi2


@pytest.mark.parametrize("blur", [-1e-4, math.nan, math.inf, 0.05])
def test_an_invalid_blur_is_refused(blur):
    with pytest.raises(ValueError, match="blur"):
        SensorGrid(44, 44, PITCH, blur=blur)


@pytest.mark.parametrize("reading", [math.nan, math.inf, 1e9])
def test_cells_beyond_the_reach_of_the_tip_are_unused_for_any_blur(reading):
    grid = SensorGrid(44, 44, PITCH, blur=0.001)
    noise = 0.002 * LINEAR.reference_modulus
    frame = grid.pressure(TIP, LINEAR, 0.012, 0.25, 0.25)
    estimator = ContactEstimator(TIP, LINEAR, grid, noise)
    usual = estimator(frame)
    # The cell is in the bounding box of the footprint. The cell's distance to the rim exceeds three
    # standard deviations of the blur.
    frame[39, 39] = reading
    found = estimator(frame)
    assert usual.valid
    assert found.valid
    assert found.d == usual.d


def test_blur_settings_apply_to_the_simulated_sensor_and_the_estimator():
    sensor, truth = {"blur": 0.001, "noise": 300.0}, {"tactile_blur": 0.001, "tactile_noise": 300.0}
    settings = Settings.model_validate({"tactile": sensor, "simulation": truth})
    counts = np.zeros((44, 44), np.uint16)
    make_sensor_model(settings, 0).frame(0.004, 0.2, -0.1, counts)
    estimator = make_estimator(settings, make_material(settings.material))
    e = estimator(counts, settings.tactile.pascal_per_count)
    assert e.d == pytest.approx(0.004, abs=5e-5)
    assert (e.tilt_x, e.tilt_y) == pytest.approx((0.2, -0.1), abs=2e-3)
