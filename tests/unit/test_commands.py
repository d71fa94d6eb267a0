"""Command server and client on real sockets; what is heard when, and how a request must look."""

import math
import os
import select
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from softfinger.daemon.client.command_client import send
from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.control.modes import COMMANDS, Mode
from softfinger.daemon.errors import Refused
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop import build
from softfinger.daemon.loop.requests import Command, Lease, parse
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import command_server
from softfinger.daemon.wire.command_server import CommandServer, Pauses, decode
from tests.conftest import until
from tests.harness.gateway import Served


def echo(request: dict[str, Any]) -> dict[str, Any]:
    if request["command"] == "no":
        raise Refused("not now")
    return {"heard": request["command"]}


@pytest.fixture
def server(addresses: tuple[str, str]) -> Iterator[Served]:
    with Served(commands=addresses[1]) as served, served.serving(echo):
        yield served


class Asking:
    """A client with one request, which a served gateway and loop are to answer."""

    def __init__(
        self, context: zmq.Context[Any], served: Served, address: str, request: str | bytes
    ) -> None:
        self._served = served
        self.socket = context.socket(zmq.REQ)
        self.socket.connect(address)
        self.send(request)

    def send(self, request: str | bytes) -> None:
        if isinstance(request, str):
            request = msgpack.packb({"command": request})
        self.socket.send(request)

    def told(self) -> dict[str, Any]:
        until(lambda: [self._served.serve(echo), self.socket.poll(0)][1])
        return msgpack.unpackb(self.socket.recv())


def test_a_plain_req_socket_gets_its_answer(server, addresses):
    assert send(addresses[1], {"command": "arm"}, 60.0) == {"ok": True, "heard": "arm"}
    assert send(addresses[1], {"command": "no"}, 60.0) == {"ok": False, "error": "not now"}


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (b"", "not msgpack"),
        (b"\xc1\xff", "not msgpack"),
        (msgpack.packb([1, 2]), "expected a map, found list"),
        (msgpack.packb({"force": 1.0}), 'expected a text under "command"'),
        (msgpack.packb({"command": 7}), 'expected a text under "command"'),
        (msgpack.packb({"command": "arm", 3: 4}), "not msgpack"),
        (msgpack.packb({"command": "x" * 300}), "bytes; at most 200"),
        (msgpack.packb({"command": "arm", "x": {b"k": 1}}), "numbers and texts as values"),
        (msgpack.packb({"command": "arm", "client": [[[]]]}), "numbers and texts as values"),
    ],
)
def test_malformed_commands_are_refused_and_the_server_lives_on(context, addresses, payload, error):
    with Served(commands=addresses[1]) as served:
        reply = Asking(context, served, addresses[1], payload).told()
        assert reply["ok"] is False
        assert error in reply["error"]
        assert Asking(context, served, addresses[1], "arm").told()["ok"] is True


def test_multipart_nonsense_and_clients_that_go_away_change_nothing(server, context, addresses):
    socket = context.socket(zmq.DEALER)
    socket.connect(addresses[1])
    socket.send_multipart([b"", b"a", b"b", b"c"])  # no client's form: passed over
    socket.send(msgpack.packb({"command": "arm"}))
    socket.close(linger=1000)
    assert send(addresses[1], {"command": "arm"}, 60.0)["ok"] is True


@pytest.mark.parametrize("under_way", [1, 4])  # the second request waits in the queue, or the link
def test_what_came_before_a_fence_is_refused_and_what_comes_after_is_not(
    context, addresses, monkeypatch, under_way
):
    monkeypatch.setattr(bounds, "UNDER_WAY", under_way)
    with Served(commands=addresses[1]) as served:
        early = Asking(context, served, addresses[1], "arm")
        until(lambda: [served.settle(1), served.link.asked][1])
        asking = Asking(context, served, addresses[1], "status")
        queue = served.service.requests
        until(lambda: [served.settle(1), len(served.link.asked) + queue._count == 2][1])
        served.server.raise_fence()
        assert "before a stop; send it again" in early.told()["error"]
        assert asking.told() == {"ok": True, "heard": "status"}, "it harms nobody"
        early.send("arm")
        assert early.told() == {"ok": True, "heard": "arm"}


