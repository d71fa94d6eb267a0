"""Test commands and limits in the complete pipeline on the virtual clock."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.types import Frame
from tests.harness.loop import (
    Make,
    advance_to,
    armed,
    change_frames,
    command,
    grasped,
    heard,
    refusal,
    silence,
    state_message,
    torque_of,
)


def test_start_up_is_disarmed_without_torque_and_arming_causes_no_motion(make):
    daemon = make()
    state = daemon.loop.state
    before = list(state.reading.q)
    daemon.loop.advance(1.0)
    assert (state.mode, state.torque, state.fault) == ("disarmed", False, "")
    assert not torque_of(daemon).any()
    assert state.reading.q == pytest.approx(before, abs=1e-3)
    command(daemon, "arm")
    daemon.loop.advance(1.0)
    assert state.torque
    assert state.reading.q == pytest.approx(before, abs=0.005)


@pytest.mark.parametrize(
    "profile", [{}, pytest.param({"material": {"law": "constant"}}, marks=pytest.mark.extended)]
)
def test_grasp_reaches_10_n_within_3_s_and_holds_it_for_10_s(make, profile):
    daemon = grasped(make(**profile), 10.0)
    state = daemon.loop.state
    for _ in range(100):
        daemon.loop.advance(0.1)
        assert (state.mode, state.fault) == ("holding", "")
        for finger, contact in enumerate(state.contacts):
            assert daemon.hand.force[finger] == pytest.approx(10.0, rel=0.06)
            assert contact.force == pytest.approx(10.0, rel=0.04)
            assert abs(contact.force - daemon.hand.force[finger]) < 2.0 * contact.force_std < 2.5


def test_move_reaches_its_goal_within_the_limits(make):
    daemon = make()
    command(daemon, "arm")
    command(daemon, "move", left=-0.2, right=-0.3)
    advance_to(daemon, "armed", 3.0)
    assert daemon.loop.state.reading.q == pytest.approx([-0.2, -0.3], abs=0.04)
    with pytest.raises(
        Refused,
        match=r"left: found 286\.5° \(5 rad\), expected -28\.6° to 57\.3° \(-0\.50 to 1\.00 rad\)",
    ):
        command(daemon, "move", left=5.0)


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_setting_the_wall_clock_only_affects_timestamps(make, monkeypatch, step):
    daemon = grasped(make(), 8.0)
    loop, wall = daemon.loop, daemon.clock.wall
    before, seq = wall(), loop.state.seq
    monkeypatch.setattr(daemon.clock, "wall", lambda: wall() + step)
    loop.advance(1.0)
    assert (loop.state.mode, loop.state.fault) == ("holding", "")
    assert loop.state.seq == seq + round(1.0 / loop.period)
    assert loop.state.wall == pytest.approx(before + step + 1.0, abs=0.1)
    assert torque_of(daemon).all()


def test_a_grasp_without_an_object_ends_armed_with_a_warning(make: Make) -> None:
    # The fingers reach their joint limits before the tips meet.
    daemon = make(simulation={"object_shape": "none"}, hand={"q_max": (0.3, 0.3)})
    events = heard(daemon)
    command(daemon, "arm")
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "armed", 10.0)
    assert any(kind == "grasp" for _, kind, _ in events)


def test_a_backend_error_ends_the_loop_with_torque_off(make, monkeypatch):
    daemon = grasped(make(), 8.0)
    assert all(torque_of(daemon))
    sensor = daemon.loop.perception.fingers[0].sensor
    monkeypatch.setattr(sensor, "latest", lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        daemon.loop.run(0.1)
    assert not any(torque_of(daemon))


@pytest.mark.parametrize("rate", [25.0, 100.0])
def test_missing_frames_during_a_turn_stop_the_object(make, rate):
    daemon = grasped(make(tactile={"rate": rate}), 8.0)
    command(daemon, "rotate", angle=0.26)
    daemon.loop.advance(0.1)
    silence(daemon)
    until_held = (daemon.settings.safety.frame_age_hold + 1.0) / rate
    daemon.loop.advance(until_held)
    assert daemon.loop._safety.limited["tactile.late"]
    begun = daemon.hand.object_pose[2]
    daemon.loop.advance(1.0)
    assert daemon.loop.state.fault_name == "tactile.silent", "no tip limit may be exceeded first"
    turned = daemon.hand.object_pose[2]
    assert turned < 0.26 + 0.01
    assert turned - begun < 0.1


def blinded(daemon: Daemon, counts: int) -> None:
    """Set all cells in all later frames of both sensors to ``counts``."""
    for finger in (0, 1):
        change_frames(
            daemon, finger, lambda frame: replace(frame, data=np.full_like(frame.data, counts))
        )


def test_saturated_sensors_latch_a_fault_and_cause_no_motion(make):
    daemon = grasped(make(tactile={"full_count": 30_000}), 8.0)
    before = list(daemon.loop.state.goal.current)
    blinded(daemon, 30_000)
    advance_to(daemon, "fault", 0.3)
    assert daemon.loop.state.fault.startswith("tactile: no valid estimate from the left sensor for")
    assert daemon.loop.state.goal.current == pytest.approx(before, rel=0.2)
    with pytest.raises(Refused, match="clear: tactile: no valid estimate"):
        command(daemon, "clear")


def test_sensors_that_read_zero_end_the_grip_without_more_force(make):
    daemon = grasped(make(), 5.0)
    blinded(daemon, 0)
    advance_to(daemon, "armed", 0.5)
    daemon.loop.advance(1.0)
    assert daemon.hand.force.max() < 5.5


def test_tare_is_refused_during_contact(make):
    daemon = grasped(make(), 5.0)
    command(daemon, "release")
    advance_to(daemon, "armed", 3.0)
    command(daemon, "tare")
    with pytest.raises(Refused, match="grasp: a tare is in progress"):
        command(daemon, "grasp")
    daemon.loop.advance(0.3)
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "holding", 3.0)
    command(daemon, "disarm")
    daemon.loop.advance(0.02)
    with pytest.raises(Refused, match="tare: a tip is in contact"):
        command(daemon, "tare")


def test_the_state_contains_the_goals_of_the_grip(make):
    daemon = armed(make())
    goal = daemon.loop.state.goal
    assert math.isnan(goal.force)
    command(daemon, "grasp", force=8.0)
    daemon.loop.advance(0.01)
    assert goal.force == 8.0
    assert math.isnan(goal.angle)
    advance_to(daemon, "holding", 5.0)
    command(daemon, "rotate", angle=0.1)
    daemon.loop.advance(0.01)
    message = state_message(daemon)
    assert (message["goal_force"], message["goal_angle"]) == (8.0, 0.1)
    advance_to(daemon, "holding", 5.0)
    daemon.loop.advance(1.0)
    # With the requested force, the tips would slip under this load, so the force increases.
    daemon.hand.apply_load(0.0, 10.0, 0.0)
    daemon.loop.advance(1.0)
    assert 9.0 < goal.force <= 18.0
    felt = [contact.force for contact in daemon.loop.state.contacts]
    assert sum(felt) / 2.0 == pytest.approx(goal.force, rel=0.05)
    command(daemon, "release")
    daemon.loop.advance(0.01)
    assert math.isnan(goal.force)
    assert math.isnan(goal.angle)


def test_an_unreachable_angle_is_refused(make):
    daemon = grasped(make(), 8.0)
    with pytest.raises(
        Refused,
        match=r"found 34\.4° \(0\.6 rad\), expected .*° to .*° \(-0\.\d\d to 0\.\d\d rad\) in",
    ):
        command(daemon, "rotate", angle=0.6)
    found = re.search(r"to (0\.\d+)", refusal(daemon, "rotate", angle=2.0))
    command(daemon, "rotate", angle=0.95 * float(found[1]))
    daemon.loop.advance(4.0)
    assert daemon.loop.state.fault == ""


def test_tare_removes_a_constant_offset(make):
    daemon = make()
    for finger in (0, 1):  # Add 1.2 kPa to all cells.
        change_frames(daemon, finger, lambda frame: replace(frame, data=frame.data + 300))
    command(daemon, "tare")
    daemon.loop.advance(0.5)
    grasped(daemon, 6.0)
    daemon.loop.advance(1.0)
    assert daemon.loop.state.contacts[0].force == pytest.approx(daemon.hand.force[0], rel=0.05)


def test_a_tare_reports_the_change_of_the_zero(make):
    daemon = make()
    events = heard(daemon)

    def tared(offset: int, spike: int) -> str:
        def raised(frame: Frame) -> Frame:
            data = np.full_like(frame.data, 100 + offset)
            data[3, 4] = 100 + offset + spike
            return replace(frame, data=data)

        del events[:]
        change_frames(daemon, 0, raised)
        command(daemon, "tare")
        daemon.loop.advance(0.5)
        [text] = [text for level, kind, text in events
                  if (level, kind) == ("info", "tare") and text.startswith("the left")]  # fmt: skip
        return text

    pascal = daemon.settings.tactile.pascal_per_count
    found = tared(0, 0)
    assert found.startswith(
        f"the left sensor's zero offsets changed: median +100.0 counts ({100 * pascal:+.0f} Pa)"
    )
    assert tared(30, 50) == (
        f"the left sensor's zero offsets changed: median +30.0 counts ({30 * pascal:+.0f} Pa), "
        "largest change +80.0 counts"
    )
    # The warning states the change since the last tare, not since the first tare.
    assert tared(-10, -60).endswith("largest change -150.0 counts")


def test_a_tare_of_saturated_sensors_keeps_the_zero_offset_and_is_reported(make):
    daemon = make()
    events = heard(daemon)
    perception = daemon.loop.perception.fingers[1]
    before = perception._estimator.saturation
    blinded(daemon, daemon.settings.tactile.full_count)
    command(daemon, "tare")
    daemon.loop.advance(0.5)
    assert not perception.is_taring
    assert perception._estimator.saturation == before
    text = "the right sensor was not tared: most cells are saturated without contact"
    assert events.count(("warning", "tare", text)) == 1


# --- limits in operation --------------------------------------------------------------------------


def test_a_long_normal_grip_causes_no_messages(make):
    daemon = make(task={"name": "demo"})
    events = heard(daemon)
    daemon.loop.advance(12.0)
    assert daemon.loop.state.fault == ""
    assert [event for event in events if event[0] != "info"] == []
    limited = daemon.loop._safety.limited
    assert set(limited) <= {"goal.slew"}
    assert limited["goal.slew"] < 40


def test_a_sensor_that_shifts_during_a_grip_is_a_fault(make):
    daemon = make()
    events, state = heard(daemon), grasped(daemon, 8.0).loop.state
    change_frames(daemon, 1, lambda frame: replace(frame, data=np.roll(frame.data, 4, axis=1)))
    advance_to(daemon, "fault", 1.0)
    assert state.fault_name == "tactile.silent"
    assert state.fault.startswith("the right sensor reports a jump of")
    warning = next(event for event in events if event[1].startswith("consistency"))
    assert warning[:2] == ("warning", "consistency.right_sensor")
    assert not torque_of(daemon).any()
    assert ("error", state.fault_name, state.fault) in events


def test_a_frozen_sensor_is_a_fault_until_it_recovers(make):
    daemon = grasped(make(), 5.0)
    left = daemon.loop.perception.fingers[0]
    frozen = left.frame.data.copy()
    change_frames(daemon, 0, lambda frame: replace(frame, data=frozen))
    advance_to(daemon, "fault", 1.0)
    assert daemon.loop.state.fault_name == "tactile.frozen"
    assert "the left sensor has sent the same frame" in daemon.loop.state.fault
    assert "clear: tactile: the left sensor has sent the same frame" in refusal(daemon, "clear")
    del left.sensor.latest  # Remove the replaced method.
    daemon.loop.advance(0.2)
    command(daemon, "clear")
    command(daemon, "arm")


def test_without_frames_the_hand_opens_before_the_fault_if_configured(make):
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


def test_stopping_the_opening_hand_leaves_no_later_fault(make):
    daemon = grasped(make(safety={"frame_age_action": "open"}), 5.0)
    silence(daemon)
    advance_to(daemon, "releasing", 0.3)
    command(daemon, "stop")
    daemon.loop.advance(1.0)
    assert (daemon.loop.state.mode, daemon.loop.state.fault) == ("disarmed", "")


def test_a_blocked_joint_is_a_fault_that_can_be_cleared(make):
    daemon = make(tactile={"backend": "none"})
    command(daemon, "arm")
    command(daemon, "move", left=0.9, right=0.9)  # The fingers close on the object.
    advance_to(daemon, "fault", 8.0)
    assert daemon.loop.state.fault_name == "joint.stall"
    assert "joint has stalled" in daemon.loop.state.fault
    assert not torque_of(daemon).any()
    command(daemon, "clear")
    command(daemon, "arm")


def test_a_hot_servo_is_a_fault_that_remains_until_it_has_cooled(make):
    daemon = grasped(make(), 5.0)
    heat = daemon.hand.servo_heat[1]
    heat.warm(70.6)
    advance_to(daemon, "fault", 1.0)
    assert daemon.loop.state.fault == "the right servo is at 71 °C, expected below 70 °C"
    assert "clear: the right servo is at 7" in refusal(daemon, "clear")
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
    armed(daemon)
    assert command(daemon, "status")["limited"]["goal.slew"] > 0
    loop._fail("made up")
    loop.advance(loop.period)
    assert command(daemon, "status")["fault_name"] == "servos.bus"
    command(daemon, "stop")
    loop.advance(loop.period)
    assert (state.mode, torque_of(daemon).any()) == ("fault", False), (
        "a stop must not clear the fault"
    )
