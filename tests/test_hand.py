"""The simulated hand: its energy, its order, its balance and what it survives."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from daemon.settings import Settings, SettingsError
from daemon.simulation import layout
from daemon.simulation.hand import SimulatedHand
from daemon.simulation.parameters import mean_distance
from daemon.simulation.tip import evaluate_tip
from kinematics.contact import Fingertip
from kinematics.fingers import HandGeometry
from kinematics.grasp import Grasp
from kinematics.material import Material
from kinematics.table import ContactTable

MODULUS = 0.304e6
WIDTH = 0.040
CONSTANT = 1.78  # N·m/A
PAPER = ContactTable.build(Fingertip(radius=0.020), Material.constant(MODULUS))
TABLE_I = ContactTable.build(Fingertip(radius=0.020), Material.table_i(), tolerance=1e-6)
CURRENT, POSITION, BOUNDED = 0, 3, 5  # operating modes
LOSSLESS = {
    "tip_loss": 0.0,
    "joint_damping": 0.0,
    "joint_friction": 0.0,
    "table_friction": 0.0,
    "tip_friction": 50.0,
}


def make(table: ContactTable = PAPER, step: float | None = None, **simulation) -> SimulatedHand:
    settings = Settings.model_validate({"simulation": simulation})
    return SimulatedHand(settings, table=table, step=step)


def place(hand: SimulatedHand, q, pose, dq=(0, 0), velocity=(0, 0, 0)) -> None:
    hand.q[:], hand.object_pose[:] = q, pose
    hand.dq[:], hand.object_velocity[:] = dq, velocity
    hand.refresh()


def hold_with(hand: SimulatedHand, currents) -> None:
    """Constant currents from the start on, whatever the joints' speed."""
    hand.memory[layout.NO_LOAD_SPEED] = 1e9
    hand.current[:] = currents
    for joint in range(2):
        hand.drive(joint, CURRENT, True, 0.0, currents[joint])


def run(hand: SimulatedHand, seconds: float) -> None:
    hand.advance(hand.t + seconds)


# One tip alone.


def tip_row(hand: SimulatedHand, finger: int, q, pose, shear: float) -> np.ndarray:
    """Evaluate one tip at rest; a copy of its row."""
    geometry = HandGeometry()
    tip = geometry.tips([q, q])[finger]
    slope = geometry.tip_jacobian([q, q])[finger]
    hand.memory[layout.VELOCITY : layout.VELOCITY + 5] = 0.0
    evaluate_tip(
        hand.memory,
        hand.table.data,
        layout.TIP,
        finger,
        layout.VELOCITY,
        math.cos(q),
        math.sin(q),
        *slope,
        *(tip - pose[:2]),
        math.cos(pose[2]),
        math.sin(pose[2]),
        shear,
    )
    return hand.memory[layout.TIP : layout.TIP + layout.TIP_ROW].copy()


@pytest.mark.parametrize("table", [PAPER, TABLE_I], ids=["constant", "table_i"])
@pytest.mark.parametrize(
    ("depth", "height"),
    [((0.001, 0.010), 0.06), ((0.010, 0.019), 0.06), ((0.001, 0.015), 0.002)],
    ids=["soft", "rim", "corner"],
)
def test_tip_forces_are_the_gradient_of_one_energy(table, depth, height):
    hand = make(table, tip_friction=500.0, object_height=height)
    generator = np.random.default_rng(3)
    step = 1e-7
    checked = 0
    for _ in range(400):
        finger = int(generator.integers(2))
        q = generator.uniform(0, 0.9)
        pose = generator.uniform([0, 0.05, -0.9], [0, 0.10, 0.9])
        open_row = tip_row(hand, finger, q, pose, 0.0)
        side = 1 - 2 * finger
        want = generator.uniform(*depth)
        pose[0] += side * (want - open_row[layout.D]) / math.cos(pose[2])
        shear = generator.uniform(-0.3, 0.3) * want
        row = tip_row(hand, finger, q, pose, shear)
        if row[layout.GAIN] == 0.0 or row[layout.TIP_SHEAR] != shear:
            continue
        move = generator.normal(size=4) * [1, 0.05, 0.05, 1]
        rolled = row[layout.JT : layout.JT + 4] @ move
        energies = [
            tip_row(
                hand,
                finger,
                q + s * move[0],
                pose + s * move[1:],
                shear + s * rolled,
            )[layout.ENERGY]
            for s in (step, -step)
        ]
        slope = (energies[0] - energies[1]) / (2 * step)
        forces = row[layout.Q : layout.Q + 4]
        assert -forces @ move == pytest.approx(
            slope, rel=1e-5, abs=1e-5 * np.abs(forces * move).sum()
        )
        checked += 1
    assert checked > 50


