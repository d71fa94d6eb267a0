"""Test the closed forms and the reference integrals of a tip against integrals by NumPy."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss

from softfinger import Fingertip, Material
from softfinger.kinematics.contact.closed_form import (
    closed_forms,
)
from softfinger.kinematics.contact.quadrature import circle_rule, gauss_rule, integrate, ratios_at
from tests.harness.paper_tip import CHECKPOINTS, LINEAR, TIP, E
from tests.harness.paper_tip import MEASURED as TABLE_I

X = np.linspace(0.0, 0.8, 30)
STIFFENING = Material.from_points(X, 2e4 * np.expm1(3 * X))
SOFTENING = Material.from_points(X, 1e5 * np.tanh(2 * X))
MATERIALS = [LINEAR, TABLE_I, STIFFENING, SOFTENING]


def twin(
    tip: Fingertip, material: Material, d: complex, theta: complex, nodes: int = 110
) -> tuple[complex, complex]:
    """Return F and U by Gauss quadrature on the base plane.

    The variables are t and τ, where x = h s + ρ c sin t and y = b sin τ. Complex arguments are
    valid, so complex steps give exact derivatives.
    """
    a, s, c = tip.radius, np.sin(theta), np.cos(theta)
    h = a - d
    rho = np.sqrt(2 * a * d - d * d)
    points, weights = leggauss(nodes)
    t, tau = 0.5 * np.pi * points[:, None], 0.5 * np.pi * points[None, :]
    x = h * s + rho * c * np.sin(t)
    b = rho * np.cos(t)
    z = np.sqrt(a * a - x * x - (b * np.sin(tau)) ** 2)
    area = (0.5 * np.pi) ** 2 * weights[:, None] * weights * rho * c * np.cos(t) * b * np.cos(tau)
    strain = 1 - (h - x * s) / (c * z)
    stress = np.zeros_like(strain)
    energy = np.zeros_like(strain)
    for j, coefficient in reversed(list(enumerate(material.coefficients, 1))):
        stress = (stress + float(coefficient)) * strain
        energy = (energy + float(coefficient) / (j + 1)) * strain
    return (area * stress).sum(), (area * z * energy * strain).sum()


@pytest.mark.parametrize("material", MATERIALS, ids=["constant", "table_i", "stiff", "soft"])
@pytest.mark.parametrize(
    ("d", "share"), [(0.5e-3, 0.0), (2e-3, 0.7), (4e-3, -0.5), (8e-3, 0.8), (12e-3, 0.6)]
)
def test_values_and_partial_derivatives_match_independent_quadrature(material, d, share):
    theta = float(TIP.theta_limit(d)) * share
    c = integrate(TIP, material, d, theta)
    force, energy = twin(TIP, material, d, theta)
    np.testing.assert_allclose([c.force, c.energy], [force, energy], rtol=1e-12)
    step = 1e-30
    f_d, u_d = (value.imag / step for value in twin(TIP, material, d + 1j * step, theta))
    f_t, u_t = (value.imag / step for value in twin(TIP, material, d, theta + 1j * step))
    np.testing.assert_allclose([c.force_d, c.energy_d], [f_d, u_d], rtol=2e-12)
    scale = 1e-13 * float(c.force)
    np.testing.assert_allclose(c.force_theta, f_t, rtol=2e-12, atol=scale)
    np.testing.assert_allclose(c.energy_theta, u_t, rtol=2e-12, atol=scale * d)


def test_a_constant_modulus_gives_the_closed_form():
    d = np.array([1e-11, 1e-6, 4e-3, 0.0199, 0.02])[:, None]
    theta = TIP.theta_limit(d) * np.array([-1.0, -0.3, 0.0, 1 - 1e-9])
    exact = closed_forms(0.304e6, d, theta)
    for value, expected in zip(integrate(TIP, MATERIALS[0], d, theta), exact, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-14)


@given(
    depth=st.one_of(
        st.floats(5e-8, 0.999999),
        st.floats(-12.0, -0.3).map(lambda e: 1 - 10**e),
    ),
    share=st.one_of(st.floats(0.0, 1.0), st.floats(-12.0, -0.1).map(lambda e: 1 - 10**e)),
)
def test_more_nodes_do_not_change_the_result(depth, share):
    h = 1.0 - depth
    limit = math.atan2(h, math.sqrt(depth * (1 + h)))
    s, c = math.sin(limit * share), math.cos(limit * share)
    for material, tolerance in ((TABLE_I, 2e-13), (STIFFENING, 1e-12)):
        parts = material.expansions()
        place = np.array([[depth], [h], [s], [c]])
        usual, finer = np.empty((2, 5, 1))
        ratios_at(gauss_rule(), circle_rule(material.degree), parts, *place, usual)
        ratios_at(gauss_rule(40), circle_rule(40), parts, *place, finer)
        # Scale the error of ∂F/∂θ by F tan θ, because ∂F/∂θ may pass through zero.
        scale = np.abs(finer)
        scale[3] = max(scale[3], scale[0])
        assert np.all(np.abs(np.subtract(usual, finer)) <= tolerance * scale)


@given(
    slopes=st.lists(st.floats(0.05, 20.0), min_size=2, max_size=7),
    depth=st.floats(5e-8, 0.999),
    share=st.floats(-1.0, 1.0).map(lambda share: share * (1 - 1e-9)),
)
@settings(max_examples=60)
def test_every_admissible_material_has_its_minimum_energy_upright(slopes, depth, share):
    """Draw the tangent modulus as a random positive Bernstein polynomial."""
    n = len(slopes) - 1
    modulus = np.polynomial.Polynomial([0.0])
    for k, slope in enumerate(slopes):
        rise, fall = np.polynomial.Polynomial([0, 1]), np.polynomial.Polynomial([1, -1])
        modulus = modulus + 1e5 * slope * math.comb(n, k) * rise**k * fall ** (n - k)
    material = Material(tuple(Fraction(value) for value in modulus.integ().coef[1:]))
    d = depth * TIP.radius
    tilts = float(TIP.theta_limit(d)) * np.array([0.0, 0.5 * share, share])
    c = integrate(TIP, material, d, tilts)
    assert np.all(c.energy > 0)
    assert np.all(c.force_d > 0)
    assert np.all(np.diff(c.energy) >= -1e-13 * c.energy[0])
    assert np.all(c.energy_theta * tilts >= 0)
    assert c.energy_theta[0] == 0.0
    np.testing.assert_allclose(c.energy_d, c.force / np.cos(tilts), rtol=1e-13)
    deeper = integrate(TIP, material, min(d * (1 + 1e-6), TIP.radius), 0.0)
    assert deeper.force > c.force[0]


def test_values_outside_the_domain():
    assert integrate(TIP, TABLE_I, -1e-3, 0.1) == (0.0,) * 6
    for pair in [(0.021, 0.0), (8e-3, 0.7), (8e-3, 3.2), (math.nan, 0), (1e-3, math.nan)]:
        assert all(math.isnan(value) for value in integrate(TIP, TABLE_I, *pair))
    assert integrate(TIP, TABLE_I, [[1e-3], [2e-3]], [0.0, 0.1, 0.2]).energy.shape == (2, 3)


radii = st.floats(1e-4, 1.0)
moduli = st.floats(1.0, 1e9)
fractions = st.floats(5e-8, 0.9999)  # fraction of the radius
# Fraction of the limit of θ. Tilts below 1e-150 become 0, because denormal numbers have no relative
# precision.
shares = st.floats(-1.0, 1.0).map(lambda share: share if abs(share) > 1e-150 else 0.0)


@pytest.mark.parametrize(("d", "theta", "force", "energy"), CHECKPOINTS)
def test_force_and_energy_match_the_checkpoints(d, theta, force, energy):
    c = closed_forms(E, d * 1e-3, math.radians(theta))
    np.testing.assert_allclose(c.force, force, rtol=2e-13)
    np.testing.assert_allclose(c.energy * 1e3, energy, rtol=2e-13)


def test_tilt_limit():
    limits = np.degrees(TIP.theta_limit(np.array([2, 4, 6, 8, 10, 12]) * 1e-3))
    np.testing.assert_allclose(limits, [64.158, 53.130, 44.427, 36.870, 30.000, 23.578], atol=5e-4)
    assert TIP.theta_limit([-1.0, 0.0]) == pytest.approx(math.pi / 2, rel=1e-14)
    assert TIP.theta_limit(0.02) == TIP.theta_limit(1.0) == 0.0
    assert math.isnan(TIP.theta_limit(math.nan))
    assert all(isinstance(TIP.theta_limit(d), float) for d in (0, 0.004, np.array(0.03)))
    # The cosine of the limit is √(2ad − d²)/a, which is accurate for any d. asin((a − d)/a) is not.
    d = 10.0 ** np.arange(-17.0, -2.0)
    np.testing.assert_allclose(
        np.pi / 2 - Fingertip(1.0).theta_limit(d),
        np.arcsin(np.sqrt(d * (2 - d))),
        rtol=1e-7,
        atol=2e-16,
    )


def _complex(modulus: float, d: complex, theta: complex) -> tuple[complex, complex]:
    """Return force and energy for complex arguments, so that complex steps give derivatives."""
    force = math.pi * modulus * d * d / np.cos(theta)
    return force, force * d / (3 * np.cos(theta))


@given(radius=radii, modulus=moduli, part=fractions, share=shares)
def test_partial_derivatives_match_complex_steps(radius, modulus, part, share):
    d = radius * part
    theta = float(Fingertip(radius).theta_limit(d)) * share
    c = closed_forms(modulus, d, theta)
    step = 1e-40
    f_d, u_d = (value.imag / step for value in _complex(modulus, d + 1j * step, theta))
    f_t, u_t = (value.imag / step for value in _complex(modulus, d, theta + 1j * step))
    np.testing.assert_allclose([c.force_d, c.energy_d], [f_d, u_d], rtol=1e-13)
    np.testing.assert_allclose([c.force_theta, c.energy_theta], [f_t, u_t], rtol=1e-12)


def test_shapes_types_and_special_values():
    grid = closed_forms(E, np.full((3, 1), 0.004), np.zeros(4))
    assert grid.force.shape == (3, 4)
    for d in (-1e-3, 0.0, -math.inf):
        assert closed_forms(E, d, 0.2) == (0.0,) * 6
    for pair in [(math.nan, 0.1), (0.004, math.nan), (-1.0, math.nan), (0.004, math.inf)]:
        assert all(math.isnan(value) for value in closed_forms(E, *pair))
    assert closed_forms(E, math.inf, 0.0).force == math.inf


@pytest.mark.parametrize("radius", [0.0, -0.02, math.nan, math.inf])
def test_a_tip_needs_a_radius(radius):
    with pytest.raises(ValueError, match="radius must be positive"):
        Fingertip(radius)


def test_a_radius_in_millimetres_is_refused_with_the_value_in_metres():
    with pytest.raises(ValueError, match=r"in metres, at most 1, got 20; 20 mm is 0\.02 m"):
        Fingertip(20.0)
