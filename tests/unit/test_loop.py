"""The whole pipeline on the virtual clock: what the hand does when it is commanded."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import parts
from softfinger.daemon.wire.schema import STATE
from tests.harness.golden_wire import message_maker
from tests.harness.loop import (
    Make,
    advance_to,
    change_frames,
    command,
    grasped,
    heard,
    refusal,
    silence,
    torque_of,
)

state_message = message_maker(STATE)


def test_starts_disarmed_with_torque_off_and_arming_moves_nothing(make):
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


@pytest.mark.parametrize("profile", [{}, {"material": {"law": "constant"}}])
def test_grasp_reaches_10_n_within_3_s_and_holds_it_10_s(make, profile):
    daemon = grasped(make(**profile), 10.0)
    state = daemon.loop.state
    for _ in range(100):
        daemon.loop.advance(0.1)
        assert (state.mode, state.fault) == ("holding", "")
        for finger, contact in enumerate(state.contacts):
            assert daemon.hand.force[finger] == pytest.approx(10.0, rel=0.06)
            assert contact.force == pytest.approx(10.0, rel=0.03)
            assert abs(contact.force - daemon.hand.force[finger]) < 2.0 * contact.force_std < 1.5


def test_move_goes_where_it_is_told_within_the_limits(make):
    daemon = make()
    command(daemon, "arm")
    command(daemon, "move", left=-0.2, right=-0.3)
    advance_to(daemon, "armed", 3.0)
    assert daemon.loop.state.reading.q == pytest.approx([-0.2, -0.3], abs=0.04)
    with pytest.raises(
        Refused,
        match=r"left: found 286\.5° \(5 rad\), expected -28\.6° to 57\.3° \(-0\.50 to 1\.00\)",
    ):
        command(daemon, "move", left=5.0)


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_wall_clock_that_is_set_changes_nothing_but_timestamps(make, monkeypatch, step):
    daemon = grasped(make(), 8.0)
    loop, wall = daemon.loop, daemon.clock.wall
    before, seq = wall(), loop.state.seq
    monkeypatch.setattr(daemon.clock, "wall", lambda: wall() + step)
    loop.advance(1.0)
    assert (loop.state.mode, loop.state.fault) == ("holding", "")
    assert loop.state.seq == seq + round(1.0 / loop.period)
    assert loop.state.wall == pytest.approx(before + step + 1.0, abs=0.1)
    assert torque_of(daemon).all()


def test_a_grasp_of_nothing_ends_armed_with_a_warning(make: Make) -> None:
    # The fingers end before their tips meet.
    daemon = make(simulation={"object_shape": "none"}, hand={"q_max": (0.3, 0.3)})
    events = heard(daemon)
    command(daemon, "arm")
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "armed", 10.0)
    assert any(kind == "grasp" for _, kind, _ in events)


def test_an_error_of_a_backend_ends_the_loop_with_torque_off(make, monkeypatch):
    daemon = grasped(make(), 8.0)
    assert all(torque_of(daemon))
    sensor = daemon.loop.perception.fingers[0].sensor
    monkeypatch.setattr(sensor, "latest", lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        daemon.loop.run(0.1)
    assert not any(torque_of(daemon))


@pytest.mark.parametrize("rate", [25.0, 100.0])
def test_frames_that_stop_coming_while_the_object_turns_bring_it_to_rest(make, rate):
    daemon = grasped(make(tactile={"rate": rate}), 8.0)
    command(daemon, "rotate", angle=0.26)
    daemon.loop.advance(0.1)
    silence(daemon)
    until_held = (daemon.settings.safety.frame_age_hold + 1.0) / rate
    daemon.loop.advance(until_held)
    assert daemon.loop._safety.limited["tactile.late"]
    begun = daemon.hand.object_pose[2]
    daemon.loop.advance(1.0)
    assert daemon.loop.state.fault_name == "tactile.silent", "and no tip went past its limits"
    turned = daemon.hand.object_pose[2]
    assert turned < 0.26 + 0.01
    assert turned - begun < 0.1


def blinded(daemon: Daemon, counts: int) -> None:
    """From now on all cells of both sensors read ``counts``."""
    for finger in (0, 1):
        change_frames(
            daemon, finger, lambda frame: replace(frame, data=np.full_like(frame.data, counts))
        )


def test_saturated_sensors_latch_a_fault_and_drive_nothing(make):
    daemon = grasped(make(tactile={"full_count": 30_000}), 8.0)
    before = list(daemon.loop.state.goal.current)
    blinded(daemon, 30_000)
    advance_to(daemon, "fault", 0.3)
    assert daemon.loop.state.fault.startswith("tactile: no sound estimate of the left sensor for")
    assert daemon.loop.state.goal.current == pytest.approx(before, rel=0.2)
    with pytest.raises(Refused, match="clear: tactile: no sound estimate"):
        command(daemon, "clear")


def test_blind_sensors_end_the_grip_without_pressing_harder(make):
    daemon = grasped(make(), 5.0)
    blinded(daemon, 0)
    advance_to(daemon, "armed", 0.5)
    daemon.loop.advance(1.0)
    assert daemon.hand.force.max() < 5.5


def test_tare_is_refused_while_something_touches(make):
    daemon = grasped(make(), 5.0)
    command(daemon, "release")
    advance_to(daemon, "armed", 3.0)
    command(daemon, "tare")
    with pytest.raises(Refused, match="grasp: tare is still at work"):
        command(daemon, "grasp")
    daemon.loop.advance(0.3)
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "holding", 3.0)
    command(daemon, "disarm")
    daemon.loop.advance(0.02)
    with pytest.raises(Refused, match="tare: something touches a tip"):
        command(daemon, "tare")


def test_the_state_tells_what_the_grip_goes_to(make):
    daemon = make()
    goal = daemon.loop.state.goal
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    assert math.isnan(goal.force)
    command(daemon, "grasp", force=8.0)
    daemon.loop.advance(0.01)
    assert goal.force == 8.0
    assert math.isnan(goal.angle)
    advance_to(daemon, "holding", 5.0)
    command(daemon, "rotate", angle=0.1)
    daemon.loop.advance(0.01)
    message = state_message(daemon.loop.state, parts(daemon.settings))
    assert (message["goal_force"], message["goal_angle"]) == (8.0, 0.1)
    # More than was asked for, since a load would make the tips slip.
    for k in range(1, 101):
        daemon.hand.apply_load(0.0, 0.12 * k, 0.0)
        daemon.loop.advance(0.02)
    assert 9.0 < goal.force <= 18.0
    daemon.loop.advance(1.0)
    felt = [contact.force for contact in daemon.loop.state.contacts]
    assert sum(felt) / 2.0 == pytest.approx(goal.force, rel=0.03)
    command(daemon, "release")
    daemon.loop.advance(0.01)
    assert math.isnan(goal.force)
    assert math.isnan(goal.angle)


def test_an_angle_beyond_the_grip_is_refused(make):
    daemon = grasped(make(), 8.0)
    with pytest.raises(
        Refused, match=r"found 34\.4° \(0\.6 rad\), expected .*° to .*° \(-0\.\d\d to 0\.\d\d\) in"
    ):
        command(daemon, "rotate", angle=0.6)
    found = re.search(r"to (0\.\d+)", refusal(daemon, "rotate", angle=2.0))
    command(daemon, "rotate", angle=0.95 * float(found[1]))
    daemon.loop.advance(4.0)
    assert daemon.loop.state.fault == ""


def test_tare_removes_a_standing_offset(make):
    daemon = make()
    for finger in (0, 1):  # 1.2 kPa everywhere
        change_frames(daemon, finger, lambda frame: replace(frame, data=frame.data + 300))
    command(daemon, "tare")
    daemon.loop.advance(0.5)
    grasped(daemon, 6.0)
    daemon.loop.advance(1.0)
    assert daemon.loop.state.contacts[0].force == pytest.approx(daemon.hand.force[0], rel=0.05)


def test_a_tare_of_full_sensors_leaves_the_zero_and_is_told(make):
    daemon = make()
    events = heard(daemon)
    perception = daemon.loop.perception.fingers[1]
    before = perception._estimator.saturation
    blinded(daemon, daemon.settings.tactile.full_count)
    command(daemon, "tare")
    daemon.loop.advance(0.5)
    assert not perception.taring
    assert perception._estimator.saturation == before
    text = "right sensor's zero stays: most cells are full where nothing presses"
    assert events.count(("warning", "tare", text)) == 1
