"""The whole pipeline on the virtual clock: what the hand does when it is commanded."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
import zmq

from daemon.assembly import Daemon
from daemon.commands import CommandServer, Refused
from daemon.messages import Parts, pack, state_message
from daemon.records import Frame
from daemon.servos.base import ServoError
from daemon.settings import Settings
from daemon.simulation import layout

Make = Callable[..., Daemon]


@pytest.fixture
def make() -> Iterator[Make]:
    """Daemons on virtual time without sockets; sections are given as keyword arguments."""
    daemons = []

    def build(**sections: Any) -> Daemon:
        loop = {"clock": "virtual"} | sections.pop("loop", {})
        settings = Settings.model_validate({"loop": loop, **sections})
        daemon = Daemon(settings, wire=False)
        daemons.append(daemon)
        daemon.loop.advance(0.3)
        return daemon

    yield build
    for daemon in daemons:
        daemon.close()


def command(daemon: Daemon, name: str, **numbers: float) -> dict[str, Any]:
    return daemon.loop.command({"command": name, **numbers})


def torque_of(daemon: Daemon) -> Any:
    """Whether the plant's servos have torque, each."""
    assert daemon.hand is not None
    return daemon.hand.memory[layout.TORQUE_ON : layout.TORQUE_ON + 2]


def advance_to(daemon: Daemon, mode: str, seconds: float) -> None:
    """Advance until the hand is in ``mode``; fail when it is not within ``seconds``."""
    finish = daemon.clock.now() + seconds
    while daemon.loop.state.mode != mode:
        assert daemon.clock.now() < finish, f"{daemon.loop.state.mode}, not {mode}"
        daemon.loop.advance(0.01)


def grasped(daemon: Daemon, force: float) -> Daemon:
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    command(daemon, "grasp", force=force)
    advance_to(daemon, "holding", 3.0)
    return daemon


def test_starts_disarmed_with_torque_off_and_does_not_move(make: Make) -> None:
    daemon = make()
    state = daemon.loop.state
    before = list(state.reading.q)
    daemon.loop.advance(1.0)
    assert (state.mode, state.torque, state.fault) == ("disarmed", False, "")
    assert daemon.hand is not None
    assert not torque_of(daemon).any()
    assert state.reading.q == pytest.approx(before, abs=1e-3)


def test_arming_does_not_move_the_hand(make: Make) -> None:
    daemon = make()
    before = list(daemon.loop.state.reading.q)
    command(daemon, "arm")
    daemon.loop.advance(1.0)
    assert daemon.loop.state.torque
    assert daemon.loop.state.reading.q == pytest.approx(before, abs=0.005)


@pytest.mark.parametrize("profile", [{}, {"material": {"law": "constant"}}])
def test_grasp_reaches_10_n_within_3_s_and_holds_it_10_s(
    make: Make, profile: dict[str, Any]
) -> None:
    daemon = grasped(make(**profile), 10.0)
    state = daemon.loop.state
    assert daemon.hand is not None
    for _ in range(100):
        daemon.loop.advance(0.1)
        assert (state.mode, state.fault) == ("holding", "")
        for finger, contact in enumerate(state.contacts):
            assert daemon.hand.force[finger] == pytest.approx(10.0, rel=0.02)
            assert contact.force == pytest.approx(daemon.hand.force[finger], rel=0.03)


def test_rotate_turns_the_object_to_the_angle_and_keeps_the_grip(make: Make) -> None:
    daemon = grasped(make(), 8.0)
    assert daemon.hand is not None
    for angle in (0.14, -0.14, 0.0):
        command(daemon, "rotate", angle=angle)
        advance_to(daemon, "holding", 5.0)
        daemon.loop.advance(1.0)
        assert daemon.loop.state.object.angle == pytest.approx(angle, abs=math.radians(0.2))
        assert daemon.hand.object_pose[2] == pytest.approx(angle, abs=math.radians(0.2))
        assert all(c.force == pytest.approx(8.0, rel=0.1) for c in daemon.loop.state.contacts)
    assert daemon.loop.state.object.width == pytest.approx(0.040, abs=1e-4)


def test_release_opens_the_hand_and_lets_go(make: Make) -> None:
    daemon = grasped(make(), 8.0)
    command(daemon, "release")
    advance_to(daemon, "armed", 3.0)
    state = daemon.loop.state
    assert not any(contact.contact for contact in state.contacts)
    assert state.reading.q == pytest.approx([0.0, 0.0], abs=0.04)
    assert all(contact.force == 0.0 for contact in state.contacts)


