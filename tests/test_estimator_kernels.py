"""The estimator's kernels against plain NumPy twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kinematics.activity import activity
from kinematics.cut_cells import PLANES
from kinematics.likelihood import SUMS, accumulate, cubic_law
from kinematics.material import Material

LINEAR = Material.constant(0.304e6)
MEASURED = Material.table_i()


def test_activity_matches_its_plain_twin():
    rng = np.random.default_rng(12)
    weights = np.outer([1, 2, 2, 2, 1], [1, 2, 2, 2, 1]).astype(float)
    weights[2, 2] = 0.0
    cells = np.ones((20, 10, 24))
    runs = np.tile(np.array([2, 22]), (20, 1))
    seen = set()
    for k in range(200):
        frame = rng.normal(0.0, 1.0, (20, 24))
        i, j = rng.integers(4, 16), rng.integers(4, 20)
        frame[i - 1 : i + 2, j - 1 : j + 2] += 0.02 * k
        expected = False
        for r in range(20):
            for c in range(2, 22):
                if frame[r, c] > 3.0:
                    total = squares = 0.0
                    for y in range(-2, 3):
                        for x in range(-2, 3):
                            if 0 <= r + y < 20 and 0 <= c + x < 24:
                                w = weights[y + 2, x + 2]
                                total += w * frame[r + y, c + x]
                                squares += w * w
                    expected |= total / math.sqrt(squares) > 4.0
        contact, row, col, peak, mean, finite = activity(frame, cells, runs, 1.0, 3.0, 4.0)
        assert contact == expected
        assert finite
        inner = frame[:, 2:22]
        assert mean == pytest.approx(inner.mean())
        if inner.max() > 3.0:
            assert peak == inner.max() == frame[row, col]
        seen.add(expected)
    assert seen == {True, False}


def test_normal_equations_match_their_plain_twin():
    rng = np.random.default_rng(13)
    n = 37
    packed = np.zeros((PLANES, n))
    packed[0] = rng.uniform(0.2, 1.0, n)
    u, v, w, gain = 0.017, 0.2, -0.1, 1.3
    g = rng.uniform(35.0, 50.0, n) * packed[0]
    packed[1], packed[2], packed[3] = g, g * rng.uniform(-0.01, 0.01, n), g * 0.004
    packed[4] = rng.uniform(0.0, 1e-3, n)
    packed[5] = rng.uniform(0.0, 5e4, n)
    packed[6] = rng.random(n) > 0.1
    sums = np.zeros(SUMS)
    saturation = 2e4
    floor = 1.3e4
    accumulate(packed, n, u, v, w, gain, saturation, floor, 0.0, cubic_law(MEASURED.law), sums)
    strain = 1.0 - (u * packed[1] - v * packed[2] - w * packed[3]) / packed[0]
    step = 1e-4
    stress = MEASURED.stress(strain)
    slope = (MEASURED.stress(strain + step) - MEASURED.stress(strain - step)) / (2 * step)
    bend = (MEASURED.stress(strain + step) - 2 * stress + MEASURED.stress(strain - step)) / step**2
    mean = packed[0] * (stress + 0.5 * bend * packed[4])
    free = (packed[5] < saturation) | (gain * mean < saturation)
    free &= gain * mean >= floor
    weight = packed[6] * free
    jacobian = np.stack([mean, slope * packed[1], slope * packed[2], slope * packed[3]])
    residual = np.maximum(packed[5], floor) - gain * mean
    normal = (jacobian * weight) @ jacobian.T
    np.testing.assert_allclose(sums[:10], normal[np.triu_indices(4)], rtol=1e-4)
    np.testing.assert_allclose(sums[10:14], (jacobian * weight) @ residual, rtol=1e-3)
    assert sums[14] == pytest.approx((weight * residual**2).sum(), rel=1e-5)
    assert sums[15] == pytest.approx((packed[6] * packed[5] ** 2).sum(), rel=1e-12)
    assert sums[16] == weight.sum()
    assert 0 < (~free).sum() < n
    assert 0 < (gain * mean < floor).sum() < (~free).sum()


def test_the_estimators_law_follows_any_material():
    points = Material.from_points(
        np.linspace(0.0, 1.0, 12),
        1e5 * np.linspace(0.0, 1.0, 12) ** 1.3 + 5e4 * np.linspace(0, 1, 12),
    )
    for material in (LINEAR, MEASURED, points):
        law = cubic_law(material.law)
        strain = np.linspace(0.0, 0.999999, 3001)
        t = strain * (len(law) - 1)
        k = t.astype(int)
        c = law[k].T
        t = t - k
        value = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
        np.testing.assert_allclose(
            value, material.stress(strain), atol=1e-7 * material.reference_modulus
        )
