"""The closed forms of one tip: printed checkpoints, identities, scaling, and odd input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger import Fingertip
from softfinger.kinematics.contact.closed_form import (
    closed_forms,
)
from tests.harness.paper_tip import CHECKPOINTS, TIP, E

radii = st.floats(1e-4, 1.0)
moduli = st.floats(1.0, 1e9)
fractions = st.floats(5e-8, 0.9999)  # of the radius
# Of θ's limit; a tilt that is nearly a denormal number has no relative precision.
shares = st.floats(-1.0, 1.0).map(lambda share: share if abs(share) > 1e-150 else 0.0)


@pytest.mark.parametrize(("d", "theta", "force", "energy"), CHECKPOINTS)
def test_force_and_energy_meet_the_checkpoints(
    d: float, theta: float, force: float, energy: float
) -> None:
    c = closed_forms(E, d * 1e-3, math.radians(theta))
    np.testing.assert_allclose(c.force, force, rtol=2e-13)
    np.testing.assert_allclose(c.energy * 1e3, energy, rtol=2e-13)


def test_limit_of_the_tilt() -> None:
    limits = np.degrees(TIP.theta_limit(np.array([2, 4, 6, 8, 10, 12]) * 1e-3))
    np.testing.assert_allclose(limits, [64.158, 53.130, 44.427, 36.870, 30.000, 23.578], atol=5e-4)
    assert TIP.theta_limit(-1.0) == TIP.theta_limit(0.0) == math.pi / 2
    assert TIP.theta_limit(0.02) == TIP.theta_limit(1.0) == 0.0
    assert math.isnan(TIP.theta_limit(math.nan))
    # Its cosine is √(2ad − d²)/a, to all digits even where asin((a − d)/a) has lost them.
    d = 10.0 ** np.arange(-17.0, -2.0)
    np.testing.assert_allclose(
        np.pi / 2 - Fingertip(1.0).theta_limit(d),
        np.arcsin(np.sqrt(d * (2 - d))),
        rtol=1e-7,
        atol=2e-16,
    )


def _complex(modulus: float, d: complex, theta: complex) -> tuple[complex, complex]:
    """Force and energy in complex arithmetic, for derivatives without differences."""
    force = math.pi * modulus * d * d / np.cos(theta)
    return force, force * d / (3 * np.cos(theta))


@given(radius=radii, modulus=moduli, part=fractions, share=shares)
def test_partials_are_the_derivatives(
    radius: float, modulus: float, part: float, share: float
) -> None:
    d = radius * part
    theta = float(Fingertip(radius).theta_limit(d)) * share
    c = closed_forms(modulus, d, theta)
    step = 1e-40
    f_d, u_d = (value.imag / step for value in _complex(modulus, d + 1j * step, theta))
    f_t, u_t = (value.imag / step for value in _complex(modulus, d, theta + 1j * step))
    np.testing.assert_allclose([c.force_d, c.energy_d], [f_d, u_d], rtol=1e-13)
    np.testing.assert_allclose([c.force_theta, c.energy_theta], [f_t, u_t], rtol=1e-12)


def test_shapes_types_and_odd_values() -> None:
    assert closed_forms(E, 0.004, 0.1).force.shape == ()
    assert closed_forms(E, np.empty(0), 0.1).energy.shape == (0,)
    grid = closed_forms(E, np.full((3, 1), 0.004), np.zeros(4))
    assert grid.force.shape == (3, 4)
    assert grid.force.dtype == np.float64
    single = closed_forms(E, np.float32(0.004), np.float32(0.25))
    np.testing.assert_allclose(single.force, closed_forms(E, 0.004, 0.25).force, rtol=1e-6)
    for d in (-1e-3, 0.0, -math.inf):
        assert closed_forms(E, d, 0.2) == (0.0,) * 6
    for pair in [(math.nan, 0.1), (0.004, math.nan), (-1.0, math.nan), (0.004, math.inf)]:
        assert all(math.isnan(value) for value in closed_forms(E, *pair))
    assert closed_forms(E, math.inf, 0.0).force == math.inf
    fortran = np.asfortranarray(np.linspace(1e-3, 8e-3, 6).reshape(2, 3))
    np.testing.assert_array_equal(
        closed_forms(E, fortran, 0.1).force, closed_forms(E, fortran.copy("C"), 0.1).force
    )


@pytest.mark.parametrize("radius", [0.0, -0.02, math.nan, math.inf])
def test_a_tip_needs_a_radius(radius: float) -> None:
    with pytest.raises(ValueError, match="radius must be positive"):
        Fingertip(radius)


def test_a_radius_in_millimetres_is_refused_with_the_metres_it_means() -> None:
    with pytest.raises(ValueError, match=r"in metres, at most 1, not 20; 20 mm is 0\.02"):
        Fingertip(20.0)
