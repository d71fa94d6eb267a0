"""Test that the daemon rejects wrong measurements during a grip and keeps the force correct."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from softfinger.daemon.perception.hand_state import ANGLE, TAPER
from softfinger.daemon.perception.perception import RepeatDetector
from softfinger.tools.benchmarks.rigs import SOLID
from softfinger.tools.simulated_daemon import SimulatedDaemon as Hand
from tests.harness.loop import run_until
from tests.unit.test_control import grasped

FORCE = 6.0
BOTH = {"consistency.left_sensor", "consistency.right_sensor"}

# For each fault: kind, value, duration [s], affected fingers, expected events and expected final
# mode. A falling zero offset hides a light touch completely, and the joints then hold their
# positions. If only one tip seems to lose contact, the daemon rejects the frames of this tip
# instead. A rising zero offset shows in the cells next to the footprint.
LIES: dict[str, tuple[str, float, float, tuple[int, ...], set[str], set[str]]] = {
    "one zero sinks": ("drift", -0.1, 1.0, (0,), {"consistency.left_sensor"}, {"armed"}),
    "both zeros sink": ("drift", -0.1, 1.0, (0, 1), BOTH, {"armed", "holding"}),
    "both zeros rise": ("drift", 0.1, 1.0, (0, 1), set(), {"holding"}),
    "one image shifts": ("shift-x", 3.0, 0.0, (1,), {"consistency.right_sensor"}, {"fault"}),
    "both images shift": ("shift-x", 3.0, 0.0, (0, 1), BOTH, {"fault"}),
    "one image is mirrored": ("mirror", 1.0, 0.0, (0,), {"consistency.left_sensor"}, {"fault"}),
    "one current reads half": (
        "current",
        0.5,
        0.0,
        (0,),
        {"consistency.left_current"},
        {"holding"},
    ),
    "one current reads double": (
        "current",
        2.0,
        0.0,
        (1,),
        {"consistency.right_current"},
        {"holding"},
    ),
}


@pytest.mark.parametrize(
    "lie",
    [pytest.param(lie, marks=[pytest.mark.extended] * lie.startswith("both")) for lie in LIES],
)
def test_a_measurement_fault_is_named_and_has_no_effect(lie: str) -> None:
    kind, value, over, fingers, named, modes = LIES[lie]
    with Hand({}) as hand:
        grasped(hand, FORCE)
        for finger in fingers:
            hand.plant.measurement_faults[finger].begin(kind, value, hand.plant.t, over)
        seen = hand.watch(3.0)
        assert seen.force.max() < (1.4 if len(fingers) == 2 else 1.3) * FORCE
        found = {kind for _, kind, _ in hand.events if kind.startswith("consistency")}
        # If both sensors are wrong, the one with the larger error may hide the other.
        assert found == named or (len(fingers) == 2 and found and found < named)
        assert not [text for _, kind, text in hand.events if kind == "slip"]
        assert hand.mode in modes
        if modes == {"holding"}:
            assert seen.force[-1].mean() == pytest.approx(FORCE, rel=0.1)
        if modes == {"fault"}:  # The daemon treats the frames as missing.
            assert any(kind == "tactile.silent" for _, kind, _ in hand.events)


@pytest.mark.parametrize("over", [0.0, 2.0])
def test_a_gain_change_at_one_solid_tip_is_named_and_has_no_effect(over):
    """The frames of a solid tip measure only the product of force and gain."""
    with Hand(SOLID) as hand:
        grasped(hand, FORCE)
        hand.plant.measurement_faults[0].begin("gain", 0.5, hand.plant.t, over)
        seen = hand.watch(over + 2.0)
        assert {kind for _, kind, _ in hand.events if kind.startswith("consistency")} == {
            "consistency.left_sensor"
        }
        assert hand.mode == "holding"
        assert seen.force == pytest.approx(FORCE, rel=0.1)


@pytest.mark.parametrize(
    ("kind", "value", "force"),
    [("drift", -0.06, 5.0), ("replay", 0.41, 5.0), ("replay", 0.41, 8.0)],
)
def test_a_tip_that_seems_to_let_go_is_not_a_sudden_load(kind, value, force):
    with Hand({}) as hand:
        hand.grasp(force)
        run_until(hand, lambda: hand.mode == "holding", step=hand.loop.period)
        hand.plant.measurement_faults[1].begin(kind, value, hand.plant.t)
        seen = hand.watch(0.5)
        assert seen.force.max() < 1.4 * force
        assert not [text for _, kind, text in hand.events if kind == "slip"]


@pytest.mark.parametrize(
    ("gain", "over"),
    [
        (0.5, 0.0),
        pytest.param(1.6, 0.0, marks=pytest.mark.extended),
        pytest.param(0.6, 2.0, marks=pytest.mark.extended),
    ],
)
def test_a_gain_change_does_not_affect_the_force_of_a_solid_tip(gain: float, over: float) -> None:
    with Hand(SOLID) as hand:
        grasped(hand, FORCE)
        for finger in hand.plant.measurement_faults:
            finger.begin("gain", gain, hand.plant.t, over)
        seen = hand.watch(over + 2.0)
        assert hand.mode == "holding"
        assert seen.force.max() < 1.2 * FORCE
        assert seen.force[-1].mean() == pytest.approx(FORCE, rel=0.1)
        assert not [text for _, kind, text in hand.events if kind == "slip"]


def test_a_brief_loss_of_a_sensor_does_not_raise_the_grip() -> None:
    with Hand({}) as hand:
        grasped(hand, FORCE)
        blind = hand.plant.measurement_faults[0]
        blind.begin("gain", 0.0, hand.plant.t)
        hand.watch(0.036)
        blind.clear()
        seen = hand.watch(1.0)
        assert hand.mode == "holding"
        assert seen.force.max() < 1.1 * FORCE
        assert seen.force[-1].mean() == pytest.approx(FORCE, rel=0.05)
        assert not [text for _, kind, text in hand.events if kind == "slip"]


def test_an_invalid_estimate_is_reset():
    with Hand({}) as hand:
        grasped(hand, FORCE)
        state = hand.estimator._state
        state.mean[ANGLE] = math.nan
        assert hand.watch(0.5).force.max() < 1.1 * FORCE
        assert hand.mode == "holding"
        state.mean[TAPER] = math.pi
        hand.watch(0.1)
        assert abs(state.rotation) < 1.0


def test_a_recovered_sensor_is_used_again() -> None:
    with Hand({}) as hand:
        grasped(hand, FORCE)
        for finger in hand.plant.measurement_faults:
            finger.begin("drift", -0.1, hand.plant.t, 1.0)
        hand.watch(1.5)
        for finger in hand.plant.measurement_faults:
            finger.clear()
        hand.command("release")
        hand.watch(1.0)
        hand.command("disarm")
        hand.plant.place_object()
        hand.events.clear()
        grasped(hand, FORCE)
        assert hand.mode == "holding"
        assert hand.plant.normal.mean() == pytest.approx(FORCE, rel=0.1)
        assert not [kind for _, kind, _ in hand.events if kind.startswith("consistency")]


def test_a_d_jump_without_motion_of_joints_and_the_other_tip_is_rejected() -> None:
    with Hand({}) as hand:
        hand.grasp(FORCE)
        run_until(hand, lambda: hand.mode == "holding", step=hand.loop.period)
        zero = hand.plant.measurement_faults[1]
        zero.begin("drift", -0.05, hand.plant.t)
        seen = hand.watch(0.09)
        zero.clear()
        assert seen.force.max() < 1.1 * FORCE
        (told,) = [text for _, kind, text in hand.events if kind == "consistency.right_sensor"]
        assert "a jump of -" in told


def test_equal_rolling_of_both_tips_in_a_turn_is_not_a_drift() -> None:
    with Hand({}) as hand:
        grasped(hand, 10.0)
        hand.plant.load(twist=-0.122)
        hand.watch(0.3)
        hand.command("rotate", angle=0.205)
        hand.watch(1.5)
        assert hand.mode == "holding"
        assert not [event for event in hand.events if event[1].startswith("consistency")]


def test_repeated_frames_are_rejected_and_the_force_is_not_changed_with_them() -> None:
    with Hand({}) as hand:
        grasped(hand, FORCE)
        for finger in hand.plant.measurement_faults:
            finger.begin("replay", 0.6, hand.plant.t)
        hand.command("grasp", force=20.0)
        seen = hand.watch(1.0)
        assert seen.force.max() < 1.3 * 20.0
        assert hand.mode == "fault"
        found = {kind for _, kind, _ in hand.events if kind.startswith("consistency")}
        assert found == BOTH


@pytest.mark.parametrize(
    "load",
    [(0.0, 5.0, 0.0), pytest.param((3.0, 0.0, 0.0), marks=pytest.mark.extended), (0.0, 0.0, 0.2)],
)
def test_real_loads_and_turns_are_not_measurement_faults(load: tuple[float, float, float]) -> None:
    with Hand({}) as hand:
        grasped(hand, 10.0)
        for sign in (1.0, -1.0, 0.0):
            hand.plant.apply_load(*(sign * each for each in load))
            hand.watch(0.8)
        hand.command("rotate", angle=0.12)
        hand.watch(1.0)
        assert hand.mode == "holding"
        assert not [event for event in hand.events if event[1].startswith("consistency")]


def given(repeats: RepeatDetector, frames: list[float]) -> bool:
    for number in frames:  # Only the last cell resolves tenths.
        repeats.update(np.array([number, number, number, 10.0 * number]).astype(np.uint16))
    return repeats.is_fault


SEQUENCES: dict[str, tuple[Callable[[], list[float]], bool]] = {
    "all differ": (lambda: list(range(400)), False),
    "one again and again": (lambda: [7] * 400, False),
    "two by turns": (lambda: [7.0, 8.0] * 200, True),
    "two by turns, by one cell of a quiet sensor": (lambda: [7.0, 7.1] * 200, False),
    "few values, as noise has them": (
        lambda: np.random.default_rng(1).integers(0, 12, 400).tolist(),
        False,
    ),
    "sixty again": (lambda: [*range(60), *range(20)], True),
    "150 again": (lambda: [*range(150), *range(20)], True),
    "again, but longer ago than is remembered": (lambda: [*range(300), *range(20)], False),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_only_a_recurring_order_is_a_repetition(name: str) -> None:
    frames, expected = SEQUENCES[name]
    assert given(RepeatDetector(100.0, 10.0), frames()) is expected
    assert not given(RepeatDetector(100.0, 10.0, enabled=False), frames())


@pytest.mark.parametrize(("changing", "is_repetition"), [(3, False), (5, True)])
def test_a_repetition_is_recognised_by_several_changing_cells(changing, is_repetition):
    repeats = RepeatDetector(100.0, 10.0)
    for number in [1, 2] * 50:
        frame = np.zeros(8, np.uint16)
        frame[:changing] = number
        repeats.update(frame)
    assert repeats.is_fault == is_repetition


def test_rejected_frames_are_forgotten_after_the_grip():
    with Hand({}) as hand:
        grasped(hand, FORCE)
        faults, rejects = hand.plant.measurement_faults[1], hand.estimator.grasp.rejects_frames
        faults.begin("shift-x", 3.0, hand.plant.t)
        run_until(hand, lambda: rejects[1])
        hand.run(0.5)
        assert hand.mode == "fault"
        faults.clear()
        hand.command("clear")
        hand.run(0.1)
        assert not rejects.any()
