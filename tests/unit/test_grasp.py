"""The reference grasp: closed forms of the symmetric grasp, and steering."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from tests.harness.grasp import (
    Grasp,
    sheared_contact,
)
from tests.harness.reference_hand import ReferenceHand

MODULUS = 0.304e6
TIP = Fingertip(radius=0.020)
WIDTH = 0.040

# d [mm], q [°], N [N], N times its lever arm [mN·m], for L 80, B 50, W 40, e 0, a 20 mm.
SYMMETRIC = [
    (2, 8.6269265587, 3.8421597806, 303.895166),
    (4, 10.0786581078, 15.4013956785, 1213.098241),
    (6, 11.5369590328, 34.7397315634, 2723.027716),
    (8, 13.0028781629, 61.9376635610, 4827.960422),
]


@pytest.fixture(scope="module")
def paper() -> ContactTable:
    return ContactTable.build(TIP, Material.constant(MODULUS))


@pytest.fixture(scope="module")
def table_i() -> ContactTable:
    return ContactTable.build(TIP, Material.table_i(), tolerance=1e-6)


@pytest.fixture(params=["paper", "table_i"])
def table(request) -> ContactTable:
    return request.getfixturevalue(request.param)


def closed_energy(d, theta, shear, modulus=MODULUS):
    """Energy of the parallel-distributed model with a tangential displacement."""
    c, t = np.cos(theta), np.tan(theta)
    return math.pi * modulus * (d**3 / (3 * c**2) + d**2 * shear * t + d * shear**2)


def test_sheared_energy_equals_its_closed_form_and_checkpoint(paper):
    energy = sheared_contact(paper.data, 0.006, math.radians(20), 0.0015)[0]
    assert energy == pytest.approx(0.10953644560057, rel=1e-12)
    generator = np.random.default_rng(1)
    for _ in range(100):
        d = generator.uniform(1e-4, 0.010)
        theta = generator.uniform(-0.5, 0.5)
        shear = generator.uniform(-0.5, 0.5) * d
        found = sheared_contact(paper.data, d, theta, shear)[0]
        assert found == pytest.approx(closed_energy(d, theta, shear), rel=1e-11)


def test_sheared_partials_are_the_gradient_for_any_material(table):
    generator = np.random.default_rng(2)
    step = 1e-7
    for _ in range(50):
        at = np.array([generator.uniform(1e-3, 0.010), generator.uniform(-0.5, 0.5), 0.0])
        at[2] = generator.uniform(-0.4, 0.4) * at[0]
        partials = sheared_contact(table.data, *at)[1:4]
        for j in range(3):
            ahead, behind = at.copy(), at.copy()
            ahead[j] += step
            behind[j] -= step
            slope = (
                sheared_contact(table.data, *ahead)[0] - sheared_contact(table.data, *behind)[0]
            ) / (2 * step)
            assert partials[j] == pytest.approx(slope, rel=2e-6, abs=2e-6)


@pytest.mark.parametrize(("d", "degrees", "normal", "moment"), SYMMETRIC)
def test_symmetric_grasp_table(paper, d, degrees, normal, moment):
    grasp = Grasp(ReferenceHand(), paper, WIDTH)
    state = grasp.symmetric(d * 1e-3)
    forces = grasp.forces(state)
    np.testing.assert_allclose(np.degrees(state.q), degrees, rtol=1e-10)
    np.testing.assert_allclose(forces.normal, normal, rtol=1e-10)
    np.testing.assert_allclose(forces.tangential, 0, atol=1e-12)
    lever = 0.080 * np.cos(state.q)
    np.testing.assert_allclose(forces.normal * lever * 1e3, moment, rtol=1e-8)
    # A joint also bears the moment by which the tilted tip turns; it is 0.1 to 0.4 % here.
    turning = forces.turning * [1, -1]
    np.testing.assert_allclose(forces.torque, forces.normal * lever + turning, rtol=1e-12)
    np.testing.assert_allclose(grasp.gradient(state)[2:], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("degrees", "gain"), [(0.01, 1.5207), (1, 1.520), (5, 1.5076), (10, 1.471)]
)
def test_steering_gain(paper, degrees, gain):
    grasp = Grasp(ReferenceHand(), paper, WIDTH)
    delta = math.radians(degrees)
    turned = grasp.steer(grasp.symmetric(0.004), delta)
    # The sign: fingers to the right turn the object to the left, counter-clockwise.
    assert turned.pose[2] / delta == pytest.approx(gain, abs=4e-4)
    assert grasp.steer(grasp.symmetric(0.004), -delta).pose[2] == pytest.approx(
        -turned.pose[2], rel=1e-9
    )