@pytest.fixture
def standing(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    """The clock by which standstills are noticed."""
    clock = VirtualClock()
    monkeypatch.setattr(command_server.time, "clock_gettime", lambda _: clock.now())
    return clock


def on_the_link(served: Served) -> None:
    """Wait until the gateway has handed something on."""
    link = [served.link._socket]
    until(lambda: [served.service.step(0.0), select.select(link, [], [], 0)[0]][1])


@pytest.mark.parametrize("where", ["tick", "look", "gateway"])
def test_what_came_before_the_end_of_a_pause_is_refused(
    context, addresses, standing, where, monkeypatch
):
    with Served(commands=addresses[1]) as served:
        door = served.service._commands
        if where == "gateway":
            served.service._pauses = Pauses(0.2)
        else:
            served.server = CommandServer(served.link, None, 0.2)
        until(lambda: served.serve(echo) or max(served.link.past, door.past) < math.inf)
        early, late = (Asking(context, served, addresses[1], "arm") for _ in range(2))
        standing.sleep_until(0.19)
        assert early.told()["ok"]
        assert late.told()["ok"]
        served.serve(echo)  # nothing is carried out: no work at this tick
        late = Asking(context, served, addresses[1], "arm")
        if where != "gateway":
            on_the_link(served)
        look = served.link.look
        if where == "look":
            with monkeypatch.context() as patch:
                patch.setattr(served.link, "look", lambda: look() or standing.sleep_until(0.5))
                served.server.serve(echo)
        else:
            standing.sleep_until(0.5)
        assert "stood still" in late.told()["error"]
        assert Asking(context, served, addresses[1], "arm").told()["ok"]


def test_the_time_that_a_command_itself_takes_is_no_pause(context, addresses, standing):
    def long(request: dict[str, Any]) -> dict[str, Any]:
        standing.sleep_until(standing.now() + 5.0)
        return echo(request)

    with Served(commands=addresses[1]) as served:
        served.server = CommandServer(served.link, None, 0.1)
        until(lambda: served.serve(echo) or served.link.past < math.inf)
        clear = Asking(context, served, addresses[1], "clear")
        until(lambda: served.serve(long) or standing.now() > 4.0)
        arm = Asking(context, served, addresses[1], "arm")
        on_the_link(served)
        standing.sleep_until(standing.now() + 0.25)  # torque goes on in the rest of the tick
        assert arm.told()["ok"]
        assert clear.told()["ok"]


def test_a_stop_is_one_whatever_it_holds_besides():
    more = {"client": "a", "how": ["now"], b"x": 4}
    assert decode(msgpack.packb({"command": "stop", **more})) == {"command": "stop", "client": "a"}
    with pytest.raises(Refused, match="numbers and texts as values"):
        decode(msgpack.packb({"command": "arm", "how": ["now"]}))


class Flood:
    """Clients that send without waiting for answers; nothing serves yet."""

    def __init__(self, context: zmq.Context[Any], address: str, clients: int, each: int) -> None:
        self.sockets = [context.socket(zmq.DEALER) for _ in range(clients)]
        for socket in self.sockets:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(address)
            for _ in range(each):
                socket.send(msgpack.packb({"command": "move"}))

    def collect(self, replies: list[dict[str, Any]]) -> int:
        """Add what has been answered; how many there are now."""
        for socket in self.sockets:
            while socket.poll(0):
                replies.append(msgpack.unpackb(socket.recv()))
        return len(replies)


def test_a_stop_goes_before_all_that_waits(context, addresses):
    clock = VirtualClock()  # what waits while clients come gets no older
    with Served(commands=addresses[1], clock=clock) as served:
        flood = Flood(context, addresses[1], clients=4, each=40)
        order: list[str] = []
        link, queue = served.link, served.service.requests

        def note(request: dict[str, Any]) -> dict[str, Any]:
            order.append(request["command"])
            return {}

        until(lambda: [served.settle(1), len(link.asked) + queue._count == 160][1])
        served.serve(note)  # the flood is being worked on
        carried_out = len(order)
        assert carried_out > 0
        stopper = context.socket(zmq.DEALER)
        stopper.setsockopt(zmq.LINGER, 0)
        stopper.connect(addresses[1])
        stopper.send_multipart([b"", msgpack.packb({"command": "stop"})])
        until(lambda: [served.settle(1), link.stops][1])

        def serve() -> None:
            clock.sleep_until(clock.now() + 1e-3)
            served.serve(note)

        until(lambda: [serve(), stopper.poll(0)][1])
        # All that was sent before the stop is answered, and none of it carried out.
        replies: list[dict[str, Any]] = []
        until(lambda: [serve(), flood.collect(replies) == 160][1])
        assert order[carried_out:] == ["stop"]
        assert sum(reply["ok"] for reply in replies) == carried_out


def test_a_client_that_sends_too_much_is_refused_and_others_are_not(context, addresses):
    clock = VirtualClock()
    with Served(commands=addresses[1], per_second=20.0, clock=clock) as served:
        flood = Flood(context, addresses[1], clients=1, each=60)
        quiet = Flood(context, addresses[1], clients=1, each=3)
        replies: list[dict[str, Any]] = []
        kind: list[dict[str, Any]] = []

        def all_answered() -> bool:
            served.serve(echo)
            flood.collect(replies)
            return served.server.refused_by_pace == 40 and quiet.collect(kind) == 3

        until(all_answered)
        until(lambda: [served.serve(echo), flood.collect(replies) == 60][1])
        assert sum(reply["ok"] for reply in replies) == 20
        assert {reply.get("error") for reply in replies if not reply["ok"]} == {
            "too many commands: at most 20 a second"
        }
        assert all(reply["ok"] for reply in kind)
        # A second later it may send again.
        clock.sleep_until(clock.now() + 1.0)
        flood.sockets[0].send(msgpack.packb({"command": "move"}))
        last: list[dict[str, Any]] = []
        answer = {"ok": True, "heard": "move"}  # behind what is left of the flood's
        until(lambda: [served.serve(echo), flood.collect(last), answer in last][2])


def test_clients_that_flood_leave_others_a_place(context, addresses):
    heard = []

    def note(request: dict[str, Any]) -> dict[str, Any]:
        heard.append(request["command"])
        return {}

    with Served(commands=addresses[1], per_second=600.0) as served:
        flood = Flood(context, addresses[1], clients=4, each=500)
        # No place is left.
        until(lambda: [served.service.step(0.0), served.service.requests.refused > 10][1])
        other = Asking(context, served, addresses[1], "grasp").socket
        until(lambda: [served.serve(note), other.poll(0)][1])
        assert msgpack.unpackb(other.recv())["ok"]
        assert flood.sockets
        assert len(heard) < 1100, "it waited for more than those that were before it"


@pytest.mark.parametrize("mode", [0o600, 0o660])
def test_an_ipc_file_has_the_rights_that_were_set(tmp_path_factory, mode):
    folder = tmp_path_factory.mktemp("s")
    with Served(f"ipc://{folder}/s", f"ipc://{folder}/c", ipc_mode=mode):
        for name in ("c", "s"):
            assert stat.S_IMODE(Path(f"{folder}/{name}").stat().st_mode) == mode
    assert list(folder.iterdir()) == []


def test_a_signal_while_the_sockets_are_made_ends_the_start(monkeypatch, addresses):
    made: list[Gateway] = []

    class Noted(Gateway):
        def __init__(self, config: Config) -> None:
            super().__init__(config)
            made.append(self)

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "Gateway", Noted)
    monkeypatch.setattr(build, "LocalStop", interrupted)
    wire = {"stream": {"address": addresses[0]}, "commands": {"address": addresses[1]}}
    with pytest.raises(KeyboardInterrupt):
        build.Daemon(Settings.model_validate(wire))
    with pytest.raises(ProcessLookupError):
        os.kill(made[0].process, 0)


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
