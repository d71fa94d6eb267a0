"""Serve the stream to Foxglove via its WebSocket protocol (foxglove/ws-protocol, version 1).

Recordings use the same channel names, schemas and messages (`tools.recordings.channels`). One
Foxglove layout therefore works for the stream and for recordings. The additional channel
``hand/scene`` contains a drawing of the moving hand. Messages that no client has subscribed to are
not packed.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import orjson
from websockets import Subprotocol
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.recordings import channels
from softfinger.tools.terminal.stream_state import number
from softfinger.tools.viewing.hand_drawing import COLOURS, DrawnPart, hand_parts

LAYOUT = Path(__file__).with_name("foxglove_layout.json")
# Origins of Foxglove's web and desktop applications.
ORIGINS = ("https://app.foxglove.dev", "file://")
PROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))
CLIENT_COUNT_MAX = 8
SCENE = "hand/scene"
_FRAME = "hand"  # coordinate frame [m]: x from the left to the right pivot, y away from the palm
_LIST = {"type": "array", "items": {"type": "object", "properties": {}}}
_ENTITIES = {"type": "object", "properties": {"deletions": _LIST, "entities": _LIST}}
_HEAD = struct.Struct("<BIQ")  # message header with kind, subscription and time [ns]
_EVENT_COUNT = 50  # number of events stored for new subscribers, as in the daemon
_QUEUE_LENGTH = 500  # maximum number of messages queued for a client; excess messages are dropped
_SEND_TIMEOUT = 2.0  # timeout for a client to accept a message [s]


class _Client:
    """A client's subscriptions by channel, and the messages queued for the client."""

    def __init__(self) -> None:
        self.subscribed: dict[str, int] = {}
        self.queue: asyncio.Queue[bytes] = asyncio.Queue(_QUEUE_LENGTH)

    def give(self, channel: str, stamp: float, data: bytes) -> None:
        """Queue a message if the client has subscribed to its channel and the queue is not full."""
        if channel in self.subscribed and not self.queue.full():
            head = _HEAD.pack(1, self.subscribed[channel], int(stamp * 1e9))
            self.queue.put_nowait(head + data)

    async def send(self, socket: ServerConnection) -> None:
        """Send queued messages, and disconnect the client if it does not read them."""
        try:
            while True:
                message = await self.queue.get()
                async with asyncio.timeout(_SEND_TIMEOUT):
                    await socket.send(message)
        except (TimeoutError, ConnectionClosed):
            socket.transport.abort()


