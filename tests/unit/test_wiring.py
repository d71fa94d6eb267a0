"""Test that servos with swapped IDs or wrong directions are detected before they do harm."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.loop import build
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.wiring import WiringWatch
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.types import State
from softfinger.kinematics.estimation.invalid import Invalid
from tests.harness.loop import armed, command, heard, run_until

# Signs and offsets [rad] of the readings of both joints.
JOINTS = {
    "reversed": ((-1.0, -1.0), (0.0, 0.0)),
    "left reversed": ((-1.0, 1.0), (0.0, 0.0)),
    "right reversed": ((1.0, -1.0), (0.0, 0.0)),
    "both zeros off": ((1.0, 1.0), (0.05, 0.05)),
    "one zero off": ((1.0, 1.0), (0.1, 0.0)),
}


class Miswired:
    """A simulated hand whose servos drive the wrong finger or turn in the wrong direction."""

    def __init__(self, hand: Any, wiring: str) -> None:
        self._hand, self._swapped = hand, wiring == "swapped"
        signs, zeros = JOINTS.get(wiring, ((1.0, 1.0), (0.0, 0.0)))
        self._signs, self._zeros = np.array(signs), np.array(zeros)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._hand, name)
        if name in ("q", "dq", "current"):
            zeros = self._zeros if name == "q" else 0.0
            return found[::-1] if self._swapped else self._signs * found + zeros
        return found

    def measured_current(self, joint: int) -> float:
        if self._swapped:
            return self._hand.measured_current(1 - joint)
        return self._signs[joint] * self._hand.measured_current(joint)

    def drive(self, joint: int, mode: int, torque: bool, q: float, current: float) -> None:
        if self._swapped:
            self._hand.drive(1 - joint, mode, torque, q, current)
        else:
            q = self._signs[joint] * (q - self._zeros[joint])
            self._hand.drive(joint, mode, torque, q, current)


Make = Callable[..., Daemon]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that creates an armed daemon with the given wiring, in virtual time."""
    with ExitStack() as stack:

        def make(wiring: str, **simulation: Any) -> Daemon:
            def servos(settings: Settings, clock: Any, hand: Any) -> SimulatedServos:
                miswired = hand if wiring == "right" else Miswired(hand, wiring)
                return SimulatedServos(settings, miswired, clock)

            monkeypatch.setattr(build, "make_servos", servos)
            values = {"loop": {"clock": "virtual"}, "simulation": simulation}
            daemon = stack.enter_context(
                closing(Daemon(Settings.model_validate(values), wire=False))
            )
            daemon.loop.advance(0.2)
            return armed(daemon)

        yield make


def greatest_force(daemon: Daemon, seconds: float) -> float:
    """Run for ``seconds`` or until a fault; return the maximum true tip force."""
    greatest = 0.0
    for _ in range(round(seconds / 0.02)):
        daemon.loop.advance(0.02)
        greatest = max(greatest, *daemon.hand.force.tolist())
        if daemon.loop.state.fault:
            break
    return greatest


OFF = [0.006, -0.006]  # offset of the object from the middle [m]
HEAVY = {"object_mass": 0.5, "table_friction": 0.5}


@pytest.mark.parametrize("off", OFF)
@pytest.mark.parametrize("object_", [{}, HEAVY], ids=["light", "heavy"])
def test_swapped_servos_are_detected_during_the_approach(make, off, object_):
    daemon = make("swapped", object_position=(off, 0.08), **object_)
    command(daemon, "grasp", force=6.0)
    assert greatest_force(daemon, 3.0) < 4.0
    assert daemon.loop.state.fault_name == "joint.swapped"
    assert "joint: check whether the servo IDs are swapped (servos.ids)" in daemon.loop.state.fault
    assert not daemon.hand.torque_on.any()


@pytest.mark.parametrize(("follows", "swapped"), [(0, True), (1, False)])
def test_the_tilt_shows_whose_motion_a_tip_follows_despite_a_light_contact(follows, swapped):
    """Tilt the right tip while one joint rotates, and interrupt the tip's contact every 50 ms."""
    watch, state = WiringWatch((0, 1)), State(mode=Mode.GRASPING)
    state.reading.valid = True
    state.contacts[0].invalid = state.contacts[1].invalid = Invalid.NONE
    for k in range(250):
        state.t = 0.002 * k
        state.reading.q[:] = 0.3 * state.t, 0.05 * state.t
        state.contacts[1].contact = k % 25 != 24
        state.contacts[1].theta = -0.9 * state.reading.q[follows]
        watch.update(state)
        if watch.swapped:
            break
    assert bool(watch.swapped) == swapped


