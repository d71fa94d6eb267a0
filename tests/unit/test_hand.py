"""Test the equilibrium, servos, scenes and time of the simulated hand."""

import math

import numpy as np
import pytest

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from tests.harness.grasp import Grasp
from tests.harness.plant import (
    BOUNDED,
    CONSTANT,
    CURRENT,
    LOSSLESS,
    MODULUS,
    PAPER,
    POSITION,
    TABLE_I,
    WIDTH,
    make,
    place,
    run,
    settled,
)
from tests.harness.reference_hand import ReferenceHand

# Equilibrium.


def test_a_symmetric_grasp_settles_at_the_theoretical_equilibrium():
    hand = make(table_friction=0.0, joint_friction=0.0)
    grasp = Grasp(ReferenceHand(), PAPER, WIDTH)
    for d, degrees, normal in [
        (0.002, 8.6269265587, 3.8421597806),
        (0.004, 10.0786581078, 15.4013956785),
    ]:
        expected = grasp.forces(grasp.symmetric(d))
        settled(hand, (0.9, 0.9), float(expected.torque[0]) / CONSTANT, 6.0)
        np.testing.assert_allclose(hand.d, d, rtol=1e-6)
        np.testing.assert_allclose(np.degrees(hand.q), degrees, rtol=1e-8)
        np.testing.assert_allclose(hand.normal, normal, rtol=1e-6)
        np.testing.assert_allclose(hand.tangential, 0, atol=1e-6 * normal)


@pytest.mark.parametrize(("degrees", "gain"), [(1, 1.520), (5, 1.5076)])
def test_quasi_static_steering_gain(degrees, gain):
    hand = make(table_friction=0.0, joint_friction=0.0, tip_friction=50.0)
    grasp = Grasp(ReferenceHand(), PAPER, WIDTH)
    start = grasp.symmetric(0.004)
    place(hand, start.q, start.pose)
    hand.shear[:] = start.shear
    # The joints are stiff and turn slowly, so the motion is quasi-static.
    parameters = hand.plant.parameters
    parameters.position_gain = 1e5
    parameters.rate_gain = parameters.stall_current = 1e3
    delta = math.radians(degrees)
    for share in np.linspace(0, 1, 400):
        for joint, sign in ((0, 1), (1, -1)):
            hand.drive(joint, POSITION, True, start.q[joint] + sign * share * delta, 0.0)
        run(hand, 0.002)
    run(hand, 0.2)
    turned = hand.q[0] - start.q[0]
    assert turned == pytest.approx(delta, rel=1e-2)
    assert hand.object_pose[2] / turned == pytest.approx(gain, abs=2e-3)


def test_load_dependent_friction_equals_the_gear_efficiency():
    # Load-dependent friction is ``share`` times the motor torque and the contact torque. The gears
    # therefore transmit (1 − share)/(1 + share) of the torque. If the contact drives the gears, the
    # ratio is inverted. ``rest`` is a constant friction torque [N·m], half of which acts only at
    # standstill.
    share, rest = 0.25, 0.02
    simulation = {"joint_friction": 0.5 * rest, "joint_stribeck": 0.5 * rest, "joint_damping": 0.0}
    simulation |= {"joint_load_friction": (0.5 * share, 0.5 * share), "joint_stribeck_speed": 50.0}
    settings = {"scene": {"fingers": ("left",)}, "simulation": simulation}
    hand = SimulatedHand(Settings.model_validate(settings), table=PAPER)
    hand.plant.parameters.no_load_speed = 1e9
    place(hand, (0.15, 0.0), (0.0, 0.08, 0.0))
    arrived = []
    for amperes in (*np.linspace(0.3, 0.8, 401), *np.linspace(0.8, 0.2, 481)):
        hand.drive(0, CURRENT, True, 0.0, amperes)
        run(hand, 0.003)
        arrived.append(-hand.plant.external[0])
    driving, driven = (CONSTANT * amperes for amperes in (0.8, 0.2))
    assert arrived[400] == pytest.approx((driving * (1 - share) - rest) / (1 + share), rel=0.02)
    assert arrived[-1] == pytest.approx((driven * (1 + share) + rest) / (1 - share), rel=0.02)


