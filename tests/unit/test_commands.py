"""Test the command server and client on real sockets, with requests in any order and form."""

import os
import select
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from softfinger.daemon.client.command_client import send
from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.control.modes import COMMANDS, Mode
from softfinger.daemon.errors import AddressError, Reason, Refused
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import bind
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop import build
from softfinger.daemon.loop.requests import Command, Lease, command_age_max, parse
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.command_server import Handler, decode
from tests.conftest import until
from tests.harness.gateway import Served


def echo(request: dict[str, Any], age: float) -> dict[str, Any]:
    if request["command"] == "no":
        raise Refused("not now", Reason.LEASE)
    return {"heard": request["command"]}


@pytest.fixture
def served(addresses: tuple[str, str]) -> Iterator[Served]:
    """Yield a gateway and a loop, which the test steps."""
    with Served(commands=addresses[1]) as served:
        yield served


@pytest.fixture
def server(served: Served) -> Iterator[Served]:
    """Serve commands in a thread."""
    with served.serving(echo):
        yield served


class Heard:
    """Command handler that records the requests."""

    def __init__(self) -> None:
        self.requests: list[dict[str, Any]] = []

    def __call__(self, request: dict[str, Any], age: float) -> dict[str, Any]:
        self.requests.append(request)
        return {}

    def commands(self) -> list[str]:
        return [request["command"] for request in self.requests]


class Asking:
    """A client that sends one request at a time to a gateway and a loop."""

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

    def told(self, handler: Handler = echo) -> dict[str, Any]:
        """Serve requests until the reply arrives, and return the reply."""
        self._served.serve_until(handler, lambda: self.socket.poll(0))
        return msgpack.unpackb(self.socket.recv())


def test_a_plain_req_socket_gets_its_reply(server, addresses):
    assert send(addresses[1], {"command": "arm"}, 60.0) == {"ok": True, "heard": "arm"}
    refusal = {"ok": False, "error": "not now", "reason": "lease"}
    assert send(addresses[1], {"command": "no"}, 60.0) == refusal


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (b"", "not valid msgpack"),
        (b"\xc1\xff", "not valid msgpack: invalid format"),
        (msgpack.packb([1, 2]), "expected a map, found list"),
        (msgpack.packb({"force": 1.0}), 'expected a string under the key "command"'),
        (msgpack.packb({"command": 7}), 'expected a string under the key "command"'),
        (msgpack.packb({"command": "arm", 3: 4}), "not valid msgpack"),
        (msgpack.packb({"command": "x" * 300}), "bytes, expected at most 200"),
        (msgpack.packb({"command": "arm", "x": {b"k": 1}}), "numbers or strings as values"),
        (msgpack.packb({"command": "arm", "client": [[[]]]}), "numbers or strings as values"),
        (msgpack.packb({"command": "arm", "key": 7}), "key: expected a string of 1 to 64"),
        (msgpack.packb({"command": "arm", "key": ""}), "key: expected a string of 1 to 64"),
        (msgpack.packb({"command": "arm", "key": "k" * 65}), "key: expected a string of 1 to 64"),
    ],
)
def test_malformed_commands_are_refused_and_the_server_continues(
    context, served, addresses, payload, error
):
    reply = Asking(context, served, addresses[1], payload).told()
    assert (reply["ok"], reply["reason"]) == (False, "request")
    assert error in reply["error"]
    assert Asking(context, served, addresses[1], "arm").told()["ok"] is True


def test_malformed_multipart_messages_and_disconnecting_clients_have_no_effect(
    server, context, addresses
):
    socket = context.socket(zmq.DEALER)
    socket.connect(addresses[1])
    socket.send_multipart([b"", b"a", b"b", b"c"])  # Real clients never send such a message.
    socket.send(msgpack.packb({"command": "arm"}))
    socket.close(linger=1000)
    assert send(addresses[1], {"command": "arm"}, 60.0)["ok"] is True


# If only 1 request may be unanswered, the second request waits in the queue. If 16 requests may be
# unanswered, the second request waits on the link.
@pytest.mark.parametrize("under_way", [1, 16])
def test_requests_before_a_fence_are_refused_and_later_ones_are_not(
    context, addresses, monkeypatch, under_way
):
    monkeypatch.setattr(bounds, "UNANSWERED_MAX", under_way)
    with Served(commands=addresses[1]) as served:
        early = Asking(context, served, addresses[1], "arm")
        served.settle_until(lambda: served.link.asked)
        asking = Asking(context, served, addresses[1], "status")
        queue = served.service.commands
        served.settle_until(lambda: len(served.link.asked) + queue.count == 2)
        served.link.fence()
        assert early.told()["reason"] == "stopped"
        assert asking.told() == {"ok": True, "heard": "status"}, (
            "other requests must not be affected"
        )
        early.send("arm")
        assert early.told() == {"ok": True, "heard": "arm"}


