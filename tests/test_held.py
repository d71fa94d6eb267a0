"""How a held object answers the joints, against the quasi-static path of `kinematics.grasp`."""

from __future__ import annotations

import math

import pytest

from kinematics import ContactTable, Fingertip, Material
from kinematics.fingers import HandGeometry
from kinematics.grasp import Grasp, GraspState
from kinematics.held import held_motion, holding_levers, total_tilt

HAND = HandGeometry(finger_offset=0.003)
LENGTHS = (HAND.half_separation, HAND.finger_length, HAND.finger_offset, HAND.tip_radius)
WIDTH = 0.040


@pytest.fixture(scope="module", params=["constant", "table_i"])
def grasp(request: pytest.FixtureRequest) -> Grasp:
    material = Material.constant(0.304e6) if request.param == "constant" else Material.table_i()
    return Grasp(HAND, ContactTable.build(Fingertip(0.020), material), WIDTH)


def motion_of(state: GraspState) -> tuple[float, ...]:
    c = HAND.contacts(state.q, state.pose, WIDTH)
    return held_motion(*state.q, *c.d, state.pose[2], *LENGTHS)


@pytest.mark.parametrize("delta", [0.0, 0.06, -0.12])
def test_levers_are_the_torques_that_balance_the_grasp(grasp: Grasp, delta: float) -> None:
    state = grasp.symmetric(0.0035)
    if delta:
        state = grasp.steer(state, delta)
    c = HAND.contacts(state.q, state.pose, WIDTH)
    data = grasp.table.data
    lever1, lever2, *rest = holding_levers(data, data, *c.d, *c.theta, motion_of(state))
    forces = grasp.forces(state)
    assert [lever1, lever2] == pytest.approx(forces.torque / forces.force.mean(), rel=5e-4)
    shear = forces.tangential.mean()
    assert rest == pytest.approx([shear, *forces.normal], rel=2e-3, abs=1e-8)


@pytest.mark.parametrize("delta", [0.0, 0.06, -0.12])
def test_object_turns_as_predicted(grasp: Grasp, delta: float) -> None:
    state = grasp.symmetric(0.0035)
    if delta:
        state = grasp.steer(state, delta)
    _, _, turn1, turn2, _, width, _ = motion_of(state)
    small = 1e-4
    turned = grasp.steer(state, small, steps=2).pose[2] - state.pose[2]
    assert turned / small == pytest.approx(turn1 + turn2, rel=0.02)
    assert width == pytest.approx(WIDTH, rel=1e-12)


def test_arms_and_slide_are_the_derivatives_of_what_the_tips_share() -> None:
    def both(q1: float, q2: float, angle: float) -> float:
        tips = HAND.tips([q1, q2])
        return -float((tips[1] - tips[0]) @ [math.cos(angle), math.sin(angle)])

    at = (0.12, 0.21, -0.1)
    arm1, arm2, _, _, slide, _, _ = held_motion(at[0], at[1], 3e-3, 4e-3, at[2], *LENGTHS)
    step = 1e-6
    slopes = []
    for j in range(3):
        ahead, behind = list(at), list(at)
        ahead[j] += step
        behind[j] -= step
        slopes.append((both(*ahead) - both(*behind)) / (2.0 * step))
    assert [arm1, arm2, slide] == pytest.approx(slopes, rel=1e-8)


def test_levers_without_contacts_are_zero(grasp: Grasp) -> None:
    motion = held_motion(0.1, 0.1, 0.0, 1e-3, 0.0, *LENGTHS)
    data = grasp.table.data
    assert holding_levers(data, data, 0.0, 1e-3, 0.1, -0.1, motion) == (0.0,) * 5


def test_each_tip_has_its_own_table(grasp: Grasp) -> None:
    soft = grasp.table.data
    stiff = ContactTable.build(Fingertip(0.020), Material.constant(0.6e6)).data
    q1, q2, d1, d2, angle = 0.14, 0.22, 4.0e-3, 2.6e-3, 0.03

    def levers(left, right, q1, q2, d1, d2, angle):
        motion = held_motion(q1, q2, d1, d2, angle, *LENGTHS)
        return holding_levers(left, right, d1, d2, angle + q1, angle - q2, motion)

    here = levers(soft, stiff, q1, q2, d1, d2, angle)
    mirrored = levers(stiff, soft, q2, q1, d2, d1, -angle)
    turned = [mirrored[1], mirrored[0], -mirrored[2], mirrored[4], mirrored[3]]
    assert here == pytest.approx(turned, rel=1e-12)
    assert here[:2] != pytest.approx(levers(soft, soft, q1, q2, d1, d2, angle)[:2], rel=1e-3)


def test_total_tilt_is_the_angle_of_the_normal_with_the_axis() -> None:
    assert total_tilt(0.3, 0.0) == pytest.approx(0.3)
    x, y = math.sin(0.2), math.sin(-0.1)
    assert math.cos(total_tilt(0.2, -0.1)) == pytest.approx(math.sqrt(1.0 - x * x - y * y))
