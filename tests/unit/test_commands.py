"""Command server and client on real sockets."""

from __future__ import annotations

import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon import assembly
from daemon.clock import VirtualClock
from daemon.commands import CommandServer, NoAnswer, Refused, decode, send
from daemon.settings import Settings
from daemon.sockets import AddressError, Guard
from daemon.stream import Publisher
from tests.conftest import until


def echo(request: dict[str, Any]) -> dict[str, Any]:
    if request["command"] == "no":
        raise Refused("not now")
    return {"heard": request["command"]}


@pytest.fixture
def server(context: zmq.Context[Any], addresses: tuple[str, str]) -> Iterator[CommandServer]:
    server = CommandServer(context, addresses[1], max_bytes=200)
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            server.serve(echo)

    thread = threading.Thread(target=serve)
    thread.start()
    yield server
    stop.set()
    thread.join()
    server.close()


def ask(address: str, payload: bytes) -> dict[str, Any]:
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(address)
    socket.send(payload)
    assert socket.poll(60_000)
    reply = msgpack.unpackb(socket.recv())
    socket.close()
    context.term()
    assert isinstance(reply, dict)
    return reply


def test_a_plain_req_socket_gets_its_answer(
    server: CommandServer, addresses: tuple[str, str]
) -> None:
    assert send(addresses[1], {"command": "arm"}) == {"ok": True, "heard": "arm"}
    assert send(addresses[1], {"command": "no"}) == {"ok": False, "error": "not now"}


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
def test_malformed_commands_are_refused_and_the_server_lives_on(
    server: CommandServer, addresses: tuple[str, str], payload: bytes, error: str
) -> None:
    reply = ask(addresses[1], payload)
    assert reply["ok"] is False
    assert error in reply["error"]
    assert ask(addresses[1], msgpack.packb({"command": "arm"}))["ok"] is True


