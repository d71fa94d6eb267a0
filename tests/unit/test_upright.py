"""Test the control law that turns an object upright without measuring the object's angle."""

import math
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.profile.load import load
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.kinematics.hand.grasp_state import Lengths
from softfinger.kinematics.hand.upright import upright_spring
from softfinger.tools.simulated_daemon import SimulatedDaemon
from tests.harness.plant import CONSTANT, CURRENT, PAPER, WIDTH, make, push_along

LENGTHS = Lengths(half_separation=0.05, finger=0.08, offset=0.0, radius=0.02)
START = math.radians(5.0)
DEPTH, FORCE = 0.0032, 10.0  # indentation [m] and force [N] of the paper's tip
spring_of = upright_spring.py_func


def resting_ratio(spring: float) -> float:
    """Return φ/φ0 from the closed form in `kinematics.hand.upright` with c = 2/3."""
    half_separation, radius = LENGTHS.half_separation, LENGTHS.radius
    inward = half_separation - radius + DEPTH - 0.5 * WIDTH
    b = spring / (FORCE * half_separation)
    line = 2.0 * inward - DEPTH / 3.0 - b * (WIDTH - DEPTH)
    rolled = radius - DEPTH + inward + 0.5 * (1.0 + b) * DEPTH
    return WIDTH * line / (WIDTH * line - 4.0 * (radius - DEPTH / 3.0) * rolled)


def at_rest(spring: float) -> SimulatedHand:
    """Slowly increase the force on a tilted object to 10 N; friction acts only at the tips."""
    hand = make(
        PAPER, object_angle=START, joint_friction=0.0, table_friction=0.0, joint_damping=0.1
    )
    inwards = LENGTHS.half_separation - LENGTHS.radius + DEPTH - 0.5 * WIDTH
    full = FORCE * math.sqrt(LENGTHS.finger**2 - inwards**2)
    while hand.t < 8.0:
        torque = full * min(max(hand.t / 5.0, 0.03), 1.0)
        apart = spring * torque / full * 0.5 * (hand.q[0] - hand.q[1])
        for joint, sense in ((0, -1.0), (1, 1.0)):
            hand.drive(joint, CURRENT, True, 0.0, (torque + sense * apart) / CONSTANT)
        hand.advance(hand.t + 0.005)
    assert hand.normal.mean() == pytest.approx(FORCE, rel=0.02)
    return hand


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 4.0])
def test_sticking_tips_leave_the_object_at_the_angle_of_the_closed_form(share):
    q = math.asin((LENGTHS.half_separation - LENGTHS.radius + DEPTH - 0.5 * WIDTH) / LENGTHS.finger)
    spring = share * spring_of(q, DEPTH, FORCE, 2.0 / 3.0, LENGTHS)
    hand = at_rest(spring)
    expected = resting_ratio(spring)
    # The closed form neglects q², which is 0.03 here.
    assert hand.object_pose[2] / START == pytest.approx(expected, abs=0.03)
    if share == 1.0:
        assert expected == pytest.approx(0.0, abs=1e-12)
    if share == 0.0:
        assert expected == pytest.approx(-0.73, abs=0.01)


@pytest.mark.parametrize(
    ("sense", "angle_known", "simulation"),
    [
        (1.0, False, {}),
        (-1.0, True, {"tip_friction": 0.2, "object_mass": 0.2, "modulus_scale": 0.7}),
        pytest.param(
            1.0,
            True,
            {"tip_friction": 0.8, "object_mass": 0.05, "modulus_scale": 1.3},
            marks=pytest.mark.extended,
        ),
        (-1.0, False, {"tip_creep_time": 20.0, "tip_micro_slip": True, "tip_shear_stiffness": 0.8}),
    ],
    ids=["as assumed", "slippery, heavy, soft", "rough, light, hard", "relaxing"],
)
def test_the_upright_law_does_not_use_the_angle(sense, angle_known, simulation):
    sections = {
        "control": {"law": "upright"},
        "scene": {"object_model": angle_known},
        "simulation": {"object_angle": sense * START, **simulation},
    }
    with SimulatedDaemon(sections) as hand:
        hand.grasp(FORCE)
        hand.run(4.5)
        assert hand.mode == "holding"
        assert abs(math.degrees(hand.plant.object_pose[2])) < 0.3
        assert np.abs(hand.plant.force / FORCE - 1.0).max() < 0.15
        if angle_known:
            hand.command("rotate", angle=0.1)
            hand.run(2.0)
            turned = float(hand.plant.object_pose[2])
            assert turned == pytest.approx(0.1, abs=math.radians(0.2))


def test_solid_tips_bring_the_object_upright() -> None:
    # The energy of bonded rubber has no local minimum. For bonded rubber, the control law therefore
    # uses the stiffness from the contact table.
    sections = load(Path("solid")).model_dump(include={"tip", "material", "estimator", "safety"})
    simulation = {"object_angle": START}
    with SimulatedDaemon(
        {**sections, "control": {"law": "upright"}, "simulation": simulation}
    ) as hand:
        assert hand.estimator.grasp.tilt_moment_ratio < 0.0
        hand.grasp(FORCE)
        hand.run(4.5)
        assert hand.mode == "holding"
        assert abs(math.degrees(hand.plant.object_pose[2])) < 0.4


def test_late_ticks_do_not_slow_the_dither() -> None:
    # If late ticks slowed the dither to a quarter of its frequency, the object would leave the
    # grip.
    with SimulatedDaemon(
        {"control": {"law": "upright"}, "simulation": {"object_angle": START}}
    ) as hand:
        hand.grasp(FORCE)
        hand.run(0.8)
        clock = hand._daemon.clock
        for _ in range(500):
            clock.sleep_until(clock.now() + 4.0 * hand.loop.period)
            hand.loop.tick(clock.now())
        assert hand.mode == "holding", hand.state.fault
        assert abs(math.degrees(hand.plant.object_pose[2])) < 0.3


def test_a_decreasing_grip_force_does_not_hold_the_dither_on_one_side():
    with SimulatedDaemon({"control": {"law": "upright"}}) as hand:
        hand.grasp(FORCE)
        hand.run(4.5)
        push_along(hand, 13.2, 11.0)
        goal = hand._daemon.loop.state.goal
        assert goal.force > 1.1 * FORCE
        hand.plant.apply_load(0.0, 0.0)
        hand.run(0.5)
        hand.command("grasp", force=FORCE)  # The force decreases a second later, during the dither.
        turned = np.abs(hand.watch(3.5).angle).max()
        assert hand.mode == "holding"
        assert goal.force == pytest.approx(FORCE, rel=0.01)
        assert turned < math.radians(10.0), math.degrees(turned)


def test_a_small_hand_brings_its_object_upright():
    sections = load(Path("small")).model_dump(exclude_unset=True)
    sections["control"]["law"] = "upright"
    sections["simulation"]["object_angle"] = START
    with SimulatedDaemon(sections) as hand:
        hand.grasp(0.8)
        hand.run(4.5)
        assert hand.mode == "holding"
        assert abs(math.degrees(hand.plant.object_pose[2])) < 0.3
