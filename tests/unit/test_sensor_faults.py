"""A witness that begins to lie in a grip: named, refused, never obeyed; by the plant's truth."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from softfinger.daemon.perception.hand_state import ANGLE, TAPER
from softfinger.daemon.perception.perception import RepeatDetector
from softfinger.tools.benchmarks.rigs import SOLID
from softfinger.tools.simulated_daemon import SimulatedDaemon as Hand
from tests.unit.test_control import grasped

FORCE = 6.0
BOTH = {"witness.left_sensor", "witness.right_sensor"}

# What lies: (kind, value, over [s], fingers, who is to be named, what the hand is in then). A zero
# that sinks takes all of a light touch with it: then joints hold where they are, or, where one tip
# alone seems to let go, its frames are refused. One that rises is seen beside the footprint.
LIES: dict[str, tuple[str, float, float, tuple[int, ...], set[str], str]] = {
    "one zero sinks": ("drift", -0.1, 1.0, (0,), {"witness.left_sensor"}, "armed"),
    "both zeros sink": ("drift", -0.1, 1.0, (0, 1), BOTH, "armed"),
    "both zeros rise": ("drift", 0.1, 1.0, (0, 1), set(), "holding"),
    "one image shifts": ("shift-x", 3.0, 0.0, (1,), {"witness.right_sensor"}, "fault"),
    "both images shift": ("shift-x", 3.0, 0.0, (0, 1), BOTH, "fault"),
    "one image is mirrored": ("mirror", 1.0, 0.0, (0,), {"witness.left_sensor"}, "fault"),
    "one current reads half": ("current", 0.5, 0.0, (0,), {"witness.left_current"}, "holding"),
    "one current reads double": ("current", 2.0, 0.0, (1,), {"witness.right_current"}, "holding"),
}


@pytest.mark.parametrize(
    "lie",
    [pytest.param(lie, marks=[pytest.mark.extended] * lie.startswith("both")) for lie in LIES],
)
def test_a_lie_is_named_and_never_obeyed(lie: str) -> None:
    kind, value, over, fingers, named, mode = LIES[lie]
    with Hand({}) as hand:
        grasped(hand, FORCE)
        for finger in fingers:
            hand.plant.measurement_faults[finger].begin(kind, value, hand.plant.t, over)
        seen = hand.watch(1.5)
        assert seen.force.max() < (1.4 if len(fingers) == 2 else 1.3) * FORCE
        found = {kind for _, kind, _ in hand.events if kind.startswith("witness")}
        assert found == named
        assert not [text for _, kind, text in hand.events if kind == "slip"]
        assert hand.mode == mode
        if mode == "holding":
            assert seen.force[-1].mean() == pytest.approx(FORCE, rel=0.1)
        if mode == "fault":  # without a sensor that can be believed, as without frames
            assert any(kind == "tactile.silent" for _, kind, _ in hand.events)


@pytest.mark.parametrize(
    ("kind", "value", "force"),
    [("drift", -0.06, 5.0), ("replay", 0.41, 5.0), ("replay", 0.41, 8.0)],
)
def test_a_tip_that_seems_to_let_go_is_no_sudden_load(kind, value, force):
    with Hand({}) as hand:
        hand.grasp(force)
        while hand.mode != "holding":
            hand.run(0.002)
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
def test_a_gain_that_changes_leaves_a_solid_tips_force(gain: float, over: float) -> None:
    with Hand(SOLID) as hand:
        grasped(hand, FORCE)
        for finger in hand.plant.measurement_faults:
            finger.begin("gain", gain, hand.plant.t, over)
        seen = hand.watch(over + 2.0)
        assert hand.mode == "holding"
        assert seen.force.max() < 1.4 * FORCE
        assert seen.force[-1].mean() == pytest.approx(FORCE, rel=0.35 if over else 0.2)
        assert not [text for _, kind, text in hand.events if kind == "slip"]


def test_a_sensor_that_was_blind_for_a_moment_raises_no_grip() -> None:
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


def test_an_estimate_that_is_no_number_or_no_hands_begins_anew():
    with Hand({}) as hand:
        grasped(hand, FORCE)
        state = hand.estimator._state
        state.mean[ANGLE] = math.nan
        assert hand.watch(0.5).force.max() < 1.1 * FORCE
        assert hand.mode == "holding"
        state.mean[TAPER] = math.pi
        hand.watch(0.1)
        assert abs(state.rotation) < 1.0


def test_a_sensor_that_is_honest_again_is_believed_again() -> None:
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
        assert not [kind for _, kind, _ in hand.events if kind.startswith("witness")]


def test_a_d_that_jumps_while_joints_and_the_other_tip_stand_still_is_refused() -> None:
    with Hand({}) as hand:
        hand.grasp(FORCE)
        while hand.mode != "holding":
            hand.run(0.002)
        zero = hand.plant.measurement_faults[1]
        zero.begin("drift", -0.05, hand.plant.t)
        seen = hand.watch(0.09)
        zero.clear()
        assert seen.force.max() < 1.1 * FORCE
        (told,) = [text for _, kind, text in hand.events if kind == "witness.right_sensor"]
        assert "mm less deep at once" in told


def test_rolling_that_both_tips_show_alike_in_a_turn_is_no_drift() -> None:
    with Hand({}) as hand:
        grasped(hand, 10.0)
        hand.plant.load(twist=-0.122)
        hand.watch(0.3)
        hand.command("rotate", angle=0.205)
        hand.watch(1.5)
        assert hand.mode == "holding"
        assert not [event for event in hand.events if event[1].startswith("witness")]


def test_frames_that_come_again_are_refused_and_a_new_force_is_not_built_up_on_them() -> None:
    with Hand({}) as hand:
        grasped(hand, FORCE)
        for finger in hand.plant.measurement_faults:
            finger.begin("replay", 0.6, hand.plant.t)
        hand.command("grasp", force=20.0)
        seen = hand.watch(1.0)
        assert seen.force.max() < 1.3 * 20.0
        assert hand.mode == "fault"
        found = {kind for _, kind, _ in hand.events if kind.startswith("witness")}
        assert found == BOTH


@pytest.mark.parametrize(
    "load",
    [(0.0, 5.0, 0.0), pytest.param((3.0, 0.0, 0.0), marks=pytest.mark.extended), (0.0, 0.0, 0.2)],
)
def test_a_real_load_and_a_real_turn_are_no_lie(load: tuple[float, float, float]) -> None:
    with Hand({}) as hand:
        grasped(hand, 10.0)
        for sign in (1.0, -1.0, 0.0):
            hand.plant.apply_load(*(sign * each for each in load))
            hand.watch(0.8)
        hand.command("rotate", angle=0.12)
        hand.watch(1.0)
        assert hand.mode == "holding"
        assert not [event for event in hand.events if event[1].startswith("witness")]


def given(repeats: RepeatDetector, frames: list[float]) -> bool:
    for number in frames:  # a tenth more is more in one cell alone
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
    "again, but longer ago than is remembered": (lambda: [*range(300), *range(20)], False),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_only_an_order_that_comes_again_is_a_repetition(name: str) -> None:
    frames, expected = SEQUENCES[name]
    assert given(RepeatDetector(100.0), frames()) is expected
    assert not given(RepeatDetector(100.0, enabled=False), frames())
