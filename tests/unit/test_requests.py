"""The transition table: what is heard when, and how a request must look."""

import pytest

from softfinger.daemon.control.modes import COMMANDS, Mode
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.requests import Command, Lease, parse


def heard(mode: Mode) -> set[str]:
    return {name for name, (modes, _) in COMMANDS.items() if mode in modes}


def test_stop_and_status_are_heard_in_every_mode():
    assert all({"stop", "status"} <= heard(mode) for mode in Mode)


def test_nothing_moves_the_hand_before_it_is_armed_or_in_a_fault():
    assert heard(Mode.DISARMED) == {"arm", "demo", "disarm", "tare", "stop", "status"}
    assert heard(Mode.FAULT) == {"clear", "stop", "status"}


def test_a_good_request_is_parsed():
    request = {"command": "grasp", "force": 5, "client": "notebook"}
    assert parse(request, Mode.ARMED) == Command("grasp", {"force": 5.0}, "notebook")
    assert parse({"command": "grasp"}, Mode.HOLDING) == Command("grasp", {}, "")


@pytest.mark.parametrize(
    ("request_", "mode", "text"),
    [
        ({"command": "jump"}, Mode.ARMED, "unknown command 'jump'; known: arm, disarm"),
        ({"command": "grasp", "froce": 1.0}, Mode.ARMED, "unknown parameter 'froce'; expected fo"),
        ({"command": "arm", "force": 1.0}, Mode.DISARMED, "expected no parameters"),
        ({"command": "grasp", "force": "much"}, Mode.ARMED, "expected a number, found str"),
        ({"command": "grasp", "force": True}, Mode.ARMED, "expected a number, found bool"),
        ({"command": "grasp", "force": float("nan")}, Mode.ARMED, "finite number, found nan"),
        ({"command": "rotate"}, Mode.HOLDING, "rotate: angle is missing"),
        ({"command": "grasp"}, Mode.DISARMED, "grasp: not while disarmed; arm first"),
        ({"command": "arm"}, Mode.FAULT, "arm: not while fault; clear the fault first"),
        ({"command": "clear"}, Mode.DISARMED, "clear: not while disarmed; there is no fault"),
        ({"command": "rotate", "angle": 0.1}, Mode.ARMED, "possible while grasping, holding, r"),
        ({"command": "arm", "client": 7}, Mode.DISARMED, "client: expected a text"),
        ({"command": "arm", "client": "x" * 65}, Mode.DISARMED, "at most 64 characters"),
    ],
)
def test_a_bad_request_is_refused_with_found_and_expected(request_, mode, text):
    with pytest.raises(Refused) as caught:
        parse(request_, mode)
    assert text in str(caught.value)


def take(lease: Lease, command: Command, now: float) -> None:
    lease.check(command, now)
    lease.renew(command, now)


def test_a_command_that_was_not_carried_out_takes_no_lease():
    lease = Lease(2.0)
    lease.check(Command("grasp", {}, "a"), 0.0)
    take(lease, Command("grasp", {}, "b"), 0.1)


def test_one_commander_at_a_time():
    lease = Lease(2.0)
    take(lease, Command("arm", {}, "a"), 0.0)
    with pytest.raises(Refused, match=r"grasp: a commands the hand \(1\.0 s\)"):
        take(lease, Command("grasp", {}, "b"), 1.0)
    take(lease, Command("disarm", {}, "b"), 1.0)
    take(lease, Command("status", {}, ""), 1.0)
    take(lease, Command("grasp", {}, "a"), 1.0)
    with pytest.raises(Refused):
        take(lease, Command("grasp", {}, "b"), 2.9)
    take(lease, Command("grasp", {}, "b"), 3.0)


def test_clients_without_a_name_share_one_lease():
    lease = Lease(2.0)
    take(lease, Command("arm", {}, ""), 0.0)
    take(lease, Command("grasp", {}, ""), 0.1)
    with pytest.raises(Refused, match="an unnamed client commands"):
        take(lease, Command("grasp", {}, "a"), 0.2)
