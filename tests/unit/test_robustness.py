"""Test hands that differ from their settings; the plant's true values are the reference."""

import math

import numpy as np
import pytest

from softfinger.tools.benchmarks.rigs import GripCase, VirtualGrip, merged
from softfinger.tools.benchmarks.robustness import ROWS, drawn, drawn_in_mujoco, grip

ROW = {case.name: case for case in ROWS}
LONG = pytest.mark.extended


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("as set", 1),
        ("joint friction 0.12 N·m", 1),
        ("joint friction 0.20 N·m", 1),
        pytest.param("stiction 0.15 N·m", 1, marks=LONG),
        pytest.param("zero +5% in 20 s, 8 bits", 1, marks=LONG),
        ("frames 15 ms older", 1),
        ("frames 10 ms older", 1),
        *(pytest.param(name, 1, marks=LONG) for name in ("frames 30 ms older", "cells of 80 ms")),
        ("both gains and currents halve in 5 s", 1),
    ],
)
def test_unknown_hand_parameters_do_not_change_the_force(name, seed):
    found = grip(ROW[name], seed)
    assert found.held
    assert found.settled == pytest.approx(1.0, abs=0.2)
    assert found.peak < 1.3
    assert not found.raised
    assert found.accused == ()


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("zero -5% in 20 s", 1),
        pytest.param("zero -2% in 20 s", 2, marks=LONG),
        pytest.param("zero -5% in 20 s, 8 bits", 2, marks=LONG),
    ],
)
def test_a_falling_zero_offset_is_named_and_the_grip_continues(name, seed):
    """Readings are clipped at 0, so only the joints' motion shows how far the offset has fallen."""
    found = grip(ROW[name], seed)
    assert found.end == "holding"
    assert found.settled == pytest.approx(1.0, abs=0.2)
    assert found.peak < 1.3
    assert found.named < math.inf
    assert not found.raised


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("force", [6.0, pytest.param(20.0, marks=LONG)])
def test_frames_up_to_the_default_latency_do_not_change_the_force(delay, force):
    late = GripCase("late", force, {"simulation": {"tactile_delay": delay}})
    found = grip(late)
    assert found.settled == pytest.approx(1.0, abs=0.1)
    assert found.accused == ()


@pytest.mark.parametrize(("friction", "stiction"), [(0.05, 0.0), (0.12, 0.0), (0.05, 0.1)])
def test_joint_friction_is_estimated_during_the_approach(friction, stiction):
    hand = {"simulation": {"joint_friction": friction, "joint_stribeck": stiction}}
    with VirtualGrip({}, hand) as grip:
        grip.command("arm")
        grip.loop.advance(0.1)
        grip.command("grasp", force=6.0)
        assert grip.until("holding", 4.0)
        # The estimate includes the joint damping. The estimate also includes the static friction
        # that remains when a joint starts to move.
        shown = grip.estimator.grasp.free_torque
        assert (shown > friction + 0.5 * stiction).all()
        assert (shown < friction + stiction + 0.025).all()


@pytest.mark.parametrize(
    ("friction", "torque", "force"), [(0.13, 0.87, 4.4), (0.12, 0.9, 6.0), (0.15, 0.9, 6.0)]
)
def test_friction_and_a_weak_motor_do_not_leave_a_force_error(friction, torque, force):
    hand = {"simulation": {"joint_friction": friction, "joint_stribeck": 0.05}}
    with VirtualGrip({}, hand, torque) as grip:
        grip.command("arm")
        grip.loop.advance(0.1)
        grip.command("grasp", force=force)
        assert grip.until("holding", 4.0)
        assert grip.plant.force.min() > 0.82 * force


@pytest.mark.extended
def test_old_frames_and_slow_cells_do_not_change_the_force():
    """In this hand, frames are 37 ms older, and the cells respond within 73 ms."""
    found = grip(drawn(275))
    assert found.settled == pytest.approx(1.0, abs=0.12)
    assert not found.raised
    assert found.accused == ()


@pytest.mark.extended
def test_hands_of_the_ensemble_grip_in_mujoco():
    pytest.importorskip("mujoco")
    case = drawn_in_mujoco(3)
    with VirtualGrip(case.daemon, merged(case.hand, case.daemon)) as hand:
        hand.command("arm")
        hand.loop.advance(0.1)
        hand.command("grasp", force=case.force)
        assert hand.until("holding", 4.0)
        assert hand.plant.force.mean() == pytest.approx(case.force, rel=0.2)


def test_equal_seeds_give_equal_hands():
    assert drawn(7) == drawn(7)
    hands = [drawn(seed) for seed in range(1, 201)]
    delays = [hand.hand["simulation"]["tactile_delay"] for hand in hands]
    assert min(delays) < 0.025 < 0.055 < max(delays) <= 0.06
    assert 0.4 < np.mean([hand.load != 0.0 for hand in hands]) < 0.6
