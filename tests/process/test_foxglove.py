"""``softfinger view --foxglove``: what a client of Foxglove's protocol reads from it."""

import json
import struct
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import psutil
import pytest
from websockets.sync.client import ClientConnection, connect

from softfinger.daemon.client.stream import read
from softfinger.daemon.wire import schema
from softfinger.tools import cli
from softfinger.tools.viewing.known import ShownHand
from softfinger.tools.viewing.planar import SPRINGS, hand_parts
from tests.harness.daemon_process import started
from tests.harness.fake_daemon import FakeDaemon, event, frame, state

TOPICS = {
    "hand/state": "hand.state",
    "hand/truth": "hand.truth",
    "hand/stats": "hand.stats",
    "hand/event": "foxglove.Log",
    "hand/scene": "foxglove.SceneUpdate",
    "hand/tactile/left": "foxglove.RawImage",
    "hand/tactile/right": "foxglove.RawImage",
}
WAIT = 60.0  # s for one message


def fields(message: bytes) -> dict[int, list[Any]]:
    """A protobuf message's fields by their numbers: integers, doubles, or bytes."""
    found: dict[int, list[Any]] = {}
    place = 0

    def varint() -> int:
        nonlocal place
        value = shift = 0
        while True:
            byte = message[place]
            place += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while place < len(message):
        key = varint()
        if key & 7 == 0:
            found.setdefault(key >> 3, []).append(varint())
            continue
        size = {1: 8, 5: 4}.get(key & 7) or varint()
        part = message[place : place + size]
        place += size
        code = {1: "<d", 5: "<I"}.get(key & 7)
        found.setdefault(key >> 3, []).append(struct.unpack(code, part)[0] if code else part)
    return found


class Client:
    """Subscribes to channels; ``next`` is a channel's next message, with its log time [s]."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < len(TOPICS):
            message = json.loads(self.socket.recv(timeout=WAIT))
            for channel in message.get("channels", ()):
                self.channels[channel["topic"]] = channel
        self._topics = {channel["id"]: topic for topic, channel in self.channels.items()}

    def subscribe(self, *topics: str) -> None:
        numbers = [self.channels[topic]["id"] for topic in topics]
        wanted = [{"id": number, "channelId": number} for number in numbers]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def next(self, topic: str) -> tuple[float, bytes]:
        while True:
            message = self.socket.recv(timeout=WAIT)
            if isinstance(message, bytes) and message[0] == 1:
                number, stamp = struct.unpack_from("<IQ", message, 1)
                if self._topics[number] == topic:
                    return 1e-9 * stamp, message[13:]


def test_a_client_reads_every_channel_of_the_running_hand() -> None:
    with FakeDaemon() as fake:
        words = ["view", "--foxglove", "0", "--address", fake.state_address]
        process = started(*words, stderr=None)
        try:
            line = process.stdout.readline()
            address, layout = line.split()[1], Path(line.split("layout: ")[1].strip())
            assert used_topics(json.loads(layout.read_text())) <= set(TOPICS)
            listening = psutil.Process(process.pid).net_connections()
            hosts = [each.laddr.ip for each in listening if each.status == "LISTEN"]
            assert "127.0.0.1" in hosts
            assert all(host.startswith("127.") for host in hosts)
            fake.changes = {"goal_force": float("nan")}
            waits: Any = {"open_timeout": WAIT, "ping_timeout": None}
            with connect(address, subprotocols=["foxglove.sdk.v1"], proxy=None, **waits) as socket:
                client = Client(socket)
                client.subscribe(*(topic for topic in TOPICS if topic != "hand/event"))
                check_numbers(client)
                check_pictures(client)
                check_scene(client)
                early = event(1, "start", "before anybody looked", "warning")
                fake.send(schema.EVENT, msgpack.packb(early))
                sent, newer = time.time(), 0
                while newer < 2:  # the second of these was published after it, so taken after it
                    newer += client.next("hand/state")[0] > sent
                client.subscribe("hand/event")
                check_events(client, early)
        finally:
            process.terminate()
            process.communicate(timeout=300)
    assert process.returncode == 0


def used_topics(layout: Any) -> set[str]:
    """All topics that a layout names."""
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
    stamp, payload = client.next("hand/state")
    message = json.loads(payload)
    expected = state(0.0, 0)
    assert message.keys() == expected.keys() == described.keys()
    assert message["left"].keys() == expected["left"].keys()
    assert 8.0 <= message["left"]["force"] <= 12.0
    assert message["goal_force"] is None  # NaN, which JSON lacks
    assert stamp == pytest.approx(message["timestamp"], abs=1e-6)


def check_pictures(client: Client) -> None:
    for side, finger in enumerate(("left", "right")):
        stamp, payload = client.next(f"hand/tactile/{finger}")
        image = fields(payload)
        (width,), (height,), (encoding,), (step,), (data,) = (image[k] for k in (2, 3, 4, 5, 6))
        assert (width, height, encoding, step) == (44, 44, b"mono16", 88)
        seconds = fields(image[1][0])
        assert seconds[1][0] + 1e-9 * seconds[2][0] == pytest.approx(stamp, abs=1e-6)
        counts = np.frombuffer(data, "<u2")
        like = np.frombuffer(frame(0.0, side)["data"], "<u2")
        assert int(counts.max()) == pytest.approx(int(like.max()), rel=0.3)


def check_scene(client: Client) -> None:
    _, payload = client.next("hand/scene")
    entities = [fields(each) for each in fields(payload)[2]]
    named = {each[3][0].decode(): each for each in entities}
    assert list(named) == ["palm", "left", "right", "object", "simulated"]
    for finger in ("left", "right"):
        assert len(named[finger][11]) == 5 + SPRINGS  # link, base, skin, springs, face, normal
        (label,) = (fields(text)[6][0].decode() for text in named[finger][13])
        assert 8.0 <= float(label.removesuffix(" N")) <= 12.0
        (arrow,) = map(fields, named[finger][7])
        assert 0.0 < arrow[2][0] < 0.045
    (outline,) = map(fields, named["object"][11])
    points = np.array([[fields(each).get(k, [0.0])[0] for k in (1, 2)] for each in outline[5]])
    expected = hand_parts(ShownHand(), read(schema.HandState, state(0.0, 0)))["object"]
    assert points == pytest.approx(expected.strips[0].points, abs=6e-3)  # it turns by 5° at most


def check_events(client: Client, early: dict[str, Any]) -> None:
    _, payload = client.next("hand/event")
    line = fields(payload)
    assert (line[2], line[3], line[4]) == ([3], [early["text"].encode()], [b"start"])
    assert fields(line[1][0])[1] == [int(early["timestamp"])]


def test_foxglove_is_for_the_stream_alone(capsys):
    assert cli.main(["view", "run.mcap", "--foxglove"]) == 2
    assert "--foxglove serves the stream alone" in capsys.readouterr().err