def test_move_goes_where_it_is_told_within_the_limits(make: Make) -> None:
    daemon = make()
    command(daemon, "arm")
    command(daemon, "move", left=-0.2, right=-0.3)
    advance_to(daemon, "armed", 3.0)
    assert daemon.loop.state.reading.q == pytest.approx([-0.2, -0.3], abs=0.04)
    with pytest.raises(Refused, match=r"move: left: found 5 rad, expected -0\.5 to 1"):
        command(daemon, "move", left=5.0)


def test_stop_turns_torque_off_at_the_same_tick(make: Make) -> None:
    daemon = grasped(make(), 8.0)
    command(daemon, "stop")
    daemon.loop.advance(daemon.loop.period)
    assert (daemon.loop.state.mode, daemon.loop.state.torque) == ("disarmed", False)
    assert daemon.hand is not None
    assert not torque_of(daemon).any()
    daemon.loop.advance(0.2)
    assert abs(daemon.hand.current).max() < 1e-3


def test_a_grasp_of_nothing_ends_armed_with_a_warning(make: Make) -> None:
    # The fingers end before their tips meet.
    daemon = make(simulation={"object_shape": "none"}, hand={"q_max": (0.3, 0.3)})
    events: list[tuple[str, str, str]] = []
    daemon.loop._on_event = lambda *event: events.append(event)
    command(daemon, "arm")
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "armed", 10.0)
    assert any(kind == "grasp" for _, kind, _ in events)


def test_too_much_force_latches_a_fault_that_waits_for_clear(make: Make) -> None:
    daemon = make(safety={"force_max": 6.0}, control={"contact_force": 0.2})
    command(daemon, "arm")
    command(daemon, "grasp", force=5.0)
    advance_to(daemon, "holding", 3.0)
    assert daemon.hand is not None
    # Something squeezes the fingers together, harder than the limit allows.
    daemon.loop._control._grip.retarget(9.0)
    advance_to(daemon, "fault", 3.0)
    state = daemon.loop.state
    assert "above 6 N" in state.fault
    assert not state.torque
    with pytest.raises(Refused, match="clear the fault first"):
        command(daemon, "arm")
    daemon.loop.advance(1.0)
    command(daemon, "clear")
    daemon.loop.advance(0.1)
    assert (state.mode, state.fault) == ("disarmed", "")
    command(daemon, "arm")


def test_frames_that_stop_coming_latch_a_fault(make: Make) -> None:
    daemon = grasped(make(), 5.0)
    perception = daemon.loop.perceptions[1]
    frozen = perception.frame

    class Silent:
        def latest(self) -> Any:
            return frozen

        def close(self) -> None: ...

    perception.sensor = Silent()  # type: ignore[assignment]
    goal = None
    finish = daemon.clock.now() + 0.5
    while daemon.loop.state.mode != "fault":
        assert daemon.clock.now() < finish
        daemon.loop.advance(daemon.loop.period)
        if daemon.clock.now() - perception.frame.t_arrival > 4.5 * 0.01:  # type: ignore[union-attr]
            held = list(daemon.loop.state.goal.current)
            goal = held if goal is None else goal
            # The grip damps its joints on: that is less than a count of current.
            assert held == pytest.approx(goal, abs=2.5e-3), "goals moved on without frames"
    assert goal is not None
    assert daemon.loop.state.fault.startswith("tactile: no frame for 0.1")
    assert not daemon.loop.state.torque


@pytest.mark.parametrize("rate", [25.0, 100.0])
def test_frames_that_stop_coming_while_the_object_turns_bring_it_to_rest(
    make: Make, rate: float
) -> None:
    daemon = grasped(make(tactile={"rate": rate}), 8.0)
    command(daemon, "rotate", angle=0.26)
    daemon.loop.advance(0.1)
    assert daemon.hand is not None
    for perception in daemon.loop.perceptions:
        last = perception.sensor.latest()
        perception.sensor.latest = lambda last=last: last  # type: ignore[method-assign]
    until_held = (daemon.settings.safety.frame_age_hold + 1.0) / rate
    daemon.loop.advance(until_held)
    assert daemon.loop._safety.limited["tactile.late"]
    begun = daemon.hand.object_pose[2]
    daemon.loop.advance(1.0)
    assert daemon.loop.state.fault_name == "tactile.silent", "and no tip went past its limits"
    turned = daemon.hand.object_pose[2]
    assert turned < 0.26 + 0.01
    assert turned - begun < 0.1


def test_a_goal_that_is_no_number_is_a_fault_though_a_command_was_refused_for_it(
    make: Make,
) -> None:
    daemon = make()
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    daemon.loop.state.goal.q[0] = math.nan
    daemon.loop._safety.bound(daemon.loop.state)
    assert "a goal was no number" in refusal(daemon, "grasp")
    daemon.loop.advance(daemon.loop.period)
    assert daemon.loop.state.fault_name == "goal.number"
    command(daemon, "clear")