def test_friction_bounds_the_shear():
    generator = np.random.default_rng(4)
    for _ in range(200):
        friction = generator.uniform(0, 2)
        hand = make(tip_friction=friction)
        q, angle = generator.uniform(0.1, 0.2), generator.uniform(-0.3, 0.3)
        row = tip_row(hand, 0, q, np.array([-0.002, 0.08, angle]), generator.normal() * 5e-3)
        assert row[layout.NORMAL] > 0
        assert abs(row[layout.TANGENTIAL]) <= friction * row[layout.NORMAL] * (1 + 1e-12)


# Energy.


@pytest.mark.parametrize("trial", range(12))
def test_energy_never_rises_without_input(trial):
    generator = np.random.default_rng(trial)
    hand = make(
        PAPER if trial % 2 else TABLE_I,
        object_mass=float(10 ** generator.uniform(-3, 1)),
        tip_friction=float(generator.uniform(0, 2)),
        modulus_scale=float(10 ** generator.uniform(-1.5, 1.5)),
    )
    place(
        hand,
        generator.uniform(0.10, 0.25, 2),
        generator.uniform([-0.003, 0.07, -0.2], [0.003, 0.09, 0.2]),
        generator.normal(size=2) * 2,
        generator.normal(size=3) * [0.3, 0.3, 3],
    )
    start = hand.energy()
    energy = start
    for _ in range(2500):
        hand.advance(hand.t + 1.5 * hand.step)
        later = hand.energy()
        assert later <= energy + 1e-12 * start
        energy = later
    assert energy < 0.7 * start


def drift(step: float) -> tuple[float, float]:
    """Largest drift of the energy without losses over 0.3 s of oscillation, and the energy."""
    hand = make(step=step, **LOSSLESS)
    currents = np.array([0.65, 0.68])
    hold_with(hand, currents)
    place(hand, (0.18, 0.17), (0.0005, 0.08, 0.02), velocity=(0.05, 0.05, 0.5))

    def total() -> float:
        return hand.energy() - CONSTANT * currents @ hand.q

    start, worst = total(), 0.0
    for _ in range(round(0.3 / step)):
        hand.advance(hand.t + 1.5 * step)
        worst = max(worst, abs(total() - start))
        assert hand.d.min() > 0.001
    return worst, hand.energy()


def test_energy_without_losses_drifts_with_the_third_power_of_the_step():
    coarse, energy = drift(0.25e-3)
    fine, _ = drift(0.125e-3)
    assert coarse < 1e-4 * energy
    assert 5 < coarse / fine < 11


# Order and agreement with an independent solver.


def reference(t, y, loss, currents, inertia):
    """The smooth equations of motion, from the closed form of the tips' energy."""
    geometry = HandGeometry()
    x, v, shear = y[:5], y[5:10], y[10:]
    c = geometry.contacts(x[:2], x[2:], WIDTH)
    jacobian = geometry.jacobian(x[:2], x[2:])
    rolling = geometry.rolling(x[:2], x[2:], WIDTH)
    forces = np.zeros(5)
    forces[:2] = CONSTANT * currents
    k = math.pi * MODULUS
    for i in range(2):
        d, theta, u = c.d[i], c.theta[i], shear[i]
        cos, sin, tan = np.cos(theta), np.sin(theta), np.tan(theta)
        by_d = k * (d * d / cos**2 + 2 * d * u * tan + u * u)
        by_theta = k * (2 * d**3 * sin / (3 * cos**3) + d * d * u / cos**2)
        by_shear = k * (d * d * tan + 2 * d * u)
        by_d += loss * 2 * k * d / cos**2 * (jacobian[i] @ v)
        by_theta += loss * k * d**3 / (1.5 * cos**3) * (jacobian[2 + i] @ v)
        by_shear += loss * 2 * k * d * (rolling[i] @ v)
        forces -= jacobian[i] * by_d + jacobian[2 + i] * by_theta + rolling[i] * by_shear
    return np.concatenate((v, forces / inertia, rolling @ v))


