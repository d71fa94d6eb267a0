"""The estimator's kernels against plain NumPy twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import cell_centres
from softfinger.kinematics.estimation.likelihood import set_law
from softfinger.kinematics.estimation.state import PLANES, EstimatorState, Law
from tests.harness.estimator_kernels import activity, press_and_accumulate, state_for

LINEAR = Material.constant(0.304e6)
MEASURED = Material.table_i()


def test_activity_matches_its_plain_twin():
    rng = np.random.default_rng(12)
    weights = np.outer([1, 2, 2, 2, 1], [1, 2, 2, 2, 1]).astype(float)
    weights[2, 2] = 0.0
    # Columns 2 … 21 are in reach, and rows 2 … 17.
    active = np.zeros((20, 24), bool)
    active[2:18, 2:22] = True
    state = EstimatorState()
    grid = state.grid
    grid.radius, grid.pitch_x, grid.pitch_y, grid.rows, grid.cols = 1.0, 0.01, 0.01, 20, 24
    state.options.peak_level, state.signal.patch_level, state.signal.noise = 3.0, 4.0, 1.0
    centres = cell_centres(grid, active, 2.0, state.region)
    assert state.region.number == active.sum()
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
        activity(state.array, frame, centres)
        found = state.signal
        assert found.contact == expected
        assert found.finite
        inner = frame[active]
        assert found.mean == pytest.approx(inner.mean())
        assert found.energy == pytest.approx((inner**2).sum())
        assert found.peak == inner.max()
        if found.peak > 3.0:
            assert frame[found.row, found.col] == found.peak
        seen.add(expected)
    assert seen == {True, False}


def test_normal_equations_match_their_plain_twin():
    rng = np.random.default_rng(13)
    n = 37
    packed = np.zeros((PLANES, n))
    packed[0] = rng.uniform(0.2, 1.0, n)
    u, v, w, gain = 0.017, 0.2, -0.1, 1.3
    g = rng.uniform(35.0, 50.0, n)
    packed[1], packed[2], packed[3] = g, g * rng.uniform(-0.01, 0.01, n), g * 0.004
    packed[4] = rng.uniform(0.0, 1e-3, n)
    packed[5] = rng.uniform(0.0, 5e4, n)
    packed[6] = rng.random(n) > 0.1
    saturation = 2e4
    floor = 1.3e4
    state = state_for(packed)
    face, state.fit.gain = state.fit.face, gain
    face.u, face.v, face.w = u, v, w
    state.signal.saturation, state.signal.floor = saturation, floor
    set_law(state.law, MEASURED.law)
    press_and_accumulate(state.array, packed.copy())
    sums = state.fit.sums
    strain = 1.0 - (u * packed[1] - v * packed[2] - w * packed[3])
    step = 1e-4
    stress = MEASURED.stress(strain)
    slope = (MEASURED.stress(strain + step) - MEASURED.stress(strain - step)) / (2 * step)
    bend = (MEASURED.stress(strain + step) - 2 * stress + MEASURED.stress(strain - step)) / step**2
    mean = packed[0] * (stress + 0.5 * bend * packed[4])
    free = (packed[5] < saturation) | (gain * mean < saturation)
    free &= gain * mean >= floor
    weight = packed[6] * free
    slope = slope * packed[0]
    jacobian = np.stack([mean, slope * packed[1], slope * packed[2], slope * packed[3]])
    residual = np.maximum(packed[5], floor) - gain * mean
    normal = (jacobian * weight) @ jacobian.T
    np.testing.assert_allclose(sums.normal, normal[np.triu_indices(4)], rtol=1e-4)
    np.testing.assert_allclose(sums.right, (jacobian * weight) @ residual, rtol=1e-3)
    assert sums.misfit == pytest.approx((weight * residual**2).sum(), rel=1e-5)
    assert sums.readings == pytest.approx((packed[6] * packed[5] ** 2).sum(), rel=1e-12)
    assert sums.weight == weight.sum()
    assert 0 < (~free).sum() < n
    assert 0 < (gain * mean < floor).sum() < (~free).sum()


def test_the_estimators_law_follows_any_material():
    points = Material.from_points(
        np.linspace(0.0, 1.0, 12),
        1e5 * np.linspace(0.0, 1.0, 12) ** 1.3 + 5e4 * np.linspace(0, 1, 12),
    )
    for material in (LINEAR, MEASURED, points):
        law = Law()
        set_law(law, material.law)
        strain = np.linspace(0.0, 0.999999, 3001)
        if law.is_polynomial:
            value = np.polynomial.Polynomial(law.polynomial)(strain)
        else:
            t = strain * (len(law.cubics) - 1)
            k = t.astype(int)
            c = law.cubics[k].T
            t = t - k
            value = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
        np.testing.assert_allclose(
            value, material.stress(strain), atol=1e-7 * material.reference_modulus
        )
        assert law.bent == (material is not LINEAR)
        assert law.is_polynomial == (material is not points)
