"""Test stress-strain laws from Table I and from measured points, and the laws' kernel tables."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger import Material
from softfinger.kinematics.contact.material import TABLE_I_MODULUS
from softfinger.kinematics.contact.material_fit import MaterialError, nonnegative

STRAIN = np.linspace(0.0, 1.0, 201)


def laws() -> list[Material]:
    """Return stress-strain laws of several kinds; the last law is a polynomial of high degree."""
    x = np.linspace(0.0, 0.8, 30)
    return [
        Material.constant(0.304e6),
        Material.table_i(),
        Material.from_points([0, 0.2, 0.4, 0.6, 0.8, 1.0], [0, 28e3, 61e3, 99e3, 140e3, 186e3]),
        Material.from_points(x, 1e5 * np.tanh(3 * x)),
    ]


def test_constant_modulus():
    material = Material.constant(0.304e6)
    np.testing.assert_allclose(material.stress(STRAIN), 0.304e6 * STRAIN, rtol=1e-15)
    np.testing.assert_allclose(material.energy_density(STRAIN), 0.152e6 * STRAIN**2, rtol=1e-15)
    np.testing.assert_array_equal(material.law, [0.0, 0.304e6])
    assert material.is_linear
    for modulus in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(MaterialError, match="positive"):
            Material.constant(modulus)


def test_table_i_has_the_slopes_of_the_paper():
    material = Material.table_i()
    assert material.reference_modulus == 0.135e6
    assert not material.is_linear
    for tenths, modulus in zip(range(0, 12, 2), TABLE_I_MODULUS, strict=True):
        terms = enumerate(material.coefficients)
        assert sum((j + 1) * c * Fraction(tenths, 10) ** j for j, c in terms) == modulus
    assert material.coefficients[1] == 0  # The law has no linear term.
    slope = np.gradient(material.stress(STRAIN), STRAIN)
    assert np.all(np.diff(slope) > -1e-6 * slope[0])  # The tangent modulus never decreases.
    assert slope.min() * (1 + 1e-12) >= 0.135e6
    assert slope.max() < 0.304e6


@pytest.mark.parametrize("index", range(4))
def test_a_law_is_smooth_increasing_and_consistent(index):
    material = laws()[index]
    stress, energy = material.stress(STRAIN), material.energy_density(STRAIN)
    assert stress[0] == energy[0] == 0.0
    assert np.all(np.diff(stress) > 0)
    # The energy density is the integral of the stress, here computed by Gauss quadrature.
    points, weights = np.polynomial.legendre.leggauss(8)
    inner = STRAIN[:-1, None] + 0.5 * (points + 1) * np.diff(STRAIN)[:, None]
    parts = 0.5 * np.diff(STRAIN) * (material.stress(inner) * weights).sum(axis=1)
    np.testing.assert_allclose(energy[1:], np.cumsum(parts), rtol=1e-12)
    # Evaluate the polynomial exactly, term by term.
    powers = [float(c) for c in material.coefficients]
    for strain in (1e-9, 0.124999, 0.125, 0.3, 0.75, 1.0 - 1e-12):
        exact = math.fsum(c * strain**j for j, c in enumerate(powers, 1))
        scale = math.fsum(abs(c) * strain**j for j, c in enumerate(powers, 1))
        assert abs(material.stress(strain) - exact) <= 3e-15 * scale


@pytest.mark.parametrize("index", range(4))
def test_strains_outside_zero_to_one(index):
    material = laws()[index]
    for strain in (0.0, -0.0, -0.3, -math.inf):
        assert material.stress(strain) == 0.0
        assert material.energy_density(strain) == 0.0
    assert math.isnan(float(material.stress(math.nan)))
    assert math.isnan(float(material.energy_density(math.nan)))
    end, slope = material.stress(1.0), material.stress(2.0) - material.stress(1.0)
    np.testing.assert_allclose(material.stress([1.5, 3.0]), [end + slope / 2, end + 2 * slope])
    np.testing.assert_allclose(
        material.energy_density(2.0) - material.energy_density(1.0), end + slope / 2, rtol=1e-12
    )
    below = (material.stress(1.0) - material.stress(1.0 - 1e-6)) / 1e-6
    np.testing.assert_allclose(slope, below, rtol=1e-4)
    assert material.stress(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("strain", [-1, 0, 0.5, 2.0, math.nan, np.float32(0.5), np.array(0.5)])
def test_numbers_give_numbers(strain):
    for material in laws():
        ratio_too = (material.force_error,) * bool(strain > 0)
        for of in (material.stress, material.energy_density, *ratio_too):
            assert isinstance(of(strain), float)
            assert of([strain, strain]).shape == (2,)
            np.testing.assert_array_equal(of([strain]), of(strain))


def test_a_law_says_what_it_is():
    told = [repr(law) for law in laws()]
    assert told[0] == "Material: constant, E₀ 0.304 MPa, σ of degree 1"
    assert told[1] == "Material: table_i, E₀ 0.135 MPa, σ of degree 7"


def test_a_law_is_recovered_from_its_points():
    original = Material.table_i()
    for x in (np.linspace(0.0, 1.0, 12), np.linspace(0.04, 1.0, 25)):
        again = Material.from_points(x, original.stress(x))
        np.testing.assert_allclose(again.stress(STRAIN), original.stress(STRAIN), atol=2.0)
        assert again.fit_error < 2.0
    line = Material.from_points([0, 0.1, 0.2, 0.5], [0, 1e4, 2e4, 5e4])
    assert line.is_linear
    np.testing.assert_allclose(line.reference_modulus, 1e5, rtol=1e-12)


def test_short_curves_continue_with_their_last_slope():
    x = np.linspace(0.0, 0.5, 20)
    material = Material.from_points(x, 1e5 * (x + x**2))
    np.testing.assert_allclose(material.stress(x[1:]), 1e5 * (x + x**2)[1:], rtol=5e-3)
    slope = (material.stress(1.0) - material.stress(0.6)) / 0.4
    assert 1.6e5 < slope < 2.1e5


@given(
    steps=st.lists(st.floats(0.2, 5.0), min_size=5, max_size=20),
    scale=st.floats(1.0, 1e9),
)
@settings(max_examples=60)
def test_any_increasing_points_give_an_increasing_law_or_a_reason(steps, scale):
    x = np.linspace(0.0, 1.0, len(steps) + 1)
    y = scale * np.concatenate([[0.0], np.cumsum(steps)])
    try:
        material = Material.from_points(x, y)
    except MaterialError as error:
        assert "no smooth monotonic law" in str(error)  # noqa: PT017
        return
    assert np.all(np.diff(material.stress(STRAIN)) > 0)
    assert np.max(np.abs(material.stress(x) - y)) <= material.fit_error * (1 + 1e-6) + 1e-9 * y[-1]
    assert material.fit_error <= 0.05 * y[-1]


def test_the_force_error_equals_the_effect_of_the_misfit_on_the_force():
    x = np.linspace(0.025, 1.0, 40)
    curve = 1e5 * x**0.7
    law = Material.from_points(x, curve)
    # Compare the force of an upright tip, F = 2π h² ∫ σ/(1 − ε)³ dε, for the measured curve and for
    # the law.
    for share in (0.05, 0.1, 0.3):
        strain = share * (np.arange(2000) + 0.5) / 2000
        weight = (1.0 - strain) ** -3
        true = (1e5 * strain**0.7 * weight).sum()
        missed = abs((law.stress(strain) * weight).sum() / true - 1.0)
        assert 0.6 * missed < law.force_error(share) < 1.5 * missed + 0.02
    assert Material.table_i().force_error([0.1, 0.5]).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("strain", "stress", "words"),
    [
        ([0, 0.5, 1], [0, 1, 2], "too few points: found 3"),
        ([0, 0.2, 0.4, 0.6], [0, 2, 1, 3], "not monotonic.*point 3 has 1 Pa after 2 Pa"),
        ([0, 0.2, 0.4, 0.6], [0, 2, 2, 3], "not monotonic"),
        ([0, 0.4, 0.2, 0.6], [0, 1, 2, 3], "strain must increase, but point 3"),
        (
            [0, 0.2, 0.4, 0.6],
            [1, 2, 3, 4],
            "must start at zero stress, but its first point has 1 Pa",
        ),
        ([0.1, 0.2, 0.4, 0.6], [-1, 2, 3, 4], "must start at zero"),
        ([-0.1, 0.2, 0.4, 0.6], [-1, 2, 3, 4], "must not be negative"),
        ([0, 0.2, math.nan, 0.6], [0, 2, 3, 4], "point 3 is not finite"),
        ([0, 0.2, 0.4, 0.6], [0, 2, math.inf, 4], "point 3 is not finite"),
        ([0, 20, 40, 100], [0, 2, 3, 4], "not a percentage"),
        ([0, 0.2, 0.4], [0, 2, 3, 4], "equal length"),
        ([0, 0.5, 1.2, 1.4], [0, 2, 3, 4], "too few points between"),
        ([0, 0.1, 0.2, 0.3, 0.31, 0.9], [0, 1, 2, 3, 90, 91], "no smooth monotonic law"),
    ],
)
def test_refusals_name_the_problem(strain, stress, words):
    with pytest.raises(MaterialError, match=words):
        Material.from_points(strain, stress)


def test_all_problems_are_in_one_report():
    with pytest.raises(MaterialError) as error:
        Material.from_points([0, 0.4, 0.2], [5, 2, 1])
    for words in ("too few", "strain must increase", "not monotonic", "must start at zero"):
        assert words in str(error.value)


def test_nonnegative_least_squares_satisfies_the_optimality_conditions():
    from scipy.optimize import nnls

    rng = np.random.default_rng(3)
    for _ in range(30):
        matrix, right = rng.normal(size=(12, 6)), rng.normal(size=12)
        np.testing.assert_allclose(
            nonnegative(matrix, right), nnls(matrix, right)[0], atol=1e-9, rtol=1e-9
        )
