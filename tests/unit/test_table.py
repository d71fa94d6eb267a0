"""Test the accuracy, error bounds, forms, files and edge cases of contact tables."""

import functools
import math
import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger import ContactTable, Fingertip, Material
from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.contact.closed_form import closed_forms
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table_record import TableError
from tests.harness.paper_tip import LINEAR as CONSTANT
from tests.harness.paper_tip import MEASURED as TABLE_I
from tests.harness.paper_tip import TIP

X = np.linspace(0.0, 0.8, 30)
STIFFENING = Material.from_points(X, 2e4 * np.expm1(3 * X))
Y = np.linspace(0.025, 1.0, 40)
HARD = {
    "stiffening": STIFFENING,
    "kinked": Material.from_points(Y, 1e5 * np.where(Y < 0.3, Y, 3.0 * Y - 0.6)),
    "ogden": Material.from_points(Y, 1e5 * ((1.0 - 0.6 * Y) ** -2 - (1.0 - 0.6 * Y)) / 3.0),
    "s-shaped": Material.from_points(Y, 1e5 * (Y + 0.12 * np.sin(6.0 * Y))),
    "root": Material.from_points(Y, 1e5 * Y**0.7),
}
# In a loop, the compiler may fuse other multiplications and additions than in a function call.
FUSED = 1e-12
OUTPUTS = ("force", "energy", "force_d", "force_theta", "energy_d", "energy_theta")


pytestmark = pytest.mark.filterwarnings("ignore:the material law deviates")


@pytest.fixture(scope="module")
def table() -> ContactTable:
    return ContactTable.build(TIP, TABLE_I, 1e-9)


# Material law and tolerance for each number of pieces.
SPLITS = {
    1: (TABLE_I, 1e-6),
    2: (TABLE_I, 1e-9),
    4: (HARD["root"], 1e-9),
}


@functools.cache
def split(pieces: int) -> ContactTable:
    return ContactTable.build(TIP, *SPLITS[pieces])


def worst(table: ContactTable, material: Material, d: np.ndarray, theta: np.ndarray) -> float:
    """Return the maximum relative error over all outputs, as in `Certificate`; 0/0 counts as 0."""
    found = table(d, theta)
    exact = integrate(table.tip, material, d, theta, nodes=40)
    errors = []
    for name in OUTPUTS:
        value, truth = getattr(found, name), getattr(exact, name)
        scale = np.abs(truth)
        if name == "force_theta":
            scale = np.maximum(scale, np.abs(exact.force * np.tan(theta)))
        same = (value == truth) | ((theta == 0.0) & (np.abs(value) < 1e-300))
        errors.append(np.abs(value - truth) / np.where(same, 1.0, scale) * ~same)
    return float(np.max(errors))


