"""Test presliding joint friction when joints stick, break away or reverse."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from tests.harness.plant import CONSTANT, CURRENT, PAPER, POSITION, hold_with, make, place, run

FRICTION = 0.05  # default value [N·m]
PRESLIDING = 0.0005  # default value [rad]
INERTIA, DAMPING = 0.010, 0.02  # default values [kg·m², N·m·s/rad]
STRIBECK_SPEED = 0.12  # default value [rad/s]
COUNT = 2.0 * math.pi / 4096  # one encoder count [rad]


def joint(step: float | None = None, **simulation: float) -> SimulatedHand:
    """Return a hand whose left joint is at 0 rad and has no contact."""
    hand = make(PAPER, step, object_shape="none", **simulation)
    hold_with(hand, (0.0, 0.0))
    place(hand, (0.0, -0.3), (0.0, 0.3, 0.0))
    return hand


def load(hand: SimulatedHand, torques: Iterable[float], each: float) -> np.ndarray:
    """Apply each motor torque [N·m] for ``each`` [s]; return the joint angle after each torque."""
    found = []
    for torque in torques:
        hand.drive(0, CURRENT, True, 0.0, torque / CONSTANT)
        run(hand, each)
        found.append(hand.q[0])
    return np.array(found)


# Sticking.


@pytest.mark.parametrize("share", [0.1, 0.6, 0.98])
def test_a_constant_load_below_static_friction_causes_no_creep(share):
    hand = joint()
    (*_, angle) = load(hand, np.linspace(0.0, share * FRICTION, 200), 0.005)
    run(hand, 1.0)
    assert hand.q[0] == pytest.approx(share * PRESLIDING, rel=1e-3)
    assert angle == pytest.approx(hand.q[0], rel=0.02)
    before = hand.q[0]
    run(hand, 60.0)
    assert abs(hand.q[0] - before) < 1e-9 * COUNT


def test_an_oscillating_load_below_static_friction_causes_no_drift():
    # In the LuGre model, the joint would creep in each period (Dupont et al., 2002).
    hand = joint()
    load(hand, np.linspace(0.0, 0.6 * FRICTION, 100), 0.005)
    phases = np.arange(0.0, 60.0, 0.02) * 2.0 * math.pi
    turn = load(hand, FRICTION * (0.6 + 0.3 * np.sin(phases)), 0.02).reshape(60, 50)
    assert np.ptp(turn[1]) == pytest.approx(0.6 * PRESLIDING, rel=0.05)
    np.testing.assert_allclose(turn[-1], turn[1], rtol=0, atol=1e-9 * COUNT)


def test_very_stiff_bristles_also_stick():
    # With this presliding [rad] and inertia [kg·m²], the oscillation has a period of 0.3 ms. The
    # time step is 0.25 ms.
    presliding, inertia = 1e-6, 1e-4
    hand = joint(2.5e-4, joint_presliding=presliding, joint_inertia=inertia)
    load(hand, np.linspace(0.0, 0.6 * FRICTION, 100), 0.005)
    run(hand, 1.0)
    # The joint may slip at first.
    assert hand.q[0] == pytest.approx(0.6 * presliding, abs=presliding)
    assert abs(hand.dq[0]) < 1e-9
    assert hand.plant.state.bristles[0] == pytest.approx(0.6 * presliding, rel=1e-6)
    assert hand.plant.limited_step_count == 0


# Sliding.


def test_break_away_is_at_the_static_friction_torque():
    stribeck = 0.4 * FRICTION
    hand = joint(joint_stribeck=stribeck)
    torques = np.linspace(0.0, 1.2 * (FRICTION + stribeck), 1500)
    angles = load(hand, torques, 0.005)
    slipped = torques[np.argmax(angles > 1.05 * PRESLIDING)]
    assert slipped == pytest.approx(FRICTION + stribeck, rel=0.01)
    # Once the joint slips, the additional static friction disappears, so the joint accelerates.
    assert angles[-1] > 100 * PRESLIDING


def test_friction_reverses_over_twice_the_presliding_distance():
    hand = joint(joint_damping=0.0)
    p = hand.plant.parameters
    # Gains [A/rad, A·s/rad] of the control of the joint angle.
    p.position_gain, p.rate_gain = 200.0, 2.0
    speed, each = 0.01, 0.001  # speed [rad/s] and time step [s]
    way = np.concatenate((np.arange(0.0, 0.02, speed * each), np.arange(0.02, 0.0, -speed * each)))
    torques, angles = [], []
    for goal in way:
        hand.drive(0, POSITION, True, goal, 0.0)
        run(hand, each)
        torques.append(CONSTANT * hand.current[0])
        angles.append(hand.q[0])
    torque, angle = np.array(torques), np.array(angles)
    turn = len(way) // 2
    closing, opening = torque[turn - 200 : turn].mean(), torque[-200:].mean()
    assert closing == pytest.approx(FRICTION, rel=0.01)
    assert closing - opening == pytest.approx(2.0 * FRICTION, rel=0.01)
    # The transition is a straight line with the slope friction / presliding distance.
    within = slice(turn + 20, turn + 80)
    slope, _ = np.polyfit(angle[within], torque[within], 1)
    assert slope == pytest.approx(FRICTION / PRESLIDING, rel=0.02)


def test_friction_dissipates_energy_and_bristles_return_theirs():
    hand = joint(joint_damping=0.0)
    place(hand, (0.0, -0.3), (0.0, 0.3, 0.0), (0.5, 0.0))
    energy, angles = [hand.plant.energy], []
    for _ in range(1200):
        hand.advance(hand.t + 1.5 * hand.step)
        energy.append(hand.plant.energy)
        angles.append(hand.q[0])
    assert energy[0] == pytest.approx(0.5 * INERTIA * 0.5**2)
    assert (np.diff(energy) <= 0.0).all()
    assert energy[-1] < 1e-6 * energy[0]
    way = energy[0] / FRICTION
    assert max(angles) == pytest.approx(way, abs=PRESLIDING)
    assert max(angles) - angles[-1] == pytest.approx(PRESLIDING, rel=0.02)


def test_a_friction_level_that_changes_at_standstill_adds_no_torque():
    share = 0.5
    hand = joint(joint_load_friction=(share, 0.0))
    hand.plant.parameters.joints_held = True
    hand.plant.state.bristles[0] = 0.6 * PRESLIDING

    def torque(motor: float) -> float:
        load(hand, [motor], 0.02)  # long compared with the motor's time constant
        gears = hand.plant.gears[0]
        assert gears.friction == pytest.approx(FRICTION + share * motor, rel=1e-6)
        return gears.friction * gears.limited_deflection / PRESLIDING

    bent = 0.6 * FRICTION
    assert torque(0.0) == pytest.approx(bent, rel=1e-6)
    assert torque(1.0) == pytest.approx(bent, rel=1e-6), "new bristles must start undeflected"
    parted = FRICTION / (FRICTION + share)
    assert torque(0.0) == pytest.approx(bent * parted, rel=1e-6), (
        "removed bristles must release their torque"
    )


# Adaptive solver.


def reference(torque: float, rate: float, stribeck: float, seconds: float) -> np.ndarray:
    """Solve the plant's equations with SciPy; return angle, velocity and deflection.

    The initial velocity is ``rate`` [rad/s].
    """

    def equations(_t, state):
        _, v, z = state
        still = stribeck * math.exp(-abs(v) / STRIBECK_SPEED)
        level = FRICTION + still
        drag = math.sqrt(level / PRESLIDING * INERTIA) * v
        friction = min(max(level * z / PRESLIDING + drag, -level), level)
        acceleration = (torque - DAMPING * v - friction) / INERTIA
        rise = -still / STRIBECK_SPEED * math.copysign(acceleration, acceleration * v)
        bends = v - z * max(rise, 0.0) / level
        if abs(z) >= PRESLIDING and z * bends > 0.0:
            bends = 0.0
        return v, acceleration, bends

    found = solve_ivp(
        equations, (0.0, seconds), (0.0, rate, 0.0), "DOP853", rtol=1e-9, atol=1e-13, max_step=1e-4
    )
    return found.y[:, -1]


SECONDS = 0.1
SCALE = (PRESLIDING, 0.1, PRESLIDING)


def errors(torque: float, rate: float, stribeck: float, counts: Iterable[int]) -> list[float]:
    """Return the maximum error relative to SCALE for each number of steps."""
    exact, found = reference(torque, rate, stribeck, SECONDS), []
    for count in counts:
        hand = joint(SECONDS / count, joint_stribeck=stribeck)
        hold_with(hand, (torque / CONSTANT, 0.0))
        place(hand, (0.0, -0.3), (0.0, 0.3, 0.0), (rate, 0.0))
        run(hand, SECONDS)
        state = (hand.q[0], hand.dq[0], hand.plant.state.bristles[0])
        found.append(np.abs((np.array(state) - exact) / SCALE).max())
        assert hand.plant.limited_step_count == 0
    return found


def test_sticking_is_second_order_and_agrees_with_an_adaptive_solver():
    coarse, fine = errors(0.6 * FRICTION, 0.0, 0.0, (400, 800))
    assert coarse < 1e-6
    assert coarse / fine == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("stribeck", [0.0, 0.03])
@pytest.mark.parametrize("rate", [0.2, -0.3])
def test_sliding_and_subsequent_sticking_agree_with_an_adaptive_solver(rate, stribeck):
    coarse, fine = errors(0.6 * FRICTION, rate, stribeck, (400, 12_800))
    assert coarse < 5e-3
    assert fine < 1e-4