class Foxglove:
    """Server that runs in the event loop ``loop``. Another thread supplies messages and scenes."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._clients: list[_Client] = []
        self._events: deque[tuple[float, bytes]] = deque(maxlen=_EVENT_COUNT)
        self._frames: dict[str, dict[str, Any]] = {}  # newest frame of each channel
        tactile = schema.TACTILE.decode()
        described = {SCENE: ("foxglove.SceneUpdate", _ENTITIES)}
        described |= {f"{tactile}/{name}": channels.schema_of(schema.TACTILE) for name in FINGERS}
        for topic in (schema.STATE, schema.TRUTH, schema.STATS, schema.EVENT):
            described[topic.decode()] = channels.schema_of(topic)
        self._channels = list(described)  # channel names, indexed by channel number
        coded = {"encoding": channels.ENCODING, "schemaEncoding": channels.SCHEMA_ENCODING}
        advertised = [
            {"id": number, "topic": topic, "schemaName": name, "schema": json.dumps(form)} | coded
            for number, (topic, (name, form)) in enumerate(described.items())
        ]
        self._welcome = [
            json.dumps({"op": "serverInfo", "name": "softfinger", "capabilities": []}),
            json.dumps({"op": "advertise", "channels": advertised}),
        ]

    async def serve(self, socket: ServerConnection) -> None:
        """Serve one client until it disconnects, stops reading or sends an invalid request."""
        if len(self._clients) == CLIENT_COUNT_MAX:
            return
        client = _Client()
        self._clients.append(client)
        sending = asyncio.create_task(client.send(socket))
        try:
            for text in self._welcome:
                await socket.send(text)
            async for request in socket:
                self._subscribe(client, json.loads(request))
        except (ValueError, LookupError, TypeError, AttributeError):
            pass
        finally:
            sending.cancel()
            self._clients.remove(client)

    def _subscribe(self, client: _Client, asked: dict[str, Any]) -> None:
        for each in asked.get("subscriptions", ()):
            channel = self._channels[each["channelId"]]
            client.subscribed[channel] = int(each["id"] % 2**32)
            if channel == schema.EVENT.decode():
                for event in self._events:
                    client.give(channel, *event)
        ended = asked.get("subscriptionIds", ())
        kept = {name: each for name, each in client.subscribed.items() if each not in ended}
        client.subscribed = kept

    def take(self, topic: bytes, message: dict[str, Any]) -> None:
        """Process one stream message; frames are stored until `draw` is called."""
        channel = channels.channel_name(topic, message)
        if topic == schema.TACTILE:
            self._frames[channel] = message
        else:
            self._send(channel, number(message, "timestamp"), message, topic)

    def draw(self, settings: Settings, state: HandState, truth: dict[str, Any] | None) -> None:
        """Send the newest frames and the hand's current scene."""
        for channel, frame in self._frames.items():
            self._send(channel, number(frame, "timestamp"), frame, schema.TACTILE)
        self._frames.clear()
        if self._wanted(SCENE):
            parts = hand_parts(settings, state, truth).items()
            entities = [_entity(name, part, state.timestamp) for name, part in parts]
            self._send(SCENE, state.timestamp, {"deletions": [], "entities": entities})

    def _wanted(self, channel: str) -> bool:
        return any(channel in client.subscribed for client in self._clients)

    def _send(
        self, channel: str, stamp: float, message: dict[str, Any], topic: bytes = b""
    ) -> None:
        keeps = topic == schema.EVENT
        if not keeps and not self._wanted(channel):
            return
        try:
            data = orjson.dumps(channels.to_json(topic, dict(message)))  # NaN becomes null.
        except TypeError:  # orjson raises TypeError for values that JSON cannot represent.
            return
        self._loop.call_soon_threadsafe(partial(self._give, channel, stamp, data, keeps))

    def _give(self, channel: str, stamp: float, data: bytes, keeps: bool) -> None:
        for client in self._clients:
            client.give(channel, stamp, data)
        if keeps:
            self._events.append((stamp, data))


def _entity(name: str, part: DrawnPart, stamp: float) -> dict[str, Any]:
    lines = [
        {"type": 0, "pose": _pose(0.0, 0.0), "thickness": width, "scale_invariant": False}
        | {"points": [_point(x, y) for x, y in points.tolist()], "color": _colour(colour)}
        | {"colors": [], "indices": []}
        for colour, width, points in part.lines
    ]
    texts = [
        {"pose": _pose(*place.tolist()), "billboard": True, "font_size": 12.0}
        | {"scale_invariant": True, "color": _colour(colour), "text": words}
        for colour, place, words in part.texts
    ]
    others = ("metadata", "arrows", "cubes", "spheres", "cylinders", "triangles", "models")
    return (
        {"timestamp": channels.stamp(stamp), "frame_id": _FRAME, "id": name, "frame_locked": False}
        | {"lifetime": {"sec": 0, "nsec": 0}, "lines": lines, "texts": texts}
        | {other: [] for other in others}
    )


def _point(x: float, y: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": 0.0}


def _pose(x: float, y: float) -> dict[str, Any]:
    return {"position": _point(x, y), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def _colour(name: str) -> dict[str, float]:
    return dict(zip("rgb", (part / 255.0 for part in COLOURS[name]), strict=True)) | {"a": 1.0}