def hard_points(
    radius: float, points: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random d [m] and θ [rad]; many points are near the edges and corners of the domain."""
    which = rng.integers(0, 9, points)
    small = 10.0 ** rng.uniform(-9.0, -0.3, points)
    least = 10.0 ** rng.uniform(-16.0, -0.3, points)
    even = rng.uniform(0.0, 1.0, points)
    d = np.where(which < 3, small, np.where(which < 5, 1.0 - least, even)) * 0.875 * radius
    d[:3] = 0.875 * radius
    limit = Fingertip(radius).theta_limit(d)
    near = 10.0 ** rng.uniform(-12.0, 0.0, points)
    kind = np.where(which % 3 == 0, rng.uniform(0.0, 1.0, points), 1.0 - near)
    kind = np.where(rng.integers(0, 8, points) == 0, near, kind)
    kind = np.where(rng.integers(0, 30, points) == 0, 1.0, kind)
    theta = np.minimum(limit * kind, limit) * rng.choice([-1.0, 1.0], points)
    return d, theta


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("material", [CONSTANT, TABLE_I], ids=["constant", "table_i"])
def test_tolerance_holds_over_the_whole_domain(material, tolerance):
    table = ContactTable.build(TIP, material, tolerance)
    d, theta = hard_points(TIP.radius, 4000, np.random.default_rng(99))
    assert worst(table, material, d, theta) <= table.max_error <= tolerance
    assert table.data.nbytes <= 1024 * 1024
    assert np.all(table(d, theta).inside)


@pytest.mark.parametrize("name", HARD)
def test_tolerance_holds_for_laws_from_points(name):
    test_tolerance_holds_over_the_whole_domain(HARD[name], 1e-9)


@pytest.mark.parametrize("pieces", SPLITS)
def test_table_errors_are_below_their_certificate_but_close_to_it(pieces):
    table, (material, _) = split(pieces), SPLITS[pieces]
    assert table.form == f"springs, {pieces} a slab"
    certificate = table.certificate
    d, theta = hard_points(TIP.radius, 3000, np.random.default_rng(5))
    d, theta = np.append(d, certificate.d), np.append(theta, certificate.theta)
    error = worst(table, material, d, theta)
    assert error <= certificate.max_error
    assert error >= (0.1 if error > 1e-12 else 0.0) * certificate.max_error
    at = worst(table, material, np.array([certificate.d]), np.array([certificate.theta]))
    assert at >= (0.25 if error > 1e-12 else 0.0) * error


def test_a_constant_modulus_gives_the_closed_form():
    table = ContactTable.build(TIP, CONSTANT, 4e-15)
    assert table.form == "closed"
    d, theta = hard_points(TIP.radius, 4000, np.random.default_rng(1))
    inner = np.abs(theta) < 0.999 * TIP.theta_limit(d)
    found, exact = table(d[inner], theta[inner]), closed_forms(0.304e6, d[inner], theta[inner])
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=4e-15)
    force = [3.8201766667652, 70.578560861082]
    np.testing.assert_allclose(table([2e-3, 8e-3], np.radians([0, 30])).force, force, rtol=1e-13)


@given(depth=st.floats(5e-8, 0.875), share=st.floats(-1.0, 1.0))
def test_symmetry_sign_and_monotonicity(table, depth, share):
    d = depth * TIP.radius
    theta = float(TIP.theta_limit(d)) * share
    c = table(d, theta)
    assert c.inside
    np.testing.assert_allclose(c.energy_d, c.force / math.cos(theta), rtol=1e-14)
    mirrored = table(d, -theta)
    assert (mirrored.force, mirrored.energy) == (c.force, c.energy)
    assert (mirrored.force_theta, mirrored.energy_theta) == (-c.force_theta, -c.energy_theta)
    assert c.energy > 0
    assert c.force_d > 0
    assert table(d, 0.0).energy <= c.energy * (1 + 1e-9)
    assert c.energy_theta * theta >= 0


@pytest.mark.parametrize("modulus", [1.0, 1e9])
@pytest.mark.parametrize("radius", [1e-4, 1.0])
def test_scaling_with_radius_and_modulus(table, radius, modulus):
    """Test radii from 0.1 mm to 1 m, and zero-strain moduli from 1 Pa to 1 GPa."""
    scale, share = radius / TIP.radius, Fraction(modulus) / TABLE_I.coefficients[0]
    other = Material(tuple(value * share for value in TABLE_I.coefficients))
    large = ContactTable.build(Fingertip(radius), other, 1e-9)
    assert large.max_error <= 1e-9
    d, theta = np.meshgrid([1e-9, 1e-5, 4e-3, 8e-3, 0.0149], [-0.2, 0.0, 0.1])
    a, b = large(scale * d, theta), table(d, theta)
    assert np.all(a.inside)
    ratio = float(share) * scale**2
    for value, expected, power in zip(a, b[:6], (0, 1, -1, 0, 0, 1), strict=False):
        np.testing.assert_allclose(value, ratio * scale**power * expected, rtol=3e-12)


def test_pieces_are_continuous_at_their_edges(table):
    edges = [*(0.125 * 2.0 ** (np.arange(13) / 4)), 0.15625, 0.1875, 0.25, 0.5, 0.75]
    for h in edges:
        d = TIP.radius * (1 - h * (1 + np.array([-1e-12, 0.0, 1e-12])))
        theta = 0.7 * TIP.theta_limit(d)
        keep = d > 0
        assert worst(table, TABLE_I, d[keep], theta[keep]) < 1e-9


def test_lookups_outside_the_domain_cause_a_warning(table):
    d = np.array([-1e-3, 0.0, math.nan, 0.004, 0.018, 0.0175, 0.004])
    theta = np.array([0.0, 9.0, 0.0, 1.5, 0.0, 0.0, math.nan])
    with pytest.warns(RuntimeWarning, match=r"2 of 7 points .* at d = 4 mm, θ = 85.9°") as caught:
        table(d, theta)
    assert [each.filename for each in caught] == [__file__]
    assert table(d, theta, edge=True).inside.sum() == 3
    table(d[:3], theta[:3])  # This call must not warn.
    table(0.008, -float(TIP.theta_limit(0.008)) * (1.0 + 1e-15))


@pytest.mark.filterwarnings("ignore:.* outside the contact table")
@pytest.mark.parametrize("kind", [float, np.float64, np.float32, np.array, int])
@pytest.mark.parametrize("point", [(0.004, 0.2), (0.03, 2.0), (-1.0, 0.0), (math.nan, 0.1)])
def test_numbers_give_numbers_and_arrays_give_arrays(table, kind, point):
    if kind is int and math.isnan(point[0]):
        return
    d, theta = map(kind, point)
    found = table(d, theta)
    assert {type(each) for each in found} == {float, bool}
    np.testing.assert_array_equal(found, table(float(d), float(theta)))
    whole = table(np.array([d]), theta)
    assert {each.shape for each in whole[:7]} == {(1,)}
    np.testing.assert_allclose([each[0] for each in whole[:7]], found[:7], rtol=FUSED)


def test_a_table_says_what_it_is(table):
    told = r"ContactTable: springs, 2 a slab, radius 20 mm, relative error at most \d\.\de-1\d"
    assert re.fullmatch(told, repr(table))


@pytest.mark.filterwarnings("ignore:.* outside the contact table")
def test_values_outside_the_domain_are_clamped_and_flagged(table):
    limit = float(TIP.theta_limit(0.008))
    edge = table(0.008, limit)
    assert edge.inside
    for theta in (limit + 1e-9, 0.7, 1.5, math.pi / 2, 2.0, math.pi, 1e9, math.inf):
        for sign in (1, -1):
            c = table(0.008, sign * theta)
            assert not c.inside
            # The test and the lookup may round the limit differently.
            assert c.force == pytest.approx(edge.force, rel=FUSED)
            assert c.energy_theta == pytest.approx(sign * edge.energy_theta, rel=FUSED)
    for theta in (0.0, 0.1, -0.12):
        full = table(0.0175, theta)
        assert full.inside
        for d in (0.0175 * (1 + 1e-11), 0.02, 1.0, 1e300, math.inf):
            c = table(d, theta)
            assert not c.inside
            assert c.force == pytest.approx(full.force, rel=FUSED)
    for d in (0.0, -0.0, -1e-3, -math.inf):
        c = table(d, 0.3)
        assert c.inside
        assert all(getattr(c, name) == 0.0 for name in OUTPUTS)
    for pair in [(math.nan, 0.1), (0.004, math.nan), (-1.0, math.nan), (math.nan, math.nan)]:
        c = table(*pair)
        assert not c.inside
        assert all(math.isnan(getattr(c, name)) for name in OUTPUTS)


@pytest.fixture(scope="module")
def forms() -> list[ContactTable]:
    """Return the closed form, and one table for each number of pieces."""
    return [ContactTable.build(TIP, CONSTANT), *map(split, SPLITS)]


@pytest.mark.filterwarnings("error")
def test_an_array_of_one_value_causes_no_warning(table):
    assert table(np.array([2e-3]), 0.1).force == pytest.approx([table(2e-3, 0.1).force], rel=FUSED)


def test_output_shapes_and_types(table):
    halves = np.linspace(-1e-3, 8e-3, 9, dtype=np.float32)
    np.testing.assert_array_equal(
        table(halves, np.float32(0.25)).force, table(halves.astype(float), 0.25).force
    )
    assert table(np.full((3, 1), 0.004), np.zeros(4)).inside.shape == (3, 4)


@pytest.mark.parametrize("wrong", [None, "0.004", True, 0.004 + 0j, [None, 0.1], [True], ["a"]])
def test_input_that_is_not_real_is_refused(table, wrong):
    for pair in ((wrong, 0.1), (0.004, wrong)):
        with pytest.raises(TypeError, match="d and θ must be real numbers"):
            table(*pair)


@pytest.mark.filterwarnings("ignore:.* outside the contact table")
def test_scalar_lookups_equal_array_lookups(forms):
    d, theta = hard_points(TIP.radius, 100, np.random.default_rng(11))
    odd = [-1.0, 0.0, 0.02, 0.03, math.inf, math.nan, 0.004, 0.004, 0.004, 1e-9, 0.0174]
    tilts = [0.3, 0.3, 0.0, 0.1, 0.2, 0.1, math.nan, -math.inf, 1.4, -1.57, 0.001]
    d, theta = np.concatenate([d, odd]), np.concatenate([theta, tilts])
    for table in forms:
        many = table(d, theta)
        for i in range(d.size):
            one = table(float(d[i]), float(theta[i]))
            assert type(one.force) is float
            assert type(one.inside) is bool
            same = [v[i] for v in many[:7]] + [many.max_error]
            np.testing.assert_allclose(one, same, rtol=FUSED)


def test_a_law_far_from_its_points_causes_a_warning():
    with pytest.warns(RuntimeWarning, match=r"the force by up to 11\.0%; expected at most 5%"):
        ContactTable.build(Fingertip(0.02), HARD["root"], 1e-6)


def test_invalid_tables_are_refused():
    with pytest.raises(TableError, match="meets the tolerance 1e-17; the smallest error"):
        ContactTable.build(TIP, CONSTANT, 1e-17)
    with pytest.raises(TableError, match="the smallest error reached is") as error:
        ContactTable.build(TIP, STIFFENING, 1e-15)
    best = float(str(error.value).split()[-1])
    assert ContactTable.build(TIP, STIFFENING, 1.01 * best).max_error <= 1.01 * best
    for tolerance in (0.0, -1.0, 1.0, math.nan):
        with pytest.raises(TableError, match="between 0 and 1"):
            ContactTable.build(TIP, TABLE_I, tolerance)


def test_hands_in_one_process_share_their_table():
    assert make_table(Settings(), TABLE_I) is make_table(Settings(), TABLE_I)
    coarser = make_table(Settings.model_validate({"table": {"tolerance": 1e-5}}), TABLE_I)
    assert make_table(Settings(), TABLE_I).max_error <= 1e-9 < coarser.max_error <= 1e-5
