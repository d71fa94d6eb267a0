"""The plant's kernel: one energy, its order, an independent solver, and what it survives."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from daemon.simulation import layout
from daemon.simulation.hand import SimulatedHand
from daemon.simulation.tip import evaluate_tip
from kinematics.fingers import HandGeometry
from kinematics.kernels import kernel
from kinematics.lanes import address
from tests.fuzz_plant import abuse
from tests.plant_harness import (
    BOUNDED,
    CONSTANT,
    LOSSLESS,
    MODULUS,
    PAPER,
    TABLE_I,
    WIDTH,
    hold_with,
    make,
    place,
    run,
)

# One tip alone.


@kernel
def evaluate_one(memory, data, finger, q, way, slope, turn, shear):
    evaluate_tip(
        address(memory),
        address(data),
        layout.TIP,
        finger,
        layout.VELOCITY,
        math.cos(q),
        math.sin(q),
        slope[0],
        slope[1],
        way[0],
        way[1],
        math.cos(turn),
        math.sin(turn),
        shear,
    )


def tip_row(hand: SimulatedHand, finger: int, q, pose, shear: float) -> np.ndarray:
    """Evaluate one tip at rest; a copy of its row."""
    geometry = HandGeometry()
    tip = geometry.tips([q, q])[finger]
    slope = geometry.tip_jacobian([q, q])[finger]
    hand.memory[layout.VELOCITY : layout.VELOCITY + 5] = 0.0
    evaluate_one(hand.memory, hand.table.data, finger, q, tip - pose[:2], slope, pose[2], shear)
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


# Abuse.


@pytest.mark.parametrize("seed", range(24))
def test_random_commands_and_extreme_parameters_stay_finite(seed):
    # With default-sized steps and, one time in three, steps ten times too long.
    assert abuse(seed, 400) == ""


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