def test_gravity_accelerates_a_free_object_and_a_grasp_holds_it():
    hand = make(gravity=(0.0, -9.80665))
    run(hand, 0.1)
    t = hand.t
    np.testing.assert_allclose(hand.object_pose[1], 0.08 - 0.5 * 9.80665 * t * t, rtol=1e-12)
    assert hand.object_velocity[1] == pytest.approx(-9.80665 * t)
    held = make(gravity=(0.0, -9.80665), object_mass=0.3)
    grasp = Grasp(ReferenceHand(), PAPER, WIDTH)
    start = grasp.symmetric(0.004)
    place(held, start.q, start.pose)
    settled(held, (0.9, 0.9), 0.7, 1.0)
    # The y components of the tip forces carry the weight, and the tips do not slip.
    along = held.tangential * np.cos(held.object_pose[2]) * [-1, 1]
    assert abs(along.sum()) == pytest.approx(0.3 * 9.80665, rel=0.01)
    place_before = held.object_pose[1]
    run(held, 1.0)
    assert held.object_pose[1] == pytest.approx(place_before, abs=1e-5)
    slippery = make(gravity=(0.0, -9.80665), object_mass=0.3, tip_friction=0.05)
    place(slippery, start.q, start.pose)
    settled(slippery, (0.9, 0.9), 0.7, 1.0)
    assert slippery.object_pose[1] == pytest.approx(0.03, abs=1e-3)  # The object lies on the palm.


@pytest.mark.parametrize("friction", [0.2, 0.6])
def test_a_held_object_slips_when_the_push_exceeds_friction(friction):
    hand = make(tip_friction=friction, table_friction=0.0)
    settled(hand, (0.9, 0.9), 0.5, 1.0)
    place_held = hand.object_pose[1]
    push = 0.0
    while hand.object_pose[1] < place_held + 0.006:
        push += 0.01
        assert push < 50.0, "the object does not slip"
        hand.apply_load(0.0, push)
        run(hand, 0.005)
        ratio = np.abs(hand.tangential) / hand.normal
        assert (ratio <= friction * (1 + 1e-9)).all()
    # Both tips slip at the Coulomb limit, so the rest of the push accelerates the object.
    np.testing.assert_allclose(ratio, friction, rtol=1e-6)
    assert push == pytest.approx(2 * friction * hand.normal.mean(), rel=0.15)


def test_a_dropped_object_comes_to_rest_on_the_palm():
    for angle in (0.0, 0.4):
        hand = make(gravity=(0.0, -9.80665), object_angle=angle, palm=0.01)
        energy = hand.plant.energy
        highest = 0.0
        for _ in range(2000):
            run(hand, 0.001)
            later = hand.plant.energy
            assert later <= energy + 1e-12
            energy = later
            if hand.t > 0.15:
                highest = max(highest, np.abs(hand.object_velocity[1]))
        # The object lies flat, so two corner springs of 1e5 N/m carry its weight. A tip may still
        # touch the object and creep.
        half = 0.5 * (0.060 if abs(math.sin(hand.object_pose[2])) < 0.5 else 0.040)
        sunk = 0.1 * 9.80665 / 2e5
        assert hand.object_pose[1] == pytest.approx(0.01 + half - sunk, abs=5e-7)
        assert np.abs(hand.object_velocity[1:]).max() < 1e-6
    assert highest > 0.01  # The object rocked before it came to rest.


def test_a_collision_conserves_momentum_and_energy():
    hand = make(object_mass=0.05, **LOSSLESS)
    place(hand, (0.0, 0.0), (-0.005, 0.08, 0.0), velocity=(-0.5, 0.0, 0.0))
    start = hand.plant.energy
    assert start == pytest.approx(0.5 * 0.05 * 0.25)
    impulse = 0.0
    while hand.t < 0.05:
        before = hand.normal[0]
        hand.advance(hand.t + 1.5 * hand.step)
        impulse += 0.5 * (before + hand.normal[0]) * hand.step
    assert hand.force[0] == 0.0
    assert hand.object_velocity[0] > 0.3
    assert 0.05 * (hand.object_velocity[0] + 0.5) == pytest.approx(impulse, rel=1e-3)
    # The face stays upright, so the joint receives the angular impulse L N dt.
    assert hand.plant.parameters.joint_inertia * hand.dq[0] == pytest.approx(
        -0.080 * impulse, rel=3e-3
    )
    assert hand.plant.energy == pytest.approx(start, rel=1e-3)


# Servos.


def test_position_moves_are_well_damped_and_bounded_by_the_goal_current():
    hand = make()
    place(hand, (-0.2, -0.2), (0.0, 0.3, 0.0))
    for joint in range(2):
        hand.drive(joint, BOUNDED, True, 0.1, 0.4)
    highest = 0.0
    while hand.t < 1.0:
        run(hand, 0.002)
        assert np.abs(hand.current).max() <= 0.4 + 1e-12
        if hand.t < 0.02:
            continue
        highest = max(highest, hand.q.max())
    assert highest < 0.1 + 0.01 * 0.3  # The overshoot is less than 1 %.
    np.testing.assert_allclose(hand.q, 0.1, atol=0.01)