def test_servos_that_fall_silent_latch_a_fault(make: Make) -> None:
    daemon = make()
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    assert daemon.loop.servos is not None

    def failing(reading: Any) -> None:
        reading.valid = False

    daemon.loop.servos.read = failing  # type: ignore[method-assign]
    advance_to(daemon, "fault", 0.2)
    assert "no good reading" in daemon.loop.state.fault
    with pytest.raises(Refused, match="clear: servos: no good reading"):
        command(daemon, "clear")


def test_torque_that_can_not_be_turned_off_is_told_once_and_tried_again(make: Make) -> None:
    daemon = make()
    events: list[tuple[str, str, str]] = []
    daemon.loop._on_event = lambda *event: events.append(event)
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    servos = daemon.loop.servos
    assert servos is not None
    really, tries = servos.set_torque, []

    def failing(on: bool) -> None:
        tries.append(on)
        if len(tries) < 4:
            raise ServoError("no answer")
        really(on)

    servos.set_torque = failing  # type: ignore[method-assign]
    command(daemon, "stop")
    daemon.loop.advance(1.2)
    assert daemon.loop.state.torque, "torque was not turned off, and the state says it was"
    daemon.loop.advance(1.0)
    assert not daemon.loop.state.torque
    assert tries == [False] * 4
    assert [text for _, kind, text in events if kind == "servos"] == [
        "torque could not be turned off: no answer"
    ]


def test_arming_that_fails_is_a_fault_with_torque_off(make: Make) -> None:
    daemon = make()
    servos = daemon.loop.servos
    assert servos is not None
    really, tries = servos.set_torque, []

    def failing(on: bool) -> None:
        tries.append(on)
        if on:
            raise ServoError("overload")
        really(on)

    servos.set_torque = failing  # type: ignore[method-assign]
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    assert (daemon.loop.state.mode, daemon.loop.state.fault) == ("fault", "overload")
    assert not daemon.loop.state.torque
    assert tries == [True, False]


def test_a_stall_that_trips_the_servos_watchdog_is_a_fault_and_not_an_idle_hand(make: Make) -> None:
    daemon = grasped(make(), 6.0)
    daemon.clock.sleep_until(daemon.clock.now() + 0.5)  # the process stood still
    advance_to(daemon, "fault", 0.1)
    assert "watchdog" in daemon.loop.state.fault
    daemon.loop.advance(0.2)
    command(daemon, "clear")
    command(daemon, "arm")
    command(daemon, "move", left=-0.1, right=-0.1)
    advance_to(daemon, "armed", 3.0)
    assert daemon.hand is not None
    assert daemon.hand.q.tolist() == pytest.approx([-0.1, -0.1], abs=0.04)


def test_stop_and_disarm_turn_torque_off_whatever_the_state_says(make: Make) -> None:
    daemon = make()
    assert daemon.loop.servos is not None
    for name in ("stop", "disarm"):
        daemon.loop.servos.set_torque(True)  # as another program may have done
        command(daemon, name)
        daemon.loop.advance(daemon.loop.period)
        assert daemon.hand is not None
        assert not torque_of(daemon).any()
        assert not daemon.loop.state.torque


def test_a_stop_by_signal_goes_before_what_waits_and_lets_none_of_it_arm_the_hand(
    make: Make, context: zmq.Context[Any]
) -> None:
    daemon = make()
    server = CommandServer(context, "inproc://commands", 200)
    daemon.loop._server = server
    client = context.socket(zmq.DEALER)
    client.connect("inproc://commands")
    client.send(msgpack.packb({"command": "arm"}))
    daemon.loop.stop()
    daemon.loop.advance(5 * daemon.loop.period)
    assert daemon.loop.state.mode == "disarmed"
    assert "before a stop" in msgpack.unpackb(client.recv(zmq.NOBLOCK))["error"]
    client.send(msgpack.packb({"command": "arm"}))
    daemon.loop.advance(daemon.loop.period)
    assert daemon.loop.state.mode == "armed"
    client.close()
    server.close()


def test_arm_waits_until_a_failing_torque_off_has_worked(make: Make) -> None:
    daemon = make()
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    servos = daemon.loop.servos
    assert servos is not None
    really = servos.set_torque
    answers = iter([ServoError("no answer"), None])

    def failing_once(on: bool) -> None:
        answer = next(answers)
        if answer is not None:
            raise answer
        really(on)

    servos.set_torque = failing_once  # type: ignore[method-assign]
    command(daemon, "stop")
    daemon.loop.advance(0.1)
    with pytest.raises(Refused, match="arm: torque could not be turned off yet"):
        command(daemon, "arm")
    daemon.loop.advance(0.6)
    servos.set_torque = really  # type: ignore[method-assign]
    command(daemon, "arm")