def test_a_request_passes_few_functions(context, served, addresses):
    """Count the daemon's functions that run for one request, from the socket to the handler."""
    passed: set[str] = set()
    heard = Heard()

    def note(frame: Any, event: str, _: object) -> None:
        code = frame.f_code
        is_ours = "/daemon/" in code.co_filename
        if event == "call" and not heard.requests and is_ours and code.co_name[0] != "<":
            passed.add(code.co_qualname)

    asking = Asking(context, served, addresses[1], "arm")
    asking.told()
    asking.send("arm")
    until(served.has_request)
    sys.setprofile(note)
    try:
        served.serve_until(heard, lambda: heard.requests)
    finally:
        sys.setprofile(None)
    assert {"CommandEndpoint.read", "Link.look", "CommandServer.serve"} < passed
    assert len(passed) <= 25 - 2, sorted(passed)


ARM = msgpack.packb({"command": "arm"})


def test_a_correlating_req_socket_gets_its_reply(context, served, addresses):
    client = context.socket(zmq.REQ)
    client.setsockopt(zmq.REQ_CORRELATE, 1)
    client.setsockopt(zmq.REQ_RELAXED, 1)
    client.connect(addresses[1])
    for name in ("arm", "status"):
        client.send(msgpack.packb({"command": name}))
        served.serve_until(echo, lambda: client.poll(0))
        assert msgpack.unpackb(client.recv()) == {"ok": True, "heard": name}


def test_a_proxy_may_be_used(context, served, addresses):
    front, back = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    port = front.bind_to_random_port("tcp://127.0.0.1")
    back.connect(addresses[1])
    client = context.socket(zmq.REQ)
    client.connect(f"tcp://127.0.0.1:{port}")
    client.send(ARM)

    def answered() -> int:
        for one, other in ((front, back), (back, front)):
            if one.poll(0):
                other.send_multipart(one.recv_multipart())
        served.serve(echo)
        return client.poll(0)

    until(answered)
    assert msgpack.unpackb(client.recv()) == {"ok": True, "heard": "arm"}


@pytest.mark.parametrize(
    ("frames", "envelope", "heard"),
    [
        ([ARM], 0, True),
        ([b"", ARM], 1, True),
        ([b"id", b"", ARM], 2, True),
        ([*[b"hop"] * (bounds.PART_COUNT_MAX - 3), b"", ARM], bounds.PART_COUNT_MAX - 2, True),
        ([*[b"hop"] * (bounds.PART_COUNT_MAX - 2), b"", ARM], 0, False),
        ([b"x" * 700, b"x" * 400, b"", ARM], 0, False),
        ([b"", ARM, ARM], 1, False),  # A REQ socket would send only two frames.
        ([b"id", ARM], 0, False),
        ([ARM, b""], 0, False),
        ([b"part"] * 500, 0, False),
    ],
)
def test_the_envelope_is_returned_with_the_reply_and_a_malformed_one_is_answered(
    context, served, addresses, frames, envelope, heard
):
    client = context.socket(zmq.DEALER)
    client.connect(addresses[1])
    client.send_multipart(frames)
    served.serve_until(echo, lambda: client.poll(0))
    *back, reply = client.recv_multipart()
    assert back == frames[:envelope]
    if heard:
        assert msgpack.unpackb(reply) == {"ok": True, "heard": "arm"}
    else:
        assert msgpack.unpackb(reply)["reason"] == "request"
        assert "expected one frame that contains the command" in msgpack.unpackb(reply)["error"]


class Aged:
    """Command handler that records the commands' ages and refuses commands older than 0.2 s."""

    def __init__(self) -> None:
        self.ages: list[float] = []

    def __call__(self, request: dict[str, Any], age: float) -> dict[str, Any]:
        if age > 0.2:
            raise Refused("old", Reason.LATE)
        self.ages.append(age)
        return {"count": len(self.ages)}


def pass_time(clock: VirtualClock, seconds: float) -> None:
    clock.sleep_until(clock.now() + seconds)


