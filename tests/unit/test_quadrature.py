"""The reference integrals, against plain NumPy in other coordinates."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss

from softfinger import Fingertip, Material
from softfinger.kinematics.contact.closed_form import closed_forms
from softfinger.kinematics.contact.quadrature import circle_rule, gauss_rule, integrate, ratios_at

TIP = Fingertip(0.020)
TABLE_I = Material.table_i()
X = np.linspace(0.0, 0.8, 30)
STIFFENING = Material.from_points(X, 2e4 * np.expm1(3 * X))
SOFTENING = Material.from_points(X, 1e5 * np.tanh(2 * X))
MATERIALS = [Material.constant(0.304e6), TABLE_I, STIFFENING, SOFTENING]


def twin(
    tip: Fingertip, material: Material, d: complex, theta: complex, nodes: int = 110
) -> tuple[complex, complex]:
    """F and U by Gauss quadrature on the base plane, x = h s + ρ c sin t, y = b sin τ.

    Complex arguments give exact derivatives by the complex step.
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
def test_values_and_partials_equal_the_twin(material: Material, d: float, share: float) -> None:
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


def test_a_constant_modulus_gives_the_closed_form() -> None:
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
def test_more_nodes_change_nothing_anywhere(depth: float, share: float) -> None:
    h = 1.0 - depth
    limit = math.atan2(h, math.sqrt(depth * (1 + h)))
    s, c = math.sin(limit * share), math.cos(limit * share)
    for material, tolerance in ((TABLE_I, 2e-13), (STIFFENING, 1e-12)):
        parts = material.expansions()
        place = np.array([[depth], [h], [s], [c]])
        usual, finer = np.empty((2, 5, 1))
        ratios_at(gauss_rule(), circle_rule(material.degree), parts, *place, usual)
        ratios_at(gauss_rule(40), circle_rule(40), parts, *place, finer)
        # ∂F/∂θ may pass through zero: to F tan θ, whose ratio is that of F.
        scale = np.abs(finer)
        scale[3] = max(scale[3], scale[0])
        assert np.all(np.abs(np.subtract(usual, finer)) <= tolerance * scale)


@given(
    slopes=st.lists(st.floats(0.05, 20.0), min_size=2, max_size=7),
    depth=st.floats(5e-8, 0.999),
    share=st.floats(-1.0, 1.0).map(lambda share: share * (1 - 1e-9)),
)
@settings(max_examples=60)
def test_every_admissible_material_has_its_least_energy_upright(
    slopes: list[float], depth: float, share: float
) -> None:
    """Tangent moduli that are any positive Bernstein polynomial: laws of all curvatures."""
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


def test_outside_the_domain() -> None:
    assert integrate(TIP, TABLE_I, -1e-3, 0.1) == (0.0,) * 6
    for pair in [(0.021, 0.0), (8e-3, 0.7), (8e-3, 3.2), (math.nan, 0), (1e-3, math.nan)]:
        assert all(math.isnan(value) for value in integrate(TIP, TABLE_I, *pair))
    assert integrate(TIP, TABLE_I, np.empty((0, 2)), 0.0).force.shape == (0, 2)
    assert integrate(TIP, TABLE_I, [[1e-3], [2e-3]], [0.0, 0.1, 0.2]).energy.shape == (2, 3)
