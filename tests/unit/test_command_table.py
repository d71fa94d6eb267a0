"""Test the command table, from which a page is generated, against a running hand."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from softfinger.daemon.control.modes import COMMANDS, REPLY
from softfinger.daemon.errors import Reason, Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.requests import bounds
from tests.harness.loop import Make, advance_to, armed, command, grasped

ALONE = {"scene": {"fingers": ("left",), "object_model": False}}
BLIND = {"tactile": {"backend": "none"}}


def held(daemon: Daemon) -> Daemon:
    return grasped(daemon, 8.0)


def pose_lost(daemon: Daemon) -> Daemon:
    held(daemon).loop.state.object.valid = False
    return daemon


def touched(daemon: Daemon) -> Daemon:
    command(held(daemon), "stop")
    return daemon


def taring(daemon: Daemon) -> Daemon:
    command(armed(daemon), "tare")
    return daemon


def unread(daemon: Daemon) -> Daemon:
    daemon.loop.state.reading.valid = False
    return daemon


def hot(daemon: Daemon) -> Daemon:
    daemon.loop.state.reading.temperature[0] = 200.0
    return daemon


def armed_hot(daemon: Daemon) -> Daemon:
    return hot(armed(daemon))


def faulted(daemon: Daemon) -> Daemon:
    daemon.loop._control.fail("a fault", "tip.force")
    daemon.loop.advance(0.05)
    return daemon


# For each command and reason: settings, a function that prepares the hand, and arguments.
REFUSED: dict[tuple[str, Reason], tuple[Any, Callable[[Daemon], Daemon], dict[str, float]]] = {
    ("arm", Reason.SCENE): ({"servos": {"backend": "none"}}, lambda it: it, {}),
    ("arm", Reason.STATE): ({}, hot, {}),
    ("arm", Reason.LATE): ({}, unread, {}),
    ("tare", Reason.SCENE): (BLIND, lambda it: it, {}),
    ("tare", Reason.STATE): ({}, touched, {}),
    ("move", Reason.REQUEST): ({}, armed, {}),
    ("move", Reason.BOUNDS): ({}, armed, {"left": 2.0}),
    ("move", Reason.SCENE): (ALONE, armed, {"right": 0.0}),
    ("grasp", Reason.BOUNDS): ({}, armed, {"force": 100.0}),
    ("grasp", Reason.SCENE): (BLIND, armed, {}),
    ("grasp", Reason.STATE): ({}, taring, {}),
    ("rotate", Reason.BOUNDS): ({}, held, {"angle": 2.0}),
    ("rotate", Reason.SCENE): ({"scene": {"object_model": False}}, held, {"angle": 0.0}),
    ("rotate", Reason.STATE): ({}, pose_lost, {"angle": 0.0}),
    ("hold", Reason.BOUNDS): ({}, armed, {"force": 100.0}),
    ("hold", Reason.SCENE): (ALONE, armed, {"angle": 0.0}),
    ("hold", Reason.STATE): ({}, armed_hot, {"force": 5.0}),
    ("hold", Reason.REQUEST): ({}, armed, {}),
    ("set", Reason.BOUNDS): ({}, armed, {"compliance": 5.0}),
    ("demo", Reason.SCENE): ({}, lambda it: it, {}),
    ("clear", Reason.STATE): ({}, lambda it: hot(faulted(it)), {}),
}


def test_each_documented_refusal_has_a_scene():
    documented = {(name, reason) for name, each in COMMANDS.items() for reason in each.refusals}
    assert documented == set(REFUSED)


@pytest.mark.parametrize(("name", "reason"), REFUSED, ids=map("-".join, REFUSED))
def test_a_command_is_refused_as_the_table_says(make: Make, name: str, reason: Reason) -> None:
    sections, prepare, numbers = REFUSED[name, reason]
    daemon = prepare(make(**sections))
    with pytest.raises(Refused) as caught:
        command(daemon, name, **numbers)
    assert caught.value.reason == reason


PARAMETERS = [
    (name, key) for name, each in COMMANDS.items() for key in each.parameters if key != "angle"
]


@pytest.mark.parametrize(("name", "key"), PARAMETERS, ids=map("-".join, PARAMETERS))
def test_a_parameter_is_accepted_within_its_range_and_refused_beyond(
    make: Make, name: str, key: str
) -> None:
    daemon = armed(make())
    low, high = bounds(daemon.settings, key)
    assert math.isfinite(high - low)
    for wrong in (low - 1e-6, high + 1e-6):
        with pytest.raises(Refused) as caught:
            command(daemon, name, **{key: wrong})
        assert caught.value.reason == Reason.BOUNDS
    for right in (low + 1e-6, high - 1e-6):
        assert command(daemon, name, **{key: right})["mode"]


def test_replies_have_the_documented_fields(make: Make) -> None:
    seen: dict[str, set[str]] = {}
    daemon = make(task={"name": "demo"})

    def send(name: str, **numbers: float) -> None:
        reply = command(daemon, name, **numbers)
        seen.setdefault(name, set()).update(reply)

    send("demo")
    send("stop")
    advance_to(daemon, "disarmed", 1.0)
    for name in ("status", "tare"):
        send(name)
    daemon.loop.advance(2.0)
    for name, numbers in (("arm", {}), ("move", {"left": 0.0}), ("set", {"compliance": 0.02})):
        send(name, **numbers)
    daemon.loop.advance(0.1)
    send("hold", force=5.0, angle=0.0)
    send("rotate", angle=0.0)
    advance_to(daemon, "holding", 3.0)
    send("hold", angle=0.0)
    send("grasp", force=6.0)
    for name in ("release", "disarm"):
        send(name)
    faulted(daemon)
    send("clear")
    # This object is outside the packaged map of held objects.
    thin = {"width": 0.002, "width_min": 0.0005}
    heavy = {"object_load": 9.81}
    daemon = armed(make(object=thin, control=heavy))
    send("grasp", force=10.0)
    send("stop")
    daemon = armed(make(object=thin, control=heavy))
    send("hold", force=10.0)
    assert seen.keys() == COMMANDS.keys()
    assert seen == {name: {"mode", *each.reply} for name, each in COMMANDS.items()}
    assert {field for each in COMMANDS.values() for field in each.reply} | {"mode"} == set(REPLY)