@pytest.mark.parametrize(("loss", "method"), [(0.002, "Radau"), (0.0, "DOP853")])
def test_agreement_with_an_adaptive_solver_and_order_two(loss, method):
    currents = np.array([0.65, 0.68])
    simulation = {**LOSSLESS, "tip_loss": loss}
    seconds, scale = 0.03, np.repeat([0.2, 0.08, 1.0, 0.001], [2, 3, 5, 2])

    def end(count: int) -> np.ndarray:
        hand = make(step=seconds / count, **simulation)
        hold_with(hand, currents)
        place(hand, (0.18, 0.17), (0.0005, 0.08, 0.02), velocity=(0.05, 0.05, 0.5))
        begin = hand.memory[:12].copy()
        hand.advance(hand.t + seconds)
        return begin, hand.memory[:12].copy()

    hand = make(**simulation)
    joint, mass, inertia = (
        hand.memory[i] for i in (layout.JOINT_INERTIA, layout.MASS, layout.INERTIA)
    )
    inertias = np.array([joint, joint, mass, mass, inertia])
    begin, _ = end(10)
    found = solve_ivp(
        reference,
        (0, seconds),
        begin,
        method=method,
        rtol=1e-11,
        atol=1e-13,
        args=(loss, currents, inertias),
    )
    exact = found.y[:, -1]
    errors = [np.abs((end(n)[1] - exact) / scale).max() for n in (240, 480, 30_000)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[2] < 1e-6


# Balance.


def settled(hand: SimulatedHand, goals, current: float, seconds: float = 2.0) -> None:
    for joint in range(2):
        hand.drive(joint, BOUNDED, True, goals[joint], current)
    run(hand, seconds)


def test_symmetric_grasp_settles_where_the_theory_puts_it():
    hand = make(table_friction=0.0, joint_friction=0.0)
    grasp = Grasp(HandGeometry(), PAPER, WIDTH)
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
    grasp = Grasp(HandGeometry(), PAPER, WIDTH)
    start = grasp.symmetric(0.004)
    place(hand, start.q, start.pose)
    hand.shear[:] = start.shear
    # The joints held stiffly and turned slowly, so that only they and the tips' energy decide.
    hand.memory[layout.POSITION_GAIN] = 1e5
    hand.memory[layout.RATE_GAIN] = 1e3
    hand.memory[layout.CURRENT_LIMIT] = 1e3
    hand.memory[layout.STALL_CURRENT] = 1e3
    delta = math.radians(degrees)
    for share in np.linspace(0, 1, 400):
        for joint, sign in ((0, 1), (1, -1)):
            hand.drive(joint, POSITION, True, start.q[joint] + sign * share * delta, 0.0)
        run(hand, 0.002)
    run(hand, 0.2)
    turned = hand.q[0] - start.q[0]
    assert turned == pytest.approx(delta, rel=1e-2)
    assert hand.object_pose[2] / turned == pytest.approx(gain, abs=2e-3)


def test_gravity_pulls_a_free_object_and_a_grasp_holds_it():
    hand = make(gravity=(0.0, -9.80665))
    run(hand, 0.1)
    t = hand.t
    np.testing.assert_allclose(hand.object_pose[1], 0.08 - 0.5 * 9.80665 * t * t, rtol=1e-12)
    assert hand.object_velocity[1] == pytest.approx(-9.80665 * t)
    held = make(gravity=(0.0, -9.80665), object_mass=0.3)
    grasp = Grasp(HandGeometry(), PAPER, WIDTH)
    start = grasp.symmetric(0.004)
    place(held, start.q, start.pose)
    settled(held, (0.9, 0.9), 0.7, 1.0)
    # The tips' push and shear in y carry the weight to 1 %, and nothing slips.
    along = held.tangential * np.cos(held.object_pose[2]) * [-1, 1]
    assert abs(along.sum()) == pytest.approx(0.3 * 9.80665, rel=0.01)
    place_before = held.object_pose[1]
    run(held, 1.0)
    assert held.object_pose[1] == pytest.approx(place_before, abs=1e-5)
    slippery = make(gravity=(0.0, -9.80665), object_mass=0.3, tip_friction=0.05)
    place(slippery, start.q, start.pose)
    settled(slippery, (0.9, 0.9), 0.7, 1.0)
    assert slippery.object_pose[1] < 0.0


def test_a_collision_keeps_momentum_and_energy():
    hand = make(object_mass=0.05, **LOSSLESS)
    place(hand, (0.0, 0.0), (-0.005, 0.08, 0.0), velocity=(-0.5, 0.0, 0.0))
    start = hand.energy()
    assert start == pytest.approx(0.5 * 0.05 * 0.25)
    impulse = 0.0
    while hand.t < 0.05:
        before = hand.normal[0]
        hand.advance(hand.t + 1.5 * hand.step)
        impulse += 0.5 * (before + hand.normal[0]) * hand.step
    assert hand.force[0] == 0.0
    assert hand.object_velocity[0] > 0.3
    assert 0.05 * (hand.object_velocity[0] + 0.5) == pytest.approx(impulse, rel=1e-3)
    # The finger takes L N dt, with the object's face upright all the while.
    assert hand.memory[layout.JOINT_INERTIA] * hand.dq[0] == pytest.approx(
        -0.080 * impulse, rel=3e-3
    )
    assert hand.energy() == pytest.approx(start, rel=1e-3)


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
    assert highest < 0.1 + 0.01 * 0.3  # overshoot below 1 % of the move
    np.testing.assert_allclose(hand.q, 0.1, atol=0.01)


def test_goal_current_is_reached_a_tenth_of_a_radian_away():
    hand = make()
    hand.memory[layout.JOINTS_HELD] = 1.0
    for joint, away in ((0, 0.1), (1, -0.1)):
        hand.drive(joint, BOUNDED, True, away, 1.0)
    run(hand, 0.02)
    np.testing.assert_allclose(hand.current, [1.0, -1.0], rtol=1e-6)


def test_modes_torque_and_electrics():
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
    with pytest.raises(ValueError, match="mode 16"):
        hand.drive(0, 16, True, 0.0, 0.1)
    with pytest.raises(ValueError, match="finite"):
        hand.drive(0, BOUNDED, True, math.nan, 0.1)


def test_end_stops_and_no_load_speed_bound_the_joints():
    hand = make()
    place(hand, (0.0, 0.0), (0.0, 0.3, 0.0))
    for joint in range(2):
        hand.drive(joint, CURRENT, True, 0.0, (3.0, -3.0)[joint])
    fastest = 0.0
    while hand.t < 2.0:
        run(hand, 0.002)
        fastest = max(fastest, np.abs(hand.dq).max())
    assert fastest < hand.memory[layout.NO_LOAD_SPEED]
    # 5.4 N·m on 500 N·m/rad, behind the clearance of 0.05 rad.
    assert 1.05 < hand.q[0] < 1.07
    assert -0.57 < hand.q[1] < -0.55


def test_torque_goes_off_by_itself_at_the_time_set():
    hand = make()
    place(hand, (0.0, 0.0), (0.0, 0.3, 0.0))
    hand.drive(0, BOUNDED, True, 0.5, 0.3)
    hand.hold_torque_until(0.05)
    run(hand, 0.049)
    assert hand.current[0] == pytest.approx(0.3)
    run(hand, 0.011)
    assert hand.current[0] < 1e-3


# Scenes.


def test_one_finger_alone_has_the_object_fixed():
    settings = Settings.model_validate({"scene": {"fingers": ("right",)}})
    hand = SimulatedHand(settings, table=PAPER)
    pose = hand.object_pose.copy()
    settled(hand, (0.9, 0.9), 0.5)
    np.testing.assert_array_equal(hand.object_pose, pose)
    assert hand.force[1] > 5.0
    assert hand.force[0] == 0.0
    assert hand.d[0] == 0.0


def test_scripted_compression_presses_both_tips_in_turn_to_eight_millimetres():
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
    # F = πE d²/cos θ at each instant.
    run(hand, 1.7)
    d = hand.d[0]
    assert d > 0.004
    assert hand.force[0] == pytest.approx(math.pi * MODULUS * d * d / math.cos(hand.theta[0]))


def test_without_servos_and_script_the_joints_stay():
    settings = Settings.model_validate(
        {"servos": {"backend": "none"}, "simulation": {"compression_speed": 0.0}}
    )
    hand = SimulatedHand(settings, table=PAPER)
    hand.push(0.5, 0.0)
    run(hand, 1.0)
    np.testing.assert_array_equal(hand.q, settings.hand.open_angle)
    # Friction's rest is viscous, so that it creeps to where the tip bears the whole push.
    assert hand.force[1] == pytest.approx(0.5, rel=0.1)


def test_tips_roll_over_the_ends_of_the_object():
    hand = make(object_height=0.02)
    geometry = HandGeometry()
    tip = geometry.tips((0.15, 0.15))[0]
    for height in np.linspace(0.05, 0.11, 25):
        place(hand, (0.15, 0.15), (0.0, height, 0.0))
        # The rectangle's point nearest to the tip's centre.
        point = np.array([-0.02, np.clip(tip[1], height - 0.01, height + 0.01)])
        way = point - tip
        distance = np.hypot(*way)
        assert hand.d[0] == pytest.approx(0.020 - distance, abs=1e-15)
        angle = math.atan2(way[1], way[0]) + 0.15
        assert hand.theta[0] == pytest.approx(angle, abs=1e-12)
        assert (hand.force[0] > 0) == (distance < 0.020)


def test_object_turned_by_a_right_angle_is_touched_on_its_other_faces():
    hand = make()
    place(hand, (0.05, 0.05), (0.0, 0.08, 0.5 * math.pi))
    geometry = HandGeometry()
    expected = geometry.contacts((0.05, 0.05), (0.0, 0.08, 0.0), 0.060)
    np.testing.assert_allclose(hand.d, expected.d, atol=1e-12)
    np.testing.assert_allclose(hand.theta, expected.theta, atol=1e-12)


# Time.


def test_advance_is_idempotent_and_split_ways_are_bit_identical():
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
    before = hands[0].memory.copy()
    hands[0].advance(0.5)
    np.testing.assert_array_equal(hands[0].memory[: layout.STATE], before[: layout.STATE])
    for hand in hands:
        assert hand.t == pytest.approx(1.0)
        np.testing.assert_array_equal(hand.memory[: layout.STATE], before[: layout.STATE])


def test_samples_stand_at_the_frames_instants_between_sub_steps():
    settings = Settings.model_validate({"tactile": {"rate": 130.0}})
    hand = SimulatedHand(settings, start=5.0, table=PAPER)
    finer = SimulatedHand(settings, start=5.0, table=PAPER, step=1.0 / 130.0 / 64)
    for h in (hand, finer):
        for joint in range(2):
            h.drive(joint, BOUNDED, True, 0.6, 0.4)
        h.advance(5.15)
    assert hand.samples == finer.samples == 20
    for number in range(hand.samples - 5, hand.samples):
        row, exact = hand.sample(number), finer.sample(number)
        assert row[layout.SAMPLE_T] == number / 130.0
        # A tick's motion is 1e-4 rad and 4e-6 m: a sample that isn't interpolated is off by that.
        np.testing.assert_allclose(row[2:4], exact[2:4], atol=8e-7)
        np.testing.assert_allclose(row[4:6], exact[4:6], atol=1e-5)
    with pytest.raises(LookupError):
        hand.sample(hand.samples)
    with pytest.raises(LookupError):
        hand.sample(0)


# Abuse.


@pytest.mark.parametrize("trial", range(24))
def test_random_commands_and_extreme_parameters_stay_finite(trial):
    generator = np.random.default_rng(100 + trial)
    hand = make(
        TABLE_I if trial % 2 else PAPER,
        step=(None, 2.5e-3)[trial % 3 == 0],
        object_mass=float(10 ** generator.uniform(-3, 1)),
        modulus_scale=float(10 ** generator.uniform(-1.5, 1.5)),
        tip_friction=float(generator.uniform(0, 2)),
        joint_inertia=float(10 ** generator.uniform(-4, -1)),
        tip_loss=float(10 ** generator.uniform(-5, -1)),
        gravity=(float(generator.normal()), float(generator.normal())),
    )
    for _ in range(400):
        joint = int(generator.integers(2))
        mode = int(generator.choice([CURRENT, POSITION, BOUNDED]))
        hand.drive(
            joint,
            mode,
            bool(generator.random() < 0.9),
            float(generator.uniform(-2, 2)),
            float(generator.uniform(-4, 4)),
        )
        if generator.random() < 0.2:
            hand.push(*generator.normal(size=2), float(generator.normal() * 0.05))
        if generator.random() < 0.01:
            place(hand, (0.0, 0.0), (0.0, 0.08, 0.0))  # open, the object back between the fingers
        run(hand, float(generator.uniform(0, 0.02)))
        assert np.isfinite(hand.memory).all()
        # Past the tip's limit only with the rim pressed in, which is told.
        limit = 0.020 * (1 - np.abs(np.sin(hand.theta)))
        past = (hand.d > limit + 1e-9) & (hand.force > 0)
        assert (hand.rim[past] > 0).all()
        assert np.abs(hand.q).max() < 1.6


def test_unknown_servo_is_a_settings_error():
    with pytest.raises(SettingsError, match=r"servos\.model"):
        SimulatedHand(Settings.model_validate({"servos": {"model": "XM999"}}), table=PAPER)


def test_mean_distance_of_a_square():
    # (√2 + asinh 1)/6 of the side.
    assert mean_distance(2.0, 2.0) == pytest.approx((math.sqrt(2) + math.asinh(1)) / 3, rel=1e-4)


def test_simulation_is_two_hundred_times_faster_than_real_time():
    hand = make(TABLE_I)
    for joint in range(2):
        hand.drive(joint, BOUNDED, True, 0.6, 0.4)
    hand.advance(0.1)
    best = math.inf
    for _ in range(20):
        begin = time.perf_counter()
        run(hand, 0.25)
        best = min(best, time.perf_counter() - begin)
    assert 0.25 / best > 200