def on_the_link(served: Served) -> None:
    """Wait until the gateway has forwarded a request."""
    link = [served.link._channel]
    until(lambda: served.service.step(0.0) or select.select(link, [], [], 0)[0])


@pytest.mark.parametrize("stalled", ["loop", "gateway", "both"])
def test_age_is_counted_from_before_a_stall_of_either_process(context, addresses, stalled):
    clock, aged = VirtualClock(), Aged()
    with Served(commands=addresses[1], clock=clock) as served:
        asking = Asking(context, served, addresses[1], "arm")
        if stalled == "loop":
            on_the_link(served)
        elif stalled == "gateway":
            # libzmq has received the request, so the gateway cannot determine how long it has
            # waited.
            until(served.has_request)
        pass_time(clock, 0.5)
        # After the stall, libzmq's own thread may run later than the gateway's check.
        assert asking.told(aged)["reason"] == "late"
        pass_time(clock, bounds.POLL_GAP_MAX / 2)
        served.serve(aged)
        asking.send("arm")
        assert asking.told(aged) == {"ok": True, "count": 1}
        assert 0.0 <= aged.ages[0] <= bounds.POLL_GAP_MAX


def keyed(name: str = "arm", key: str = "k") -> bytes:
    return msgpack.packb({"command": name, "key": key})


def test_a_key_is_executed_once_and_its_reply_repeated(context, addresses):
    aged = Aged()
    with Served(commands=addresses[1], clock=VirtualClock()) as served:
        for key, count in (("a", 1), ("a", 1), ("b", 2), ("a", 1)):
            asking = Asking(context, served, addresses[1], keyed(key=key))
            assert asking.told(aged) == {"ok": True, "count": count}


@pytest.mark.parametrize("meanwhile", ["", "signal", "stop", "disarm", "status"])
def test_a_repeated_late_command_is_executed_unless_another_one_was_meanwhile(
    context, addresses, meanwhile
):
    clock, aged = VirtualClock(), Aged()
    with Served(commands=addresses[1], clock=clock) as served:
        asking = Asking(context, served, addresses[1], keyed())
        on_the_link(served)
        pass_time(clock, 0.5)
        assert asking.told(aged)["reason"] == "late"
        for _ in range(4):  # Wait until the refusal time is over.
            pass_time(clock, bounds.REFUSAL_TIME / 2)
            served.serve(aged)
        if meanwhile == "signal":
            served.link.fence()
        elif meanwhile:
            other = Asking(context, served, addresses[1], meanwhile)
            served.serve_until(aged, lambda: pass_time(clock, 1e-3) or other.socket.poll(0))
        # Wait until the gateway can distinguish new requests from requests before the stop.
        until(lambda: served._is_open())
        count = len(aged.ages)
        asking.send(keyed())
        reply = asking.told(aged)
        if meanwhile in ("", "status"):
            assert reply == {"ok": True, "count": count + 1}
        else:
            assert reply["reason"] == ("superseded" if meanwhile == "disarm" else "stopped")
            assert len(aged.ages) == count


def test_every_disarm_is_executed_even_with_the_same_key(context, addresses):
    aged = Aged()
    with Served(commands=addresses[1], clock=VirtualClock()) as served:
        for count in (1, 2):
            asking = Asking(context, served, addresses[1], keyed("disarm"))
            assert asking.told(aged) == {"ok": True, "count": count}


def test_a_fence_is_passed_only_after_some_time_without_a_gap(context, addresses):
    """After a pause, libzmq's thread may still deliver requests sent before a stop."""
    clock, aged = VirtualClock(), Aged()
    with Served(commands=addresses[1], clock=clock) as served:
        served.link.fence()
        served.settle()
        pass_time(clock, 2.0 * bounds.POLL_GAP_MAX)
        served.settle()
        assert served.link.confirmed == 0
        until(lambda: served._is_open())
        asking = Asking(context, served, addresses[1], "arm")
        assert asking.told(aged)["ok"]


def test_a_setpoint_only_replaces_one_with_the_same_or_fewer_fields(context, served, addresses):
    stream = context.socket(zmq.DEALER)
    stream.connect(addresses[1])
    for name, numbers in (
        (b"force", {"force": 8.0}),
        (b"angle", {"angle": 0.1}),
        (b"both", {"force": 5.0, "angle": 0.1, "key": "k"}),
        (b"later", {"force": 4.0, "angle": 0.2}),
    ):
        stream.send_multipart([name, b"", msgpack.packb({"command": "hold", **numbers})])
    served.settle_until(lambda: len(served.link.asked) == 4)
    reasons = {}

    def answered() -> bool:
        while stream.poll(0):
            name, _, reply = stream.recv_multipart()
            reasons[name] = msgpack.unpackb(reply).get("reason")
        return len(reasons) == 4

    served.serve_until(echo, answered)
    superseded = dict.fromkeys((b"angle", b"both"), "superseded")
    assert reasons == {b"force": None, b"later": None, **superseded}