def test_modes_torque_and_current_dynamics():
    hand = make(joint_friction=0.0, joint_damping=0.0)
    place(hand, (0.0, 0.0), (0.0, 0.3, 0.0))
    hand.drive(0, CURRENT, True, 0.0, 0.2)
    run(hand, 0.001)
    assert hand.current[0] == pytest.approx(0.2 * (1 - math.exp(-1)), rel=0.02)
    run(hand, 0.010)
    assert hand.current[0] == pytest.approx(0.2, rel=0.05)
    assert hand.dq[0] > 0
    assert hand.dq[1] == 0.0
    hand.drive(0, CURRENT, False, 0.0, 0.2)
    run(hand, 0.02)
    assert abs(hand.current[0]) < 1e-6


def test_end_stops_and_no_load_speed_limit_the_joints():
    hand = make()
    place(hand, (0.0, 0.0), (0.0, 0.3, 0.0))
    for joint in range(2):
        hand.drive(joint, CURRENT, True, 0.0, (3.0, -3.0)[joint])
    fastest = 0.0
    while hand.t < 2.0:
        run(hand, 0.002)
        fastest = max(fastest, np.abs(hand.dq).max())
    assert fastest < hand.plant.parameters.no_load_speed
    # The joint stop is 0.05 rad outside the limit. A torque of 5.4 N·m deforms the stop, whose
    # stiffness is 500 N·m/rad.
    assert 1.05 < hand.q[0] < 1.07
    assert -0.57 < hand.q[1] < -0.55


# Scenes.


def test_scripted_compression_indents_each_tip_by_eight_millimetres():
    settings = Settings.model_validate(
        {"servos": {"backend": "none"}, "simulation": {"compression_speed": 0.01}}
    )
    hand = SimulatedHand(settings, table=PAPER)
    deepest = np.full(2, -1.0)
    both = 0
    for _ in range(4 * 1900):
        run(hand, 0.001)
        deepest = np.maximum(deepest, hand.d)
        both += int((hand.d > 0).all())
    np.testing.assert_allclose(deepest, 0.008, atol=2e-5)
    np.testing.assert_array_equal(hand.q, settings.hand.open_angle)
    assert both == 0
    # The force is F = πE d²/cos θ at all times.
    run(hand, 1.7)
    d = hand.d[0]
    assert d > 0.004
    assert hand.force[0] == pytest.approx(math.pi * MODULUS * d * d / math.cos(hand.theta[0]))


# Time.


def test_advancing_is_idempotent_and_independent_of_its_division():
    hands = [make(TABLE_I) for _ in range(3)]
    for hand in hands:
        for joint in range(2):
            hand.drive(joint, BOUNDED, True, 0.6, 0.4)
    hands[0].advance(1.0)
    for k in range(1, 501):
        hands[1].advance(k * 0.002)
        hands[1].advance(k * 0.002 - 0.001)
    generator = np.random.default_rng(1)
    for t in np.sort(generator.uniform(0, 1, 300)):
        hands[2].advance(float(t))
    hands[2].advance(1.0)

    def state(hand):
        parts = ("state", "gears", "sensed_contact", "energy", "sample_count")
        return [hand.plant.array[part].tobytes() for part in parts]

    before = state(hands[0])
    hands[0].advance(0.5)
    assert state(hands[0]) == before
    for hand in hands:
        assert hand.t == pytest.approx(1.0)
        assert state(hand) == before


def test_samples_are_interpolated_at_the_frame_times():
    settings = Settings.model_validate({"tactile": {"rate": 130.0}})
    hand = SimulatedHand(settings, start=5.0, table=PAPER)
    finer = SimulatedHand(settings, start=5.0, table=PAPER, step=1.0 / 130.0 / 64)
    for h in (hand, finer):
        for joint in range(2):
            h.drive(joint, BOUNDED, True, 0.6, 0.4)
        h.advance(5.15)
    count = hand.plant.sample_count
    assert count == finer.plant.sample_count == 20
    for number in range(count - 5, count):
        sample, exact = hand.sample(number), finer.sample(number)
        # In each tick, the finger moves by 1e-4 rad and 4e-6 m. Samples that were not interpolated
        # would have errors of the same size.
        np.testing.assert_allclose(sample.d, exact.d, atol=8e-7)
        np.testing.assert_allclose(sample.theta, exact.theta, atol=1e-5)
    assert hand.sample(count) is None
    assert hand.sample(0) is None


def test_the_step_divides_a_millisecond_and_decreases_with_stiffness():
    steps = [make(object_mass=mass).step for mass in (10.0, 0.1, 0.01, 1e-4)]
    for step in steps:
        assert 1e-3 / step == pytest.approx(round(1e-3 / step), abs=1e-9)
    assert steps[0] == steps[1] == 0.25e-3
    assert steps[1] > steps[2] > steps[3] == 0.05e-3
    assert make(object_mass=0.01, modulus_scale=4.0).step < steps[2]
