"""The limits at work in the whole pipeline, on the virtual clock."""

from dataclasses import replace

import numpy as np
import pytest

from tests.harness.loop import (
    advance_to,
    change_frames,
    command,
    grasped,
    heard,
    refusal,
    silence,
    torque_of,
)


def test_a_long_sound_grip_says_nothing(make):
    daemon = make(task={"name": "demo"})
    events = heard(daemon)
    daemon.loop.advance(12.0)
    assert daemon.loop.state.fault == ""
    assert [event for event in events if event[0] != "info"] == []
    limited = daemon.loop._safety.limited
    assert set(limited) <= {"goal.slew"}
    assert limited["goal.slew"] < 40


def test_a_sensor_that_shifts_in_the_grip_is_a_fault(make):
    daemon = make()
    events, state = heard(daemon), grasped(daemon, 8.0).loop.state
    change_frames(daemon, 1, lambda frame: replace(frame, data=np.roll(frame.data, 4, axis=1)))
    advance_to(daemon, "fault", 1.0)
    assert state.fault_name == "tactile.silent"
    assert state.fault.startswith("right sensor shows the object turned by")
    witness = next(event for event in events if event[1].startswith("witness"))
    assert witness[:2] == ("warning", "witness.right_sensor")
    assert not torque_of(daemon).any()
    assert ("error", state.fault_name, state.fault) in events


def test_a_frozen_sensor_is_a_fault_until_it_lives_again(make):
    daemon = grasped(make(), 5.0)
    left = daemon.loop.perception.fingers[0]
    frozen = left.frame.data.copy()
    change_frames(daemon, 0, lambda frame: replace(frame, data=frozen))
    advance_to(daemon, "fault", 1.0)
    assert daemon.loop.state.fault_name == "tactile.frozen"
    assert "left sensor frozen" in daemon.loop.state.fault
    assert "clear: tactile: left sensor frozen" in refusal(daemon, "clear")
    del left.sensor.latest  # the class's own again
    daemon.loop.advance(0.2)
    command(daemon, "clear")
    command(daemon, "arm")


def test_without_frames_the_hand_opens_before_the_fault_where_that_is_wanted(make):
    daemon = grasped(make(safety={"frame_age_action": "open"}), 5.0)
    events, state = heard(daemon), daemon.loop.state
    silence(daemon)
    advance_to(daemon, "releasing", 0.3)
    assert torque_of(daemon).all()
    assert state.fault == ""
    advance_to(daemon, "fault", 5.0)
    assert state.reading.q == pytest.approx([0.0, 0.0], abs=0.05)
    assert state.fault_name == "tactile.silent"
    assert not torque_of(daemon).any()
    assert [kind for level, kind, _ in events if level == "error"] == ["tactile.silent"] * 2


def test_a_person_who_stops_the_opening_hand_finds_no_fault_later(make):
    daemon = grasped(make(safety={"frame_age_action": "open"}), 5.0)
    silence(daemon)
    advance_to(daemon, "releasing", 0.3)
    command(daemon, "stop")
    daemon.loop.advance(1.0)
    assert (daemon.loop.state.mode, daemon.loop.state.fault) == ("disarmed", "")


def test_a_joint_that_is_held_up_is_a_fault_and_can_be_cleared(make):
    daemon = make(tactile={"backend": "none"})
    command(daemon, "arm")
    command(daemon, "move", left=0.9, right=0.9)  # onto the object
    advance_to(daemon, "fault", 8.0)
    assert daemon.loop.state.fault_name == "joint.stall"
    assert "joint has stalled" in daemon.loop.state.fault
    assert not torque_of(daemon).any()
    command(daemon, "clear")
    command(daemon, "arm")


def test_a_servo_that_is_hot_is_a_fault_that_stands_until_it_is_cooler(make):
    daemon = grasped(make(), 5.0)
    heat = daemon.hand.servo_heat[1]
    heat.warm(70.6)
    advance_to(daemon, "fault", 1.0)
    assert daemon.loop.state.fault == "right servo at 71 °C"
    assert "clear: right servo at 7" in refusal(daemon, "clear")
    heat.warm(50.0)
    daemon.loop.advance(1.0)
    command(daemon, "clear")


def test_stop_works_in_every_mode_within_one_tick(make):
    daemon = make()
    loop, state = daemon.loop, daemon.loop.state
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
                if name == "grasp" and state.mode == "moving":
                    advance_to(daemon, "armed", 3.0)
                if name != "grasp" or state.mode != "grasping":
                    command(daemon, name, **numbers)
                loop.advance(loop.period)
                advance_to(daemon, mode, 5.0)
            if by_signal:
                loop.stop()
            else:
                command(daemon, "stop")
            loop.advance(loop.period)
            assert (state.mode, torque_of(daemon).any()) == ("disarmed", False), steps[upto - 1]
            loop.advance(0.5)
    command(daemon, "arm")
    loop.advance(0.1)
    assert command(daemon, "status")["limited"]["goal.slew"] > 0
    loop._fail("made up")
    loop.advance(loop.period)
    assert command(daemon, "status")["fault_name"] == "servos.bus"
    command(daemon, "stop")
    loop.advance(loop.period)
    assert (state.mode, torque_of(daemon).any()) == ("fault", False), "a stop clears nothing"
