"""The elastomer's blur: forward against a dense convolution, and in the estimator at the bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid, stencil
from tests.harness.paper_tip import LINEAR, MEASURED, PITCH, TIP, A, E, fisher, tilts

NOISE = 0.002


def dense(grid, material, contact, pieces=16, margin=6):
    """Pressure sampled ``pieces`` times a cell's side, blurred by SciPy, averaged over cells."""
    d, tilt_x, tilt_y = contact
    axes = []
    for cells, pitch, centre in zip((grid.cols, grid.rows), grid.pitches, grid.centre, strict=True):
        count = (cells + 2 * margin) * pieces
        axes.append((np.arange(count) + 0.5 - 0.5 * count) * pitch / pieces - centre)
    x, y = axes[0][None, :], axes[1][:, None]
    n_x, n_y = grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
    face = (A - d - n_x * x - n_y * y) / math.sqrt(1.0 - n_x**2 - n_y**2)
    inside = x * x + y * y < A * A
    height = np.sqrt(np.where(inside, A * A - x * x - y * y, 1.0))
    strain = np.where(inside, 1.0 - np.maximum(face, 0.0) / height, 0.0)
    pressure = material.stress(np.clip(strain, 0.0, 1.0))
    widths = [grid.blur / pitch * pieces for pitch in grid.pitches[::-1]]
    pressure = gaussian_filter(pressure, widths, truncate=6.0)
    edge = margin * pieces
    kept = pressure[edge:-edge, edge:-edge]
    return kept.reshape(grid.rows, pieces, grid.cols, pieces).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("material", "blur"), [(LINEAR, 0.0002), (MEASURED, 0.0006), (LINEAR, 0.0016)]
)
def test_the_forward_model_is_a_convolution_of_the_pressure(material, blur):
    for contact in ((0.0005, 0.1, 0.0), (0.002, 0.3, -0.1), (0.006, 0.3, 0.2)):
        grid = SensorGrid(44, 44, PITCH, (0.0004, -0.0003), blur=blur)
        found = grid.pressure(TIP, material, *contact)
        miss = np.abs(found - dense(grid, material, contact)) / material.reference_modulus
        assert miss.max() < 1.5e-4


def test_the_forward_model_takes_in_what_presses_beyond_the_edge_of_an_oblong_turned_sensor():
    grid = SensorGrid(20, 30, (0.0013, 0.0017), (0.013, 0.002), rotation=0.6, blur=0.0012)
    contact = (0.005, 0.2, 0.1)
    found = grid.pressure(TIP, LINEAR, *contact)
    assert found[:, -1].max() > 0.2 * found.max()
    np.testing.assert_allclose(found, dense(grid, LINEAR, contact), atol=1e-4 * E)


def test_stencils_have_the_gaussians_moments():
    for width in (0.05, 0.3, 0.6, 0.74, 0.76, 1.0, 3.0):
        w = stencil(width)
        k = np.arange(len(w)) - len(w) // 2
        assert w.sum() == pytest.approx(1.0, abs=1e-12)
        assert w @ k**2 == pytest.approx(width**2, rel=1e-3)
        assert w @ k**4 == pytest.approx(3.0 * width**4, rel=5e-3)
    assert stencil(0.0).tolist() == [1.0]


