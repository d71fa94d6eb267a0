"""The hand's planar geometry against plain NumPy, finite differences and its own inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.harness.reference_hand import ReferenceHand

HANDS = [
    ReferenceHand(),
    ReferenceHand(pivot_separation=0.07, finger_length=0.06, finger_offset=0.012, tip_radius=0.012),
    ReferenceHand(finger_offset=-0.02),
]
WIDTH = 0.04


def random_states(count: int, seed: int = 3) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(seed)
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


def stacked(hand: ReferenceHand, q, pose, width=WIDTH) -> np.ndarray:
    c = hand.contacts(q, pose, width)
    return np.concatenate((c.d, c.theta, c.s))


@pytest.mark.parametrize("hand", HANDS)
def test_contact_variables_equal_the_rotation_matrix_twin(hand):
    for q, pose in random_states(50):
        expected = contacts_by_rotation(hand, q, pose, WIDTH)
        np.testing.assert_allclose(stacked(hand, q, pose), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("hand", HANDS)
def test_jacobians_equal_central_differences(hand):
    step = 1e-6
    for q, pose in random_states(20):
        x = np.concatenate((q, pose))
        numeric = np.empty((6, 5))
        for j in range(5):
            ahead, behind = x.copy(), x.copy()
            ahead[j] += step
            behind[j] -= step
            numeric[:, j] = (
                stacked(hand, ahead[:2], ahead[2:]) - stacked(hand, behind[:2], behind[2:])
            ) / (2 * step)
        np.testing.assert_allclose(hand.jacobian(q, pose), numeric, atol=1e-9)
        for finger in range(2):
            ahead, behind = q.copy(), q.copy()
            ahead[finger] += step
            behind[finger] -= step
            slope = (hand.tips(ahead) - hand.tips(behind))[finger] / (2 * step)
            np.testing.assert_allclose(hand.tip_jacobian(q)[finger], slope, atol=1e-9)


@pytest.mark.parametrize("hand", HANDS)
def test_rolling_rows_follow_their_definition(hand):
    for q, pose in random_states(20):
        c = hand.contacts(q, pose, WIDTH)
        jacobian = hand.jacobian(q, pose)
        a = hand.tip_radius
        first = (a - c.d[0]) * jacobian[2] - jacobian[4] - np.tan(c.theta[0]) * jacobian[0]
        second = (a - c.d[1]) * jacobian[3] + jacobian[5] - np.tan(c.theta[1]) * jacobian[1]
        np.testing.assert_allclose(hand.rolling(q, pose, WIDTH), [first, second], atol=1e-15)


def test_moving_hand_and_object_mirrored_swaps_the_fingers():
    hand = HANDS[1]
    for q, pose in random_states(20):
        mirrored = pose * [-1, 1, -1]
        c = hand.contacts(q, pose, WIDTH)
        m = hand.contacts(q[::-1], mirrored, WIDTH)
        np.testing.assert_allclose(m.d[::-1], c.d, atol=1e-15)
        np.testing.assert_allclose(m.theta[::-1], -c.theta, atol=1e-15)
        np.testing.assert_allclose(m.s[::-1], c.s, atol=1e-15)


@pytest.mark.parametrize("hand", HANDS)
def test_inverse_kinematics_round_trip(hand):
    generator = np.random.default_rng(5)
    for _ in range(50):
        pose = generator.uniform([-0.005, 0.05, -0.2], [0.005, 0.08, 0.2])
        d = generator.uniform(-0.004, 0.008, 2)
        q = hand.inverse(pose, d, 0.03)
        np.testing.assert_allclose(hand.contacts(q, pose, 0.03).d, d, atol=1e-15)


def test_symmetric_grasp_angles_of_the_default_hand():
    hand = ReferenceHand()
    for d, degrees in [
        (0.002, 8.6269265587),
        (0.004, 10.0786581078),
        (0.006, 11.5369590328),
        (0.008, 13.0028781629),
    ]:
        q = hand.inverse((0, 0.08, 0), (d, d), 0.04)
        np.testing.assert_allclose(np.degrees(q), degrees, atol=1e-9)


@pytest.mark.parametrize("hand", HANDS)
def test_object_from_contacts_recovers_angle_and_width(hand):
    for q, pose in random_states(30):
        c = hand.contacts(q, pose, WIDTH)
        angle, width, disagreement = hand.object_from_contacts(q, c.d, c.theta)
        assert angle == pytest.approx(pose[2], abs=1e-14)
        assert width == pytest.approx(WIDTH, abs=1e-14)
        assert disagreement == pytest.approx(0, abs=1e-14)


def test_out_of_reach_and_bad_shapes_are_refused():
    hand = ReferenceHand()
    with pytest.raises(ValueError, match="out of reach"):
        hand.inverse((0.2, 0.08, 0), (0, 0), 0.04)
    with pytest.raises(ValueError, match="shape"):
        hand.tips([0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match="finger_length"):
        ReferenceHand(finger_length=0.0)
    with pytest.raises(ValueError, match="finger_offset"):
        ReferenceHand(finger_offset=math.nan)
