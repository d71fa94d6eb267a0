"""The estimator's kernels against plain NumPy twins."""

import math

import numpy as np
import pytest

from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import cell_centres
from softfinger.kinematics.estimation.likelihood import set_law
from softfinger.kinematics.estimation.state import EstimatorState, Law
from tests.harness.estimator_kernels import activity
from tests.harness.paper_tip import LINEAR, MEASURED


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


def test_the_estimators_law_follows_any_material():
    points = Material.from_points(
        np.linspace(0.0, 1.0, 12),
        1e5 * np.linspace(0.0, 1.0, 12) ** 1.3 + 5e4 * np.linspace(0, 1, 12),
    )
    for material in (LINEAR, MEASURED, points):
        law = Law()
        set_law(law, material)
        strain = np.linspace(0.0, 0.999999, 3001)
        value = np.polynomial.Polynomial(law.polynomial)(strain)
        np.testing.assert_allclose(
            value, material.stress(strain), atol=1e-12 * material.reference_modulus
        )
        assert law.bent == (material is not LINEAR)
