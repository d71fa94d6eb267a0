"""The hand's planar geometry against plain NumPy; the tests' own reference hand and grasp."""

import math

import numpy as np
import pytest

from tests.harness.grasp import Grasp, sheared_contact
from tests.harness.paper_tip import E
from tests.harness.plant import PAPER
from tests.harness.reference_hand import ReferenceHand

HANDS = [
    ReferenceHand(),
    ReferenceHand(pivot_separation=0.07, finger_length=0.06, finger_offset=0.012, tip_radius=0.012),
    ReferenceHand(finger_offset=-0.02),
]
WIDTH = 0.04


def random_states(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(3)
    return [
        (
            generator.uniform(-0.4, 0.9, 2),
            generator.uniform([-0.02, 0.04, -0.5], [0.02, 0.1, 0.5]),
        )
        for _ in range(count)
    ]


def rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def contacts_by_rotation(hand: ReferenceHand, q, pose, width) -> np.ndarray:
    """The plain twin: fingers as rotated vectors, the object's frame as a rotation matrix."""
    local = np.array([hand.finger_offset, hand.finger_length])
    left = np.array([-hand.half_separation, 0]) + rotation(-q[0]) @ local
    right = np.array([hand.half_separation, 0]) + rotation(q[1]) @ (local * [-1, 1])
    in_object = [rotation(pose[2]).T @ (tip - pose[:2]) for tip in (left, right)]
    d1 = hand.tip_radius - (-width / 2 - in_object[0][0])
    d2 = hand.tip_radius - (in_object[1][0] - width / 2)
    return np.array([d1, d2, pose[2] + q[0], pose[2] - q[1], in_object[0][1], in_object[1][1]])


@pytest.mark.parametrize("hand", HANDS)
def test_contacts_and_their_jacobian_are_those_of_the_rotation_matrix_twin(hand):
    step = 1e-6 * np.eye(5)
    for q, pose in random_states(20):
        c = hand.contacts(q, pose, WIDTH)
        expected = contacts_by_rotation(hand, q, pose, WIDTH)
        np.testing.assert_allclose(np.concatenate((c.d, c.theta, c.s)), expected, atol=1e-15)
        x = np.concatenate((q, pose))
        ends = [
            [contacts_by_rotation(hand, at[:2], at[2:], WIDTH) for at in (x + h, x - h)]
            for h in step
        ]
        numeric = np.stack([(ahead - behind) / 2e-6 for ahead, behind in ends], axis=1)
        by_kind = hand.jacobian(x).swapaxes(0, 1).reshape(6, 5)
        np.testing.assert_allclose(by_kind, numeric, atol=1e-9)
        for finger, sense in ((0, 1.0), (1, -1.0)):
            inwards = sense * hand.tip_jacobian(q)[finger] @ [math.cos(pose[2]), math.sin(pose[2])]
            assert inwards == pytest.approx(numeric[finger, finger], abs=1e-9)


def test_sheared_energy_equals_its_closed_form_and_checkpoint():
    assert sheared_contact(PAPER, 0.006, math.radians(20), 0.0015)[0] == pytest.approx(
        0.10953644560057, rel=1e-12
    )
    generator = np.random.default_rng(1)
    for _ in range(100):
        d, theta = generator.uniform(1e-4, 0.010), generator.uniform(-0.5, 0.5)
        shear = generator.uniform(-0.5, 0.5) * d
        c, t = math.cos(theta), math.tan(theta)
        closed = math.pi * E * (d**3 / (3 * c**2) + d**2 * shear * t + d * shear**2)
        found = sheared_contact(PAPER, d, theta, shear)[0]
        assert found == pytest.approx(closed, rel=1e-11)


@pytest.mark.parametrize(
    ("d", "degrees", "normal", "moment"),
    [  # d [mm], q [°], N [N], N times its lever arm [mN·m], for L 80, B 50, W 40, e 0, a 20 mm
        (2, 8.6269265587, 3.8421597806, 303.895166),
        (4, 10.0786581078, 15.4013956785, 1213.098241),
        (8, 13.0028781629, 61.9376635610, 4827.960422),
    ],
)
def test_symmetric_grasp_table(d, degrees, normal, moment):
    grasp = Grasp(ReferenceHand(), PAPER, WIDTH)
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
