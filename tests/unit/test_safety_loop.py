"""The limits at work in the whole pipeline, on the virtual clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame

Make = Callable[..., "Hand"]


class Hand:
    """A daemon on virtual time, and what it tells."""

    def __init__(self, **sections: Any) -> None:
        self.events: list[tuple[str, str, str]] = []
        settings = Settings.model_validate({"loop": {"clock": "virtual"}, **sections})
        self.daemon = Daemon(
            settings, wire=False, on_event=lambda *event: self.events.append(event)
        )
        self.loop = self.daemon.loop
        self.state = self.loop.state
        self.loop.advance(0.3)

    def command(self, name: str, **numbers: float) -> dict[str, Any]:
        return self.loop.command({"command": name, **numbers})

    def until(self, mode: str, seconds: float) -> None:
        finish = self.daemon.clock.now() + seconds
        while self.state.mode != mode:
            assert self.daemon.clock.now() < finish, f"{self.state.mode}, not {mode}"
            self.loop.advance(0.01)

    def grasp(self, force: float = 5.0) -> Hand:
        self.command("arm")
        self.command("grasp", force=force)
        self.until("holding", 5.0)
        return self

    def torque(self) -> bool:
        assert self.daemon.hand is not None
        return bool(self.daemon.hand.torque_on.any())

    def change_frames(self, finger: int, change: Callable[[Frame], Frame | None]) -> None:
        """From now on each new frame of one sensor goes through ``change``."""
        sensor = self.loop.perception.fingers[finger].sensor
        really, last = sensor.latest, [None, None]

        def latest() -> Frame | None:
            frame = really()
            if frame is not last[0] and frame is not None:
                last[:] = frame, change(frame)  # type: ignore[call-overload]
            return last[1]

        sensor.latest = latest  # type: ignore[method-assign]

    def warnings(self) -> list[str]:
        return [kind for level, kind, _ in self.events if level == "warning"]


@pytest.fixture
def make() -> Iterator[Make]:
    hands: list[Hand] = []

    def build(**sections: Any) -> Hand:
        hands.append(Hand(**sections))
        return hands[-1]

    yield build
    for hand in hands:
        hand.daemon.close()


def with_data(frame: Frame, data: np.ndarray[Any, Any]) -> Frame:
    return Frame(frame.seq, frame.t_sample, frame.t_arrival, frame.valid, data)


def test_a_long_sound_grip_says_nothing(make: Make) -> None:
    hand = make(task={"name": "demo"})
    hand.loop.advance(12.0)
    assert hand.state.fault == ""
    assert [event for event in hand.events if event[0] != "info"] == []
    assert set(hand.loop._safety.limited) <= {"goal.slew"}
    assert hand.loop._safety.limited["goal.slew"] < 40


def test_a_sensor_that_shifts_in_the_grip_is_a_fault(make: Make) -> None:
    hand = make().grasp(8.0)
    hand.change_frames(1, lambda frame: with_data(frame, np.roll(frame.data, 4, axis=1)))
    hand.until("fault", 1.0)
    assert hand.state.fault_name == "tactile.silent"
    assert hand.state.fault.startswith("right sensor shows the object turned by")
    assert next(event for event in hand.events if event[1].startswith("witness"))[:2] == (
        "warning",
        "witness.right_sensor",
    )
    assert not hand.torque()
    assert ("error", hand.state.fault_name, hand.state.fault) in hand.events


def test_a_frozen_sensor_is_a_fault_until_it_lives_again(make: Make) -> None:
    hand = make().grasp()
    kept = hand.loop.perception.fingers[0].frame
    assert kept is not None
    frozen = kept.data.copy()
    hand.change_frames(0, lambda frame: with_data(frame, frozen))
    hand.until("fault", 1.0)
    assert hand.state.fault_name == "tactile.frozen"
    assert "left sensor frozen" in hand.state.fault
    with pytest.raises(Refused, match="clear: tactile: left sensor frozen"):
        hand.command("clear")
    del hand.loop.perception.fingers[0].sensor.latest  # the class's own again
    hand.loop.advance(0.2)
    hand.command("clear")
    hand.command("arm")


def silent(hand: Hand) -> None:
    for finger in (0, 1):
        kept = hand.loop.perception.fingers[finger].frame
        hand.loop.perception.fingers[finger].sensor.latest = lambda kept=kept: kept  # type: ignore[misc]


def test_without_frames_the_hand_opens_before_the_fault_where_that_is_wanted(make: Make) -> None:
    hand = make(safety={"frame_age_action": "open"}).grasp()
    silent(hand)
    hand.until("releasing", 0.3)
    assert hand.torque()
    assert hand.state.fault == ""
    hand.until("fault", 5.0)
    assert hand.state.reading.q == pytest.approx([0.0, 0.0], abs=0.05)
    assert hand.state.fault_name == "tactile.silent"
    assert not hand.torque()
    assert [kind for level, kind, _ in hand.events if level == "error"] == ["tactile.silent"] * 2


def test_a_person_who_stops_the_opening_hand_finds_no_fault_later(make: Make) -> None:
    hand = make(safety={"frame_age_action": "open"}).grasp()
    silent(hand)
    hand.until("releasing", 0.3)
    hand.command("stop")
    hand.loop.advance(1.0)
    assert (hand.state.mode, hand.state.fault) == ("disarmed", "")


def test_a_joint_that_is_held_up_is_a_fault_and_can_be_cleared(make: Make) -> None:
    hand = make(tactile={"backend": "none"})
    hand.command("arm")
    hand.command("move", left=0.9, right=0.9)  # onto the object
    hand.until("fault", 8.0)
    assert hand.state.fault_name == "joint.stall"
    assert "joint has stalled" in hand.state.fault
    assert not hand.torque()
    hand.command("clear")
    hand.command("arm")


def test_a_servo_that_is_hot_is_a_fault_that_stands_until_it_is_cooler(make: Make) -> None:
    hand = make().grasp()
    assert hand.daemon.hand is not None
    heat = hand.daemon.hand.servo_heat[1]
    heat.warm(70.6)
    hand.until("fault", 1.0)
    assert hand.state.fault == "right servo at 71 °C"
    with pytest.raises(Refused, match="clear: right servo at 7"):
        hand.command("clear")
    heat.warm(50.0)
    hand.loop.advance(1.0)
    hand.command("clear")


def test_stop_works_in_every_mode_within_one_tick(make: Make) -> None:
    hand = make()
    steps: list[tuple[str, dict[str, float], str]] = [
        ("arm", {}, "armed"),
        ("move", {"left": -0.2, "right": -0.2}, "moving"),
        ("grasp", {"force": 5.0}, "grasping"),
        ("grasp", {"force": 5.0}, "holding"),
        ("rotate", {"angle": 0.1}, "rotating"),
        ("release", {}, "releasing"),
    ]
    for upto in range(1, len(steps) + 1):
        for by_signal in (True, False):
            for name, numbers, mode in steps[:upto]:
                if name == "grasp" and hand.state.mode == "moving":
                    hand.until("armed", 3.0)
                if name != "grasp" or hand.state.mode != "grasping":
                    hand.command(name, **numbers)
                hand.loop.advance(hand.loop.period)
                hand.until(mode, 5.0)
                if mode == "rotating":
                    continue
            if by_signal:
                hand.loop.stop()
            else:
                hand.command("stop")
            hand.loop.advance(hand.loop.period)
            assert (hand.state.mode, hand.torque()) == ("disarmed", False), steps[upto - 1]
            hand.loop.advance(0.5)
    hand.command("arm")
    hand.loop._fail("made up")
    hand.loop.advance(hand.loop.period)
    hand.command("stop")
    hand.loop.advance(hand.loop.period)
    assert (hand.state.mode, hand.torque()) == ("fault", False), "a stop clears nothing"


def test_status_tells_the_faults_name_and_what_was_limited(make: Make) -> None:
    hand = make()
    hand.command("arm")
    hand.loop.advance(0.1)
    status = hand.command("status")
    assert status["fault_name"] == ""
    assert status["limited"]["goal.slew"] > 0


@pytest.mark.parametrize(("taper", "told"), [(0.0, ["hand.angle"]), (0.17, [])])
def test_a_wedge_looks_like_a_shifted_sensor_unless_it_is_told(
    make: Make, taper: float, told: list[str]
) -> None:
    simulation = {"object_shape": "wedge", "object_taper": 0.17}
    hand = make(simulation=simulation, object={"taper": taper}).grasp()
    hand.loop.advance(1.0)
    assert hand.state.fault == ""
    assert hand.warnings() == told