def test_only_the_newest_waiting_setpoint_is_executed(context, addresses):
    heard = Heard()
    with Served(commands=addresses[1], clock=VirtualClock()) as served:
        streams = [context.socket(zmq.DEALER) for _ in range(2)]
        for k, stream in enumerate(streams):
            stream.connect(addresses[1])
            for force in range(20):
                stream.send(msgpack.packb({"command": "hold", "force": 100 * k + force}))
        replies: list[list[dict[str, Any]]] = [[], []]

        def collected() -> bool:
            for stream, found in zip(streams, replies, strict=True):
                while stream.poll(0):
                    found.append(msgpack.unpackb(stream.recv()))
            return all(len(found) == 20 for found in replies)

        # Let the gateway receive all setpoints before the loop continues.
        commands = served.service.commands
        served.settle_until(lambda: commands.count + len(served.link.asked) == 40)
        served.serve_until(heard, collected)
        forces = [request["force"] for request in heard.requests]
        assert {19, 119} <= set(forces), "each connection's newest setpoint must be executed"
        assert len(forces) <= 2 * -(-40 // bounds.UNANSWERED_MAX), (
            "older setpoints that wait at the same time must be superseded"
        )
        refused = {each["reason"] for found in replies for each in found if not each["ok"]}
        assert refused == {"superseded"}


def test_stop_is_accepted_with_unknown_fields():
    more = {"client": "a", "how": ["now"], b"x": 4}
    assert decode(msgpack.packb({"command": "stop", **more})) == {"command": "stop"}
    with pytest.raises(Refused, match="numbers or strings as values"):
        decode(msgpack.packb({"command": "arm", "how": ["now"]}))


def test_a_request_that_is_nested_too_deeply_is_reported():
    with pytest.raises(Refused, match="not valid msgpack: nested too deeply"):
        decode(b"\x91" * 2000 + b"\xc0")