# The tips would slip before the object has rotated by 4°, so the controller ends the rotation.
NEAR = [0.002, 0.003]


@pytest.mark.parametrize("off", [0.0, *NEAR])
def test_swapped_servos_are_detected_at_the_start_of_a_turn(make, off):
    # If the object is almost centred, swapped servos do not change the approach.
    daemon = make("swapped", object_position=(off, 0.08))
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 2.0)
    assert daemon.loop.state.mode == "holding"
    command(daemon, "rotate", angle=0.2)
    assert greatest_force(daemon, 1.0) < 10.0
    assert daemon.loop.state.fault_name == "joint.swapped"
    assert (
        "in the direction opposite to the command: check whether the servo IDs are swapped "
        "(servos.ids)" in daemon.loop.state.fault
    )


@pytest.mark.parametrize("off", [0.0, *OFF])
@pytest.mark.parametrize("object_", [{}, HEAVY], ids=["light", "heavy"])
def test_correctly_wired_servos_grasp_and_turn(make, off, object_):
    daemon = make("right", object_position=(off, 0.08), **object_)
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 3.0)
    for angle in (0.1, -0.1):
        command(daemon, "rotate", angle=angle)
        greatest_force(daemon, 2.0)
    assert daemon.loop.state.fault == ""
    assert daemon.loop.state.mode in ("holding", "rotating")
    assert not [kind for _, kind, _ in events if kind.startswith("joint.")]


@pytest.mark.parametrize("off", OFF)
def test_late_frames_are_not_mistaken_for_swapped_servos(make, off):
    """Frames are 90 ms old, so the force still rises after the joint has stopped."""
    daemon = make("right", object_position=(off, 0.08), tactile_delay=0.09, **HEAVY)
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 3.0)
    assert daemon.loop.state.fault == ""


def texts(events: list[tuple[str, str, str]], kind: str) -> list[str]:
    return [text for _, found, text in events if found == kind]


EMPTY = {"object_position": (0.0, 0.3)}  # The object is out of reach.


@pytest.mark.parametrize(
    ("wiring", "simulation"), [("reversed", {}), ("reversed", EMPTY), ("left reversed", EMPTY)]
)
def test_fingers_that_open_are_reported_before_they_reach_their_stop(make, wiring, simulation):
    daemon = make(wiring, **simulation)
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    run_until(daemon, lambda: daemon.hand.q.min() < -0.54)  # The joint's stop is at -0.55 rad.
    (text,) = texts(events, "joint.opens")
    assert "neither tip has contact: if a finger opens" in text


def test_a_finger_that_opens_while_the_other_one_touches_is_reported(make):
    daemon = make("right reversed", object_width=0.01)
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 2.5)
    (text,) = texts(events, "joint.opens")
    assert "the right tip has no contact: if a finger opens" in text


@pytest.mark.parametrize("wiring", ["right", "both zeros off", "one zero off"])
def test_tips_that_meet_have_nothing_to_grasp(make, wiring):
    daemon = make(wiring, **EMPTY)
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 3.0)
    assert texts(events, "joint.opens") == []
    assert texts(events, "grasp")[0].startswith("no object between the tips")


def test_fingers_that_stand_in_the_approach_are_reported(make):
    daemon = make("reversed")
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    run_until(daemon, lambda: daemon.hand.q[0] < -0.54)  # Wait for the joint to reach its stop.
    daemon.loop.advance(1.0)
    (told,) = [text for level, kind, text in events if kind == "joint.blocked"]
    assert told.startswith("the left joint has stopped at 3")
    assert told.endswith("correct servos.direction")


def test_joints_whose_friction_exceeds_the_approach_torque_are_reported(make):
    daemon = make("right", joint_friction=0.2, joint_stribeck=0.1)
    events = heard(daemon)
    command(daemon, "grasp", force=6.0)
    greatest_force(daemon, 8.0)
    assert daemon.loop.state.mode == "armed"
    assert "increase control.approach_current" in texts(events, "joint.blocked")[0]
    (text,) = texts(events, "grasp")
    assert text == "the fingers found no object and stopped 57.3° before their limits"