@pytest.mark.parametrize(
    ("material", "blur", "d", "degrees", "free_gain"),
    [
        (LINEAR, 0.0006, 0.001, 20.0, True),
        (LINEAR, 0.001, 0.004, 15.0, False),
        (MEASURED, 0.0016, 0.006, 25.0, True),
        (MEASURED, 0.0004, 0.002, 10.0, False),
    ],
)
def test_errors_with_a_blur_are_at_the_bound_and_the_covariance_says_so(
    material, blur, d, degrees, free_gain
):
    noise = NOISE * material.reference_modulus
    grid = SensorGrid(44, 44, PITCH, (2e-4, -5e-4), blur=blur)
    truth = (d, *tilts(math.radians(degrees), 0.8))
    covariance = fisher(grid, material, (*truth, 1.0), noise, free_gain)
    estimator = ContactEstimator(TIP, material, grid, noise, free_gain=free_gain)
    rng = np.random.default_rng(9)
    clean = dense(grid, material, truth)  # not the estimator's own forward model
    frames = 300
    miss = np.empty((frames, 3))
    nees = np.empty(frames)
    for k in range(frames):
        e = estimator.update(clean + rng.normal(0.0, noise, grid.shape))
        assert e.valid
        miss[k] = (e.d - truth[0], e.tilt_x - truth[1], e.tilt_y - truth[2])
        nees[k] = miss[k] @ np.linalg.solve(e.covariance[:3, :3], miss[k]) / 3.0
    ratio = np.sqrt((miss**2).mean(axis=0) / np.diag(covariance)[:3])
    # 300 frames scatter the ratio by 4 %.
    assert np.all(ratio < 1.13), ratio
    assert np.all(ratio > 0.85), ratio
    assert abs(nees.mean() - 1.0) < 4.0 * math.sqrt(2.0 / (3 * frames)) + 0.05


def test_a_blur_that_is_not_modelled_shows():
    grid = SensorGrid(44, 44, PITCH, blur=0.001)
    truth = (0.004, *tilts(math.radians(15.0), 0.3))
    frame = grid.pressure(TIP, LINEAR, *truth)
    sharp = ContactEstimator(TIP, LINEAR, SensorGrid(44, 44, PITCH), NOISE * E)(frame)
    aware = ContactEstimator(TIP, LINEAR, grid, NOISE * E)(frame)
    assert abs(aware.d - truth[0]) < 0.1 * aware.d_std
    assert abs(sharp.d - truth[0]) > 5.0 * aware.d_std
    assert sharp.chi2 > 10 * aware.chi2


def test_dead_cells_counts_and_thresholds_go_with_a_blur():
    rng = np.random.default_rng(7)
    grid = SensorGrid(44, 44, PITCH, blur=0.0008)
    active = rng.random(grid.shape) > 0.02
    truth = (0.003, 0.2, -0.1)
    clean = grid.pressure(TIP, MEASURED, *truth)
    estimator = ContactEstimator(TIP, MEASURED, grid, 600.0, active=active, free_gain=False)
    score = []
    for _ in range(150):
        counts = np.clip(np.round((clean + rng.normal(0.0, 600.0, grid.shape)) / 50.0), 0, 65535)
        counts[~active] = 65535
        e = estimator.update(counts.astype(np.uint16), 50.0)
        assert e.valid
        miss = np.array([e.d, e.tilt_x, e.tilt_y]) - truth
        score.append(miss / np.sqrt(np.diag(e.covariance))[:3])
    assert np.all(np.abs(np.mean(score, axis=0)) < 4.5 / math.sqrt(150))
    assert np.all(np.sqrt(np.mean(np.square(score), axis=0)) < 1.2)


@pytest.mark.parametrize("blur", [-1e-4, math.nan, math.inf, 0.05])
def test_a_blur_that_is_none_is_refused(blur):
    with pytest.raises(ValueError, match="blur"):
        SensorGrid(44, 44, PITCH, blur=blur)


@pytest.mark.parametrize("reading", [math.nan, math.inf, 1e9])
def test_cells_out_of_the_tips_reach_are_not_used_however_far_the_blur_goes(reading):
    grid = SensorGrid(44, 44, PITCH, blur=0.001)
    noise = 0.002 * LINEAR.reference_modulus
    frame = grid.pressure(TIP, LINEAR, 0.012, 0.25, 0.25)
    estimator = ContactEstimator(TIP, LINEAR, grid, noise)
    usual = estimator(frame)
    # Beyond the rim by more than three standard deviations, but in the footprint's box.
    frame[39, 39] = reading
    found = estimator(frame)
    assert usual.valid
    assert found.valid
    assert found.d == usual.d
