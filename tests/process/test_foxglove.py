"""Test the messages and the access control of ``softfinger view --foxglove``."""

import base64
import json
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import psutil
import pytest
from websockets import Subprotocol
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from softfinger.daemon.client.stream import read
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.tools import cli
from softfinger.tools.viewing.foxglove_server import CLIENT_COUNT_MAX, PROTOCOLS
from softfinger.tools.viewing.hand_drawing import hand_parts
from tests.conftest import until
from tests.harness.daemon_process import started
from tests.harness.fake_daemon import FakeDaemon, event, frame, state
from tests.harness.viewed import WAIT, masked, upgrade_request
from tests.process.test_untrusted_clients import place

TOPICS = {
    "hand/state": "hand.state",
    "hand/truth": "hand.truth",
    "hand/stats": "hand.stats",
    "hand/event": "foxglove.Log",
    "hand/scene": "foxglove.SceneUpdate",
    "hand/tactile/left": "foxglove.RawImage",
    "hand/tactile/right": "foxglove.RawImage",
}


class Client:
    """Foxglove client that subscribes to channels and receives messages."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        welcome, advertised = (json.loads(socket.recv(timeout=WAIT)) for _ in range(2))
        assert (welcome["op"], advertised["op"]) == ("serverInfo", "advertise")
        self.channels = {channel["topic"]: channel for channel in advertised["channels"]}
        self._topics = {channel["id"] + 70: topic for topic, channel in self.channels.items()}

    def subscribe(self, *topics: str) -> None:
        numbers = [self.channels[topic]["id"] for topic in topics]
        wanted = [{"id": number + 70, "channelId": number} for number in numbers]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def unsubscribe(self, topic: str) -> None:
        ended = [self.channels[topic]["id"] + 70]
        self.socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": ended}))

    def next(self, topic: str = "") -> tuple[str, float, dict[str, Any]]:
        """Return topic, log time [s] and content of the next message, optionally of ``topic``."""
        while True:
            message = self.socket.recv(timeout=WAIT)
            assert isinstance(message, bytes)
            kind, number, stamp = struct.unpack_from("<BIQ", message)
            assert kind == 1
            if self._topics[number] == topic or not topic:
                return self._topics[number], 1e-9 * stamp, json.loads(message[13:])


@contextmanager
def served(fake: FakeDaemon) -> Iterator[tuple[str, Path]]:
    """Yield the address of a Foxglove server for the stream, and the path of the layout."""
    process = started("view", "--foxglove", "0", "--address", fake.state_address, stderr=None)
    try:
        line = process.stdout.readline()
        yield line.split()[1], Path(line.split("layout: ")[1].strip())
    finally:
        process.terminate()
        process.communicate(timeout=300)
    assert process.returncode == 0


def connected(address: str, **more: Any) -> ClientConnection:
    waits: Any = {"open_timeout": WAIT, "ping_timeout": None, "proxy": None}
    return connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], **waits, **more)


def test_a_client_reads_every_channel_of_the_running_hand() -> None:
    with FakeDaemon() as fake:
        fake.changes = {"goal_force": float("nan")}
        with served(fake) as (address, layout), connected(address) as line:
            assert used_topics(json.loads(layout.read_text())) <= set(TOPICS)
            assert line.subprotocol == PROTOCOLS[0]
            client = Client(line)
            client.subscribe(*(topic for topic in TOPICS if topic != "hand/event"))
            check_numbers(client)
            check_pictures(client)
            check_scene(client)
            early = event(1, "start", "before anybody looked", "warning")
            fake.send(schema.EVENT, msgpack.packb(early))
            published = fake.published
            until(lambda: client.next("hand/state")[2]["seq"] > 5 * published + 100)
            client.subscribe("hand/event")
            _, _, log = client.next("hand/event")
            assert (log["level"], log["message"], log["name"]) == (3, early["text"], "start")
            assert log["timestamp"]["sec"] == int(early["timestamp"])
            client.unsubscribe("hand/state")
            client.subscribe("hand/event")  # An event arrives once the subscription is active.
            client.next("hand/event")
            rest: set[str] = set()
            until(lambda: rest.update(client.next()[0] for _ in range(30)) or len(rest) >= 3)
            assert rest == {"hand/scene", "hand/tactile/left", "hand/tactile/right"}


def used_topics(layout: Any) -> set[str]:
    """Return all topics that a layout uses."""
    if isinstance(layout, dict):
        return set().union(*map(used_topics, layout.values()))
    if isinstance(layout, list):
        return set().union(*map(used_topics, layout))
    named = isinstance(layout, str) and layout.startswith("hand/")
    return {layout.split(".")[0]} if named else set()


def check_numbers(client: Client) -> None:
    assert {name: each["schemaName"] for name, each in client.channels.items()} == TOPICS
    channel = client.channels["hand/state"]
    described = json.loads(channel["schema"])["properties"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
    _, stamp, message = client.next("hand/state")
    expected = state(0.0, 0)
    assert message.keys() == expected.keys() == described.keys()
    assert message["left"].keys() == expected["left"].keys()
    assert 8.0 <= message["left"]["force"] <= 12.0
    assert message["goal_force"] is None  # JSON cannot represent NaN.
    assert stamp == pytest.approx(message["timestamp"], abs=1e-6)


def check_pictures(client: Client) -> None:
    for side, finger in enumerate(("left", "right")):
        _, stamp, image = client.next(f"hand/tactile/{finger}")
        described = json.loads(client.channels[f"hand/tactile/{finger}"]["schema"])["properties"]
        assert described["data"]["contentEncoding"] == "base64"
        assert (image["width"], image["height"], image["step"]) == (44, 44, 88)
        assert image["encoding"] == "mono16"
        when = image["timestamp"]["sec"] + 1e-9 * image["timestamp"]["nsec"]
        assert when == pytest.approx(stamp, abs=1e-6)
        counts = np.frombuffer(base64.b64decode(image["data"]), "<u2")
        like = np.frombuffer(frame(0.0, side)["data"], "<u2")
        assert int(counts.max()) == pytest.approx(int(like.max()), rel=0.3)


def check_scene(client: Client) -> None:
    _, _, scene = client.next("hand/scene")
    named = {entity["id"]: entity for entity in scene["entities"]}
    assert list(named) == ["palm", "left", "right", "object", "simulated"]
    for finger in ("left", "right"):
        assert len(named[finger]["lines"]) == 5  # link, base, skin, face and force
        (label,) = (text["text"] for text in named[finger]["texts"])
        assert 8.0 <= float(label.removesuffix(" N")) <= 12.0
    (outline,) = named["object"]["lines"]
    points = np.array([[each["x"], each["y"]] for each in outline["points"]])
    (expected,) = hand_parts(Settings(), read(schema.HandState, state(0.0, 0)))["object"].lines
    assert points == pytest.approx(expected[2], abs=6e-3)  # The object rotates by at most 5°.


@pytest.fixture(scope="module")
def stranger() -> Iterator[tuple[FakeDaemon, str]]:
    """Yield a fake daemon and the address of its Foxglove server."""
    with FakeDaemon() as fake, served(fake) as (address, _):
        # Connect once; otherwise, the server warns at exit that no state has arrived.
        with connected(address) as line:
            client = Client(line)
            client.subscribe("hand/state")
            client.next("hand/state")
        yield fake, address


@pytest.mark.parametrize(
    "fields", [{"origin": "https://app.foxglove.dev"}, {"origin": "file://"}, {}]
)
def test_pages_of_this_machine_and_foxglove_are_accepted(stranger, fields):
    with connected(stranger[1], **fields) as line:
        assert Client(line).channels.keys() == TOPICS.keys()


@pytest.mark.parametrize(
    "fields",
    [
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": "file://", "additional_headers": {"Origin": "https://evil.example"}},
        {"additional_headers": {"Host": "rebound.example"}},
    ],
)
def test_all_other_pages_are_refused(stranger, fields):
    with pytest.raises(InvalidStatus, match="403"):
        connected(stranger[1], **fields)


def connections(address: str) -> int:
    """Return the number of connections held by the server at ``address``."""
    port = int(address.rpartition(":")[2])
    (server,) = {
        each.pid
        for each in psutil.net_connections("tcp")
        if each.laddr.port == port and each.status == psutil.CONN_LISTEN
    }
    held = psutil.Process(server).net_connections("tcp")
    return sum(each.laddr.port == port and each.status != psutil.CONN_LISTEN for each in held)


@pytest.mark.extended
def test_a_client_that_does_not_read_is_dropped_for_another(stranger):
    fake, address = stranger
    fake.changes = {"fault": "x" * 30_000}  # Large states fill the buffers quickly.
    with ExitStack() as stack:
        lazy = []
        for _ in range(CLIENT_COUNT_MAX):
            host = address.removeprefix("ws://")
            client = stack.enter_context(socket.create_connection(place(host), timeout=WAIT))
            client.sendall(upgrade_request(host, "/"))
            answer = b""
            while b'"advertise"' not in answer:
                part = client.recv(65536)
                assert part, "the server has closed the connection"
                answer += part
            lazy.append(client)
        with connected(address) as late, pytest.raises(ConnectionClosed):
            late.recv(timeout=WAIT)
        for client in lazy:
            for channel in range(len(TOPICS)):
                wanted = {"subscriptions": [{"id": 1, "channelId": channel}]}
                client.sendall(masked(json.dumps(wanted)))
        until(lambda: connections(address) < CLIENT_COUNT_MAX)
        with connected(address) as line:
            Client(line)  # The server must accept a new client.


def test_incomplete_and_invalid_requests_are_closed(stranger):
    _, address = stranger
    with socket.create_connection(place(address.removeprefix("ws://")), timeout=WAIT) as client:
        client.sendall(b"GET / HTTP/1.1\r\n")  # The header is incomplete.
        assert client.recv(100) == b""
    for odd in ("{", "[]", '{"op": 3}x', '"id": 1, "channelId": 99', '"id": NaN, "channelId": 0'):
        with connected(address) as line:
            Client(line)
            line.send(f'{{"subscriptions": [{{{odd}}}]}}' if odd[0] == '"' else odd)
            with pytest.raises(ConnectionClosed):
                line.recv(timeout=WAIT)


def test_foxglove_requires_the_live_stream(capsys):
    assert cli.main(["view", "run.mcap", "--foxglove"]) == 2
    assert "only the live stream can be served" in capsys.readouterr().err