def test_arm_is_refused_before_the_servos_were_read() -> None:
    settings = Settings.model_validate({"loop": {"clock": "virtual"}})
    with Daemon(settings, wire=False) as daemon:
        assert daemon.loop.servos is not None
        daemon.loop.servos.read = lambda reading: None  # type: ignore[method-assign]
        daemon.loop.advance(0.01)
        with pytest.raises(Refused, match="arm: servos: no good reading yet"):
            command(daemon, "arm")


def blinded(daemon: Daemon, counts: int) -> None:
    """From now on all cells of both sensors read ``counts``."""
    for perception in daemon.loop.perceptions:
        really = perception.sensor.latest

        def latest(really: Callable[[], Frame | None] = really) -> Frame | None:
            frame = really()
            if frame is not None:
                frame.data[:] = counts
            return frame

        perception.sensor.latest = latest  # type: ignore[method-assign]


def test_saturated_sensors_latch_a_fault_and_drive_nothing(make: Make) -> None:
    daemon = grasped(make(tactile={"full_count": 30_000}), 8.0)
    before = list(daemon.loop.state.goal.current)
    blinded(daemon, 30_000)
    advance_to(daemon, "fault", 0.3)
    assert daemon.loop.state.fault.startswith("tactile: no sound estimate for")
    assert daemon.loop.state.goal.current == pytest.approx(before, rel=0.2)
    with pytest.raises(Refused, match="clear: tactile: no sound estimate"):
        command(daemon, "clear")


def test_blind_sensors_end_the_grip_without_pressing_harder(make: Make) -> None:
    daemon = grasped(make(), 5.0)
    assert daemon.hand is not None
    blinded(daemon, 0)
    advance_to(daemon, "armed", 0.5)
    daemon.loop.advance(1.0)
    assert daemon.hand.force.max() < 5.5


def test_tare_is_refused_while_something_touches(make: Make) -> None:
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


def test_a_person_ends_the_demo_and_it_does_not_start_again(make: Make) -> None:
    daemon = make(task={"name": "demo"})
    advance_to(daemon, "holding", 5.0)
    daemon.loop.stop()
    daemon.loop.advance(1.0)
    assert daemon.loop.state.mode == "disarmed"
    command(daemon, "arm")
    daemon.loop.advance(15.0)
    assert daemon.loop.state.mode == "armed"


def test_the_state_tells_what_the_grip_goes_to(make: Make) -> None:
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
    message = state_message(daemon.loop.state, Parts.of(daemon.settings))
    assert (message["goal_force"], message["goal_angle"]) == (8.0, 0.1)
    # More than was asked for, since a load would make the tips slip.
    assert daemon.hand is not None
    for k in range(1, 101):
        daemon.hand.push(0.0, 0.12 * k, 0.0)
        daemon.loop.advance(0.02)
    assert 9.0 < goal.force <= 18.0
    daemon.loop.advance(1.0)
    felt = [contact.force for contact in daemon.loop.state.contacts]
    assert sum(felt) / 2.0 == pytest.approx(goal.force, rel=0.03)
    command(daemon, "release")
    daemon.loop.advance(0.01)
    assert math.isnan(goal.force)
    assert math.isnan(goal.angle)


def test_an_angle_beyond_the_grip_is_refused(make: Make) -> None:
    daemon = grasped(make(), 8.0)
    with pytest.raises(Refused, match=r"found 0\.6 rad, expected -0\.\d\d to 0\.\d\d in this grip"):
        command(daemon, "rotate", angle=0.6)
    found = re.search(r"to (0\.\d+)", refusal(daemon, "rotate", angle=2.0))
    assert found is not None
    command(daemon, "rotate", angle=0.95 * float(found[1]))
    daemon.loop.advance(4.0)
    assert daemon.loop.state.fault == ""


def refusal(daemon: Daemon, name: str, **numbers: float) -> str:
    with pytest.raises(Refused) as caught:
        command(daemon, name, **numbers)
    return str(caught.value)


def run_recorded(make: Make, seed: int) -> list[bytes]:
    daemon = make(simulation={"seed": seed})
    recorded = []
    script = {
        10: ("arm", {}),
        30: ("grasp", {"force": 7.0}),
        900: ("rotate", {"angle": 0.1}),
        1500: ("release", {}),
    }
    for tick in range(2000):
        if tick in script:
            name, numbers = script[tick]
            command(daemon, name, **numbers)
        daemon.loop.advance(daemon.loop.period)
        recorded.append(pack(state_message(daemon.loop.state, Parts.of(daemon.settings))))
    return recorded