def test_long_requests_are_unpacked_over_several_ticks_and_a_stop_goes_first(context, addresses):
    heard = Heard()
    with Served(commands=addresses[1], max_bytes=4096) as served:
        client, stopper = context.socket(zmq.DEALER), context.socket(zmq.DEALER)
        for socket in (client, stopper):
            socket.connect(addresses[1])
        long = msgpack.packb({"command": "move", "x": [[[1]] * 60] * 20})
        for _ in range(bounds.UNANSWERED_MAX):
            client.send(long)
        asked = served.link.asked
        served.settle_until(lambda: len(asked) == bounds.UNANSWERED_MAX)
        stopper.send(msgpack.packb({"command": "stop"}))
        served.settle_until(lambda: len(asked) == bounds.UNANSWERED_MAX + 1)
        served.server.serve(heard)
        assert heard.commands() == ["stop"]
        assert len(asked) == bounds.UNANSWERED_MAX - -(-4096 // len(long))
        replies: list[str] = []

        def answered() -> bool:
            served.serve(heard)
            while client.poll(0):
                replies.append(msgpack.unpackb(client.recv())["reason"])
            return len(replies) == bounds.UNANSWERED_MAX

        until(answered)
        assert set(replies) == {"request"}


class Flood:
    """Clients that send many requests without waiting for replies.

    Initially, the requests are not served.
    """

    def __init__(self, context: zmq.Context[Any], address: str, clients: int, each: int) -> None:
        self.sockets = [context.socket(zmq.DEALER) for _ in range(clients)]
        for socket in self.sockets:
            socket.connect(address)
            for _ in range(each):
                socket.send(msgpack.packb({"command": "move"}))

    def collect(self, replies: list[dict[str, Any]]) -> int:
        """Append the available replies to ``replies``, and return the number of replies so far."""
        for socket in self.sockets:
            while socket.poll(0):
                replies.append(msgpack.unpackb(socket.recv()))
        return len(replies)


def test_a_stop_goes_before_all_waiting_requests(context, addresses):
    clock = VirtualClock()  # Time does not advance while clients connect.
    with Served(commands=addresses[1], clock=clock) as served:
        flood = Flood(context, addresses[1], clients=4, each=40)
        heard = Heard()
        link, queue = served.link, served.service.commands
        served.settle_until(lambda: len(link.asked) + queue.count == 160)
        served.serve(heard)  # Let the gateway process only part of the requests.
        carried_out = len(heard.requests)
        assert carried_out > 0
        stopper = context.socket(zmq.DEALER)
        stopper.connect(addresses[1])
        stopper.send_multipart([b"", msgpack.packb({"command": "stop"})])
        served.settle_until(lambda: any(ask.urgent for ask in link.asked))

        def serve() -> None:
            pass_time(clock, 1e-3)
            served.serve(heard)

        until(lambda: serve() or stopper.poll(0))
        # Each request before the stop receives a reply but is not executed.
        replies: list[dict[str, Any]] = []
        until(lambda: serve() or flood.collect(replies) == 160)
        assert heard.commands()[carried_out:] == ["stop"]
        assert sum(reply["ok"] for reply in replies) == carried_out


def test_a_client_that_exceeds_its_rate_is_refused_and_others_are_not(context, addresses):
    clock = VirtualClock()
    with Served(commands=addresses[1], per_second=20.0, clock=clock) as served:
        flood = Flood(context, addresses[1], clients=1, each=60)
        quiet = Flood(context, addresses[1], clients=1, each=3)
        replies: list[dict[str, Any]] = []
        kind: list[dict[str, Any]] = []

        def all_answered() -> bool:
            served.serve(echo)
            flood.collect(replies)
            return served.link.refused == 40 and quiet.collect(kind) == 3

        until(all_answered)
        served.serve_until(echo, lambda: flood.collect(replies) == 60)
        assert sum(reply["ok"] for reply in replies) == 20
        assert {reply.get("error") for reply in replies if not reply["ok"]} == {
            "too many commands: expected at most 20 per second"
        }
        assert all(reply["ok"] for reply in kind)
        # The rate limit allows another request after a second.
        pass_time(clock, 1.0)
        flood.sockets[0].send(msgpack.packb({"command": "move"}))
        last: list[dict[str, Any]] = []
        # The reply to the last request follows all replies to the flood.
        answer = {"ok": True, "heard": "move"}
        served.serve_until(echo, lambda: flood.collect(last) and answer in last)


def test_flooding_clients_leave_room_for_others(context, addresses):
    heard = Heard()
    with Served(commands=addresses[1], per_second=600.0) as served:
        flood = Flood(context, addresses[1], clients=4, each=500)
        # Let the requests fill the gateway's buffers.
        until(lambda: served.service.step(0.0) or served.service.commands.refused > 10)
        assert Asking(context, served, addresses[1], "grasp").told(heard)["ok"]
        assert flood.sockets
        assert len(heard.requests) < 1100, "the request waited for later requests"


@pytest.mark.parametrize("mode", [0o600, 0o660])
def test_an_ipc_file_has_the_configured_permissions(tmp_path_factory, mode):
    folder = tmp_path_factory.mktemp("s")
    with Served(f"ipc://{folder}/s", f"ipc://{folder}/c", ipc_mode=mode):
        for name in ("c", "s"):
            assert stat.S_IMODE(Path(f"{folder}/{name}").stat().st_mode) == mode
    assert list(folder.iterdir()) == []


def test_an_ipc_path_that_cannot_be_examined_is_reported(context):
    with pytest.raises(AddressError, match="File name too long"):
        bind(context.socket(zmq.REP), f"ipc:///tmp/{'x' * 300}", 0o600)


def test_a_signal_while_sockets_are_created_ends_the_start_up(monkeypatch, addresses):
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
        os.kill(made[0].process.pid, 0)


def accepted(mode: Mode) -> set[str]:
    return {name for name, each in COMMANDS.items() if mode in each.modes}


def test_stop_and_status_are_accepted_in_every_mode():
    assert all({"stop", "status"} <= accepted(mode) for mode in Mode)


def test_no_command_moves_a_hand_that_is_disarmed_or_has_a_fault():
    assert accepted(Mode.DISARMED) == {"arm", "demo", "disarm", "tare", "stop", "status"}
    assert accepted(Mode.FAULT) == {"clear", "stop", "status"}


def test_a_valid_request_is_parsed():
    request = {"command": "grasp", "force": 5, "client": "notebook"}
    assert parse(request, Mode.ARMED) == Command("grasp", {"force": 5.0}, "notebook")
    assert parse({"command": "grasp"}, Mode.HOLDING) == Command("grasp", {}, "")


@pytest.mark.parametrize(
    ("request_", "mode", "text"),
    [
        ({"command": "jump"}, Mode.ARMED, "unknown command 'jump'; expected one of arm, disarm"),
        ({"command": "grasp", "froce": 1.0}, Mode.ARMED, "unknown parameter 'froce'; expected fo"),
        ({"command": "arm", "force": 1.0}, Mode.DISARMED, "expected no parameters"),
        ({"command": "grasp", "force": "much"}, Mode.ARMED, "expected a number, found str"),
        ({"command": "grasp", "force": True}, Mode.ARMED, "expected a number, found bool"),
        ({"command": "grasp", "force": float("nan")}, Mode.ARMED, "finite number, found nan"),
        ({"command": "rotate"}, Mode.HOLDING, "rotate: angle is missing"),
        ({"command": "grasp"}, Mode.DISARMED, "grasp: not accepted in mode disarmed; arm first"),
        ({"command": "arm"}, Mode.FAULT, "arm: not accepted in mode fault; clear the fault first"),
        (
            {"command": "clear"},
            Mode.DISARMED,
            "clear: not accepted in mode disarmed; there is no fault",
        ),
        ({"command": "rotate", "angle": 0.1}, Mode.ARMED, "accepted in grasping, holding, r"),
        ({"command": "arm", "client": 7}, Mode.DISARMED, "client: expected a string"),
        ({"command": "arm", "client": "x" * 65}, Mode.DISARMED, "up to 64 characters"),
    ],
)
def test_an_invalid_request_is_refused_with_found_and_expected_values(request_, mode, text):
    with pytest.raises(Refused) as caught:
        parse(request_, mode)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("name", "mode", "oldest"),
    [
        ("arm", "disarmed", 0.2),
        ("tare", "disarmed", 1.0),
        ("move", "armed", 0.2),
        ("grasp", "armed", 0.2),
        ("hold", "armed", 0.2),
        ("hold", "holding", 1.0),
        ("grasp", "holding", 0.2),
        ("rotate", "holding", 0.2),
        ("set", "holding", 0.2),
        ("release", "holding", 0.2),
        ("disarm", "holding", 1.0),
        ("clear", "fault", 1.0),
    ],
)
def test_an_outdated_command_has_no_effect(make, name, mode, oldest):
    numbers = {"move": {"left": 0.3}, "rotate": {"angle": 0.02}, "set": {"compliance": 0.05}}
    numbers |= {"grasp": {"force": 6.0}, "hold": {"force": 6.0}}
    loop = make().loop
    if mode != "disarmed":
        loop.command({"command": "arm"})
        loop.advance(0.1)
    if mode == "holding":
        loop.command({"command": "grasp", "force": 5.0})
        loop.advance(3.0)
    elif mode == "fault":
        loop._fail("a fault")
    assert loop.state.mode == mode
    request = {"command": name, **numbers.get(name, {})}
    with pytest.raises(Refused, match="old when it was processed") as caught:
        loop.command(request, oldest + 0.01)
    assert caught.value.reason == "late"
    loop.advance(0.05)
    assert loop.state.mode == mode
    assert loop.command({"command": "status"}, 100.0)["mode"] == mode
    loop.command(request, oldest - 0.01)


def test_a_shorter_servo_watchdog_limits_the_age_of_motion_commands():
    def age(waits: bool = False, **servos: Any) -> float:
        return command_age_max(Settings.model_validate({"servos": servos}), waits)

    real = {"backend": "dynamixel", "port": "/dev/ttyUSB0"}
    assert age(**real, watchdog=0.1) == 0.1
    assert age(**real, watchdog=0.5) == age(**real, watchdog=0.0) == 0.2
    assert age(**real, watchdog=0.1, waits=True) == age(watchdog=0.1) == 0.2


def take(lease: Lease, command: Command, now: float) -> None:
    lease.check(command, now)
    lease.renew(command, now)


def test_a_refused_command_takes_no_lease():
    lease = Lease(2.0)
    lease.check(Command("grasp", {}, "a"), 0.0)
    take(lease, Command("grasp", {}, "b"), 0.1)


def test_only_one_client_commands_at_a_time():
    lease = Lease(2.0)
    take(lease, Command("arm", {}, "a"), 0.0)
    with pytest.raises(Refused, match=r"grasp: a holds the lease for another 1\.0 s"):
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
    with pytest.raises(Refused, match="an unnamed client holds the lease"):
        take(lease, Command("grasp", {}, "a"), 0.2)