def test_multipart_nonsense_and_clients_that_go_away_change_nothing(
    server: CommandServer, context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    socket = context.socket(zmq.DEALER)
    socket.connect(addresses[1])
    socket.send_multipart([b"", b"a", b"b", b"c"])  # no client's form: passed over
    socket.send(b"x" * 100_000)  # the connection is dropped before it is taken in
    socket.send(msgpack.packb({"command": "arm"}))
    socket.close(linger=1000)
    assert send(addresses[1], {"command": "arm"})["ok"] is True


def test_drain_answers_all_that_wait(context: zmq.Context[Any], addresses: tuple[str, str]) -> None:
    server = CommandServer(context, addresses[1], max_bytes=200)
    early = context.socket(zmq.REQ)
    early.connect(addresses[1])
    early.send(msgpack.packb({"command": "arm"}))
    until(lambda: server._bound.readable())
    server.drain(lambda _: {"heard": "late"})
    assert early.poll(60_000)
    assert msgpack.unpackb(early.recv()) == {"ok": True, "heard": "late"}
    assert not server.serve(echo)
    server.close()


def test_no_daemon_is_told_by_a_time_out(addresses: tuple[str, str]) -> None:
    with pytest.raises(NoAnswer, match="is softfinger running"):
        send(addresses[1], {"command": "arm"}, timeout=0.05)


values = st.one_of(st.none(), st.integers(0, 300), st.floats(allow_nan=False), st.text(max_size=5))
maps = st.dictionaries(st.text(max_size=5), values, max_size=3)


@given(
    st.one_of(
        st.binary(max_size=64),
        st.builds(lambda more, name: msgpack.packb({**more, "command": name}), maps, values),
    )
)
@settings(max_examples=300)
def test_any_bytes_are_decoded_or_refused(payload: bytes) -> None:
    try:
        request = decode(payload)
    except Refused:
        return
    assert isinstance(request["command"], str)
    assert request == msgpack.unpackb(payload)


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
def test_a_second_server_on_the_same_address_is_told(
    context: zmq.Context[Any],
    addresses: tuple[str, str],
    tmp_path_factory: pytest.TempPathFactory,
    transport: str,
) -> None:
    address = addresses[1]
    if transport == "ipc":
        address = f"ipc://{tmp_path_factory.mktemp('s')}/c"
    first = CommandServer(context, address, 200)
    with pytest.raises(AddressError, match="is another softfinger running"):
        CommandServer(context, address, 200)
    first.close()

    def free() -> bool:  # libzmq gives a port back in a thread of its own
        try:
            CommandServer(context, address, 200).close()
        except AddressError:
            return False
        return True

    until(free)


class Flood:
    """Clients that send without waiting for answers; nothing serves yet."""

    def __init__(self, context: zmq.Context[Any], address: str, clients: int, each: int) -> None:
        self.sockets = [context.socket(zmq.DEALER) for _ in range(clients)]
        for socket in self.sockets:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(address)
            for _ in range(each):
                socket.send(msgpack.packb({"command": "move"}))

    def replies(self) -> list[dict[str, Any]]:
        found = []
        for socket in self.sockets:
            while socket.poll(20):
                found.append(msgpack.unpackb(socket.recv()))
        return found


def arrived(server: CommandServer) -> bool:
    return server._bound.readable()


def test_a_stop_goes_before_all_that_waits(
    context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    server = CommandServer(context, addresses[1], max_bytes=200)
    flood = Flood(context, addresses[1], clients=4, each=40)
    until(lambda: arrived(server))
    order: list[str] = []

    def note(request: dict[str, Any]) -> dict[str, Any]:
        order.append(request["command"])
        return {}

    server.serve(note)  # the flood is being worked on
    stopper = context.socket(zmq.DEALER)
    stopper.setsockopt(zmq.LINGER, 0)
    stopper.connect(addresses[1])
    stopper.send_multipart([b"", msgpack.packb({"command": "stop"})])
    ticks = 0

    def stopped() -> bool:
        nonlocal ticks
        ticks += 1
        server.serve(note)
        return bool(stopper.poll(1))

    until(stopped)
    assert "stop" in order
    assert order.index("stop") < 160, "not behind all of the flood"
    assert not server._waiting, "nothing of before is carried out later"
    del flood
    server.close()


def test_what_was_sent_before_a_stop_is_refused_and_what_comes_after_is_not(
    context: zmq.Context[Any],
) -> None:
    server = CommandServer(context, "inproc://commands", max_bytes=200)  # all is there at once
    client = context.socket(zmq.DEALER)
    client.connect("inproc://commands")
    heard: list[str] = []

    def note(request: dict[str, Any]) -> dict[str, Any]:
        heard.append(request["command"])
        return {}

    for name in ("arm", "move", "stop"):
        client.send(msgpack.packb({"command": name}))
    while server.serve(note):
        pass
    assert heard == ["stop"]
    replies = [msgpack.unpackb(client.recv()) for _ in range(3)]
    assert [reply["ok"] for reply in replies] == [True, False, False]
    assert "a stop came before its turn" in replies[1]["error"]
    client.send(msgpack.packb({"command": "arm"}))
    assert server.serve(note)
    assert heard == ["stop", "arm"]
    client.close()
    server.close()


def test_a_client_that_sends_too_much_is_refused_and_others_are_not(
    context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    clock = VirtualClock()
    server = CommandServer(context, addresses[1], 200, per_second=20.0, now=clock.now)
    flood = Flood(context, addresses[1], clients=1, each=60)
    quiet = Flood(context, addresses[1], clients=1, each=3)
    replies: list[dict[str, Any]] = []
    kind: list[dict[str, Any]] = []

    def all_answered() -> bool:
        while server.serve(echo):
            pass
        replies.extend(flood.replies())
        kind.extend(quiet.replies())
        return server.refused_by_pace == 40 and len(kind) == 3

    until(all_answered)
    assert sum(reply["ok"] for reply in replies) == 20
    assert {reply.get("error") for reply in replies if not reply["ok"]} == {
        "too many commands: at most 20 a second"
    }
    assert all(reply["ok"] for reply in kind)
    # A second later it may send again.
    flood.sockets[0].send(msgpack.packb({"command": "move"}))
    clock.sleep_until(1.0)
    until(lambda: server.serve(echo))
    assert flood.replies() == [{"ok": True, "heard": "move"}]
    server.close()


def test_clients_that_flood_leave_others_a_place(
    context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    server = CommandServer(context, addresses[1], max_bytes=200, per_second=200.0)
    flood = Flood(context, addresses[1], clients=4, each=60)
    heard = []

    def note(request: dict[str, Any]) -> dict[str, Any]:
        heard.append(request["command"])
        return {}

    until(lambda: server.serve(note) and server.refused_by_pace > 10)  # no place is left
    other = context.socket(zmq.REQ)
    other.connect(addresses[1])
    other.send(msgpack.packb({"command": "grasp"}))
    until(lambda: [server.serve(note), other.poll(0)][1])
    assert msgpack.unpackb(other.recv())["ok"]
    assert flood.sockets
    assert len(heard) < 160, "it waited for more than those that were before it"
    other.close()
    server.close()


def test_what_many_clients_are_remembered_by_is_bounded(
    context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    server = CommandServer(context, addresses[1], max_bytes=200, per_second=2.0)
    for client in range(5000):
        assert server._in_pace(str(client).encode(), 0.0)
    assert len(server._paces) <= 256
    server.close()


@pytest.mark.parametrize("mode", [0o600, 0o660])
def test_an_ipc_file_has_the_rights_that_were_set(
    context: zmq.Context[Any], tmp_path_factory: pytest.TempPathFactory, mode: int
) -> None:
    folder = tmp_path_factory.mktemp("s")
    server = CommandServer(context, f"ipc://{folder}/c", 200, guard=Guard(mode))
    stream = Publisher(context, f"ipc://{folder}/s", 10, Guard(mode))
    for name in ("c", "s"):
        assert stat.S_IMODE(Path(f"{folder}/{name}").stat().st_mode) == mode
    assert stat.S_IMODE(Path(f"{folder}/c.lock").stat().st_mode) == 0o600
    server.close()
    stream.close()
    assert list(folder.iterdir()) == []


def test_a_signal_while_the_sockets_are_made_ends_the_start(
    monkeypatch: pytest.MonkeyPatch, addresses: tuple[str, str]
) -> None:
    made: list[zmq.Socket[Any]] = []

    def interrupted(context: zmq.Context[Any], *_: Any) -> None:
        made.append(context.socket(zmq.ROUTER))
        raise KeyboardInterrupt

    monkeypatch.setattr(assembly, "CommandServer", interrupted)
    wire = {"stream": {"address": addresses[0]}, "commands": {"address": addresses[1]}}
    with pytest.raises(KeyboardInterrupt):
        assembly.Daemon(Settings.model_validate(wire))
    assert made[0].closed