def test_two_runs_with_one_seed_are_the_same_to_the_bit(make: Make) -> None:
    assert run_recorded(make, 3) == run_recorded(make, 3)
    assert run_recorded(make, 3)[1500:] != run_recorded(make, 4)[1500:]


def test_tare_removes_a_standing_offset(make: Make) -> None:
    daemon = make()
    for perception in daemon.loop.perceptions:
        really = perception.sensor.latest

        def latest(
            really: Callable[[], Frame | None] = really,
            seen: set[int] = set(),  # noqa: B006
        ) -> Frame | None:
            frame = really()
            if frame is not None and frame.seq not in seen:
                seen.add(frame.seq)
                frame.data += 300  # 1.2 kPa everywhere
            return frame

        perception.sensor.latest = latest  # type: ignore[method-assign]
    command(daemon, "tare")
    daemon.loop.advance(0.5)
    grasped(daemon, 6.0)
    daemon.loop.advance(1.0)
    assert daemon.hand is not None
    assert daemon.loop.state.contacts[0].force == pytest.approx(daemon.hand.force[0], rel=0.05)


SCENES: dict[str, dict[str, Any]] = {
    "two fingers": {},
    "one finger": {"scene": {"fingers": ("left",)}},
    "the other finger": {"scene": {"fingers": ("right",)}},
    "sensor without servos": {"servos": {"backend": "none"}},
    "servos without sensors": {"tactile": {"backend": "none"}},
    "no object model": {"scene": {"object_model": False}},
}


@pytest.mark.parametrize("sections", SCENES.values(), ids=SCENES.keys())
def test_every_scene_runs_and_its_messages_have_one_shape(
    make: Make, sections: dict[str, Any]
) -> None:
    daemon = make(**sections)
    daemon.loop.advance(2.0)
    message = state_message(daemon.loop.state, Parts.of(daemon.settings))
    reference = state_message(make().loop.state, Parts.of(daemon.settings))
    assert message.keys() == reference.keys()
    for part in ("left", "right", "object"):
        assert message[part].keys() == reference[part].keys()
        for key, value in reference[part].items():
            assert type(message[part][key]) is type(value), (part, key)
    fingers = daemon.settings.scene.fingers
    assert message["left"]["valid"] is ("left" in fingers)
    assert message["right"]["valid"] is ("right" in fingers)


def test_one_finger_presses_on_a_fixed_object(make: Make) -> None:
    daemon = grasped(make(scene={"fingers": ("left",)}), 6.0)
    daemon.loop.advance(2.0)
    assert daemon.loop.state.contacts[0].force == pytest.approx(6.0, rel=0.05)
    assert daemon.loop.state.contacts[1].force == 0.0
    assert not daemon.loop.state.object.valid
    with pytest.raises(Refused, match="needs both fingers"):
        command(daemon, "rotate", angle=0.1)


def test_watching_a_compression_needs_no_servos(make: Make) -> None:
    daemon = make(servos={"backend": "none"})
    deepest = 0.0
    for _ in range(80):
        daemon.loop.advance(0.1)
        deepest = max(deepest, daemon.loop.state.contacts[0].d)
    assert deepest > 0.002
    with pytest.raises(Refused, match="arm: this scene has no servos"):
        command(daemon, "arm")


def test_servos_without_sensors_move_but_do_not_grasp(make: Make) -> None:
    daemon = make(tactile={"backend": "none"})
    command(daemon, "arm")
    command(daemon, "move", left=-0.1)
    advance_to(daemon, "armed", 3.0)
    with pytest.raises(Refused, match="needs a tactile sensor"):
        command(daemon, "grasp")


def test_the_demo_task_grasps_turns_and_releases_by_itself(make: Make) -> None:
    daemon = make(task={"name": "demo"})
    seen: list[str] = []
    turned: list[float] = []
    for _ in range(2000):
        daemon.loop.advance(0.01)
        state = daemon.loop.state
        if not seen or seen[-1] != state.mode:
            seen.append(state.mode)
        if state.object.valid:
            turned.append(state.object.angle)
    assert daemon.loop.state.fault == ""
    once = ["grasping", "holding", *(["rotating", "holding"] * 3), "releasing", "armed"]
    assert seen[: len(once) + 2] == ["disarmed", "armed", *once]
    assert max(turned) > 0.12
    assert min(turned) < -0.12
