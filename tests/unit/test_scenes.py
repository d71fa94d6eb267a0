"""Test the complete pipeline for each kind of scene, with its servos and sensors."""

from typing import Any

import pytest

from softfinger.daemon.control.task import Task
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Event, Reading
from tests.harness.loop import (
    advance_to,
    command,
    grasped,
    heard,
    refusal,
    run_until,
    state_message,
)


def holding_demo(daemon: Daemon) -> list[Event]:
    """Run the demo until the hand holds the object; return a list that collects later events."""
    advance_to(daemon, "holding", 5.0)
    return heard(daemon)


def test_the_demo_of_a_simulated_hand_continues_after_a_fault_and_reports_it(make):
    daemon = make(task={"name": "demo"})
    events = holding_demo(daemon)
    daemon.loop._fail("made up")
    daemon.loop.advance(6.0)
    again = "the simulated hand's task clears the fault and restarts in 2 s"
    assert events[:6] == [
        ("info", "mode", "holding → fault"),
        ("error", "servos.bus", "made up"),
        ("warning", "task", f"the mode is fault; {again}"),
        ("info", "mode", "fault → disarmed"),
        ("info", "mode", "disarmed → armed"),
        ("info", "mode", "armed → grasping"),
    ]
    assert daemon.loop.state.fault == ""
    daemon.loop.stop()
    daemon.loop.advance(5.0)
    assert daemon.loop.state.mode == "disarmed", "a manual stop must end the task"


def test_a_demo_that_cannot_clear_its_fault_tries_again(make):
    daemon = make(task={"name": "demo"})
    events, servos = holding_demo(daemon), daemon.loop.torque.servos
    really = servos.read

    def alerting(reading: Reading) -> None:
        really(reading)
        reading.alert = 1

    servos.read = alerting
    daemon.loop.advance(5.0)
    told = [text for _, kind, text in events if kind == "task"]
    assert len(told) == 3
    assert told[1].startswith(
        "clear: servos: hardware error reported by left; the simulated hand's task"
    )
    servos.read = really
    advance_to(daemon, "holding", 6.0)


def test_a_demo_with_an_endless_step_restarts(make):
    daemon = make(task={"name": "demo"})
    events = holding_demo(daemon)
    daemon.loop._task._end_mode = "moving"  # The hand never enters this mode.
    advance_to(daemon, "disarmed", 13.0)
    assert events[0][2].startswith("still holding after 10 s; the simulated hand's task stops")
    advance_to(daemon, "holding", 6.0)


def test_the_demo_of_a_real_hand_ends_with_the_first_fault(make):
    metal = Settings.model_validate({"task": {"name": "demo"}, "servos": {"backend": "dynamixel"}})
    task = Task.named(metal)
    assert not task.restarts
    daemon = make()
    daemon.loop._task = task
    events = holding_demo(daemon)
    daemon.loop._fail("made up")
    daemon.loop.advance(6.0)
    assert events[2:] == [("warning", "task", "task ended: the mode is fault")]
    assert daemon.loop.state.fault == "made up"


@pytest.mark.parametrize(("action", "mode"), [("hold", "holding"), ("release", "releasing")])
def test_a_real_hand_whose_task_fails_follows_its_settings(make, action, mode):
    daemon = make(commands={"on_silence": action}, task={"name": "demo"})
    daemon.loop._task.restarts = False
    events = holding_demo(daemon)
    daemon.loop._task._end_mode = "moving"  # The hand never enters this mode.
    run_until(daemon, lambda: events, 15.0)
    assert events[0] == ("warning", "task", "task ended: still holding after 10 s")
    assert daemon.loop.state.mode == mode


def test_named_clients_take_over_from_a_demo_that_any_client_started(make):
    loop = (daemon := make(task={"name": "demo"})).loop
    for client in ("page", "other"):
        advance_to(daemon, "holding", 5.0)
        assert loop.command({"command": "release", "client": client})["mode"] == "releasing"
        assert f"release: {client} holds the lease" in refusal(daemon, "release")
        loop.command({"command": "stop"})
        loop.advance(2.1)
        loop.command({"command": "demo", "client": "page"})


SCENES: dict[str, dict[str, Any]] = {
    "two fingers": {},
    "one finger": {"scene": {"fingers": ("left",)}},
    "the other finger": {"scene": {"fingers": ("right",)}},
    "sensor without servos": {"servos": {"backend": "none"}},
    "servos without sensors": {"tactile": {"backend": "none"}},
    "no object model": {"scene": {"object_model": False}},
}


@pytest.mark.parametrize("sections", SCENES.values(), ids=SCENES.keys())
def test_every_scene_runs_with_messages_of_the_same_form(make, sections):
    daemon = make(**sections)
    daemon.loop.advance(2.0)
    message = state_message(daemon)
    reference = state_message(make())
    assert message.keys() == reference.keys()
    for part in ("left", "right", "object"):
        assert message[part].keys() == reference[part].keys()
        for key, value in reference[part].items():
            assert type(message[part][key]) is type(value), (part, key)
    fingers = daemon.settings.scene.fingers
    assert message["left"]["valid"] is ("left" in fingers)
    assert message["right"]["valid"] is ("right" in fingers)


def test_one_finger_presses_on_a_fixed_object(make):
    daemon = grasped(make(scene={"fingers": ("left",)}), 6.0)
    daemon.loop.advance(2.0)
    assert daemon.loop.state.contacts[0].force == pytest.approx(6.0, rel=0.05)
    assert daemon.loop.state.contacts[1].force == 0.0
    assert not daemon.loop.state.object.valid
    with pytest.raises(Refused, match="requires two fingers"):
        command(daemon, "rotate", angle=0.1)


def test_watching_a_compression_needs_no_servos(make):
    daemon = make(servos={"backend": "none"})
    deepest = 0.0
    for _ in range(80):
        daemon.loop.advance(0.1)
        deepest = max(deepest, daemon.loop.state.contacts[0].d)
    assert deepest > 0.002
    with pytest.raises(Refused, match="arm: this scene has no servos"):
        command(daemon, "arm")


def test_servos_without_sensors_move_but_do_not_grasp(make):
    daemon = make(tactile={"backend": "none"})
    command(daemon, "arm")
    command(daemon, "move", left=-0.1)
    advance_to(daemon, "armed", 3.0)
    with pytest.raises(Refused, match="requires a tactile sensor"):
        command(daemon, "grasp")


def test_the_demo_task_grasps_turns_and_releases(make):
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


def test_a_demo_ended_by_a_command_restarts(make):
    daemon = make(task={"name": "demo"})
    advance_to(daemon, "holding", 6.0)
    assert "demo: not accepted in mode holding" in refusal(daemon, "demo")
    command(daemon, "stop")
    daemon.loop.advance(2.0)
    assert daemon.loop.state.mode == "disarmed"
    command(daemon, "demo")
    advance_to(daemon, "rotating", 8.0)
    assert "does not define a task" in refusal(make(), "demo")
