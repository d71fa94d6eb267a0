"""The stream for Foxglove: its WebSocket server, by the ``foxglove-sdk``, behind a `Door`.

Channels have the names and fields of recordings (`tools.recordings.channels`), so that one layout
shows both; ``hand/scene``, the moving hand, is made here. What nobody subscribes to isn't packed.
"""

from __future__ import annotations

import argparse
import math
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foxglove
import foxglove.messages as fm
import orjson
from foxglove.channels import LogChannel, RawImageChannel, SceneUpdateChannel

from softfinger.daemon.client.stream import read
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.ending import Ending
from softfinger.tools.recordings.channels import schema_of
from softfinger.tools.terminal.feed import number, text
from softfinger.tools.viewing import planar
from softfinger.tools.viewing.door import Door, hidden_host
from softfinger.tools.viewing.live_stream import LOOPBACK, NICE, Viewer, ViewError, follow
from softfinger.tools.viewing.planar import Colour

LAYOUT = Path(__file__).with_name("foxglove_layout.json")
SCENE = "hand/scene"
_NUMBERS = (schema.STATE, schema.TRUTH, schema.STATS)  # sent whole, as JSON
_FRAME = "hand"  # x from the left pivot to the right one, y away from the palm [m]
_EVENTS = 50  # kept for the first who looks at them, as many as the daemon repeats
_LEVELS = {"info": fm.LogLevel.Info, "warning": fm.LogLevel.Warning, "error": fm.LogLevel.Error}


class FoxgloveServer(Viewer):
    """Takes messages and serves them on ``port``, 0 for a free one. Raises ViewError."""

    def __init__(self, port: int, say: Callable[[str], None]) -> None:
        super().__init__(say)
        context = self._context = foxglove.Context()  # its end closes the channels
        self._numbers = {topic: _channel(topic, context) for topic in _NUMBERS}
        self._log = LogChannel(schema.EVENT.decode(), context=context)
        self._scene = SceneUpdateChannel(SCENE, context=context)
        self._images = {
            name: RawImageChannel(f"{schema.TACTILE.decode()}/{name}", context=context)
            for name in FINGERS
        }
        self._frames: dict[str, dict[str, Any]] = {}  # by finger
        self._events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        host = hidden_host()
        try:
            self._server = foxglove.start_server(
                name="softfinger", host=host, port=0, context=context
            )
        except RuntimeError as error:
            raise ViewError(f"Foxglove's server: {error}") from None
        try:
            self._door = Door(port, (host, self._server.port))
        except OSError as error:
            self._server.stop()
            raise ViewError(f"port {port}: {error.strerror}") from None
        self.address = f"ws://{LOOPBACK}:{self._door.port}"

    def close(self) -> None:
        self._door.close()
        self._server.stop()

    def take(self, topic: bytes, message: Any) -> bool:
        """Take one message of any content."""
        if not super().take(topic, message):
            return False
        if topic == schema.TACTILE:
            self._frames[text(message, "finger")] = message
        elif topic == schema.EVENT:
            self._events.append(message)
        elif topic in self._numbers and self._numbers[topic].has_sinks():
            try:
                data = orjson.dumps(message)  # null for NaN
                self._numbers[topic].log(data, log_time=_ns(number(message, "timestamp")))
            except TypeError:  # orjson's error, too: JSON can't hold it
                self.unreadable += 1
        return True

    def draw(self) -> None:
        """Send the newest frames, the scene, and events if somebody looks at them."""
        for message in self._frames.values():
            try:
                self._image(read(schema.TactileFrame, message))
            except (ValueError, KeyError):
                self.unreadable += 1
        self._frames.clear()
        state, truth = self.newest.pop(schema.STATE, None), self.newest.get(schema.TRUTH)
        if state is not None and self._scene.has_sinks():
            parts = planar.hand_parts(self.hand, read(schema.HandState, state), truth)
            entities = [_entity(name, part) for name, part in parts.items()]
            self._scene.log(fm.SceneUpdate(entities=entities), log_time=_ns(self.time))
        while self._log.has_sinks() and self._events:
            self._event(self._events.popleft())

    def _image(self, frame: schema.TactileFrame) -> None:
        self._images[frame.finger].log(
            fm.RawImage(
                timestamp=fm.Timestamp.from_epoch_secs(frame.timestamp),
                frame_id=frame.finger,
                width=frame.cols,
                height=frame.rows,
                encoding="mono16",
                step=2 * frame.cols,
                data=frame.data,
            ),
            log_time=_ns(frame.timestamp),
        )

    def _event(self, event: dict[str, Any]) -> None:
        stamp = number(event, "timestamp")
        line = fm.Log(
            timestamp=fm.Timestamp.from_epoch_secs(stamp),
            level=_LEVELS.get(text(event, "level"), fm.LogLevel.Unknown),
            message=text(event, "text"),
            name=text(event, "kind"),
        )
        now = stamp if math.isnan(self.time) else max(stamp, self.time)
        self._log.log(line, log_time=_ns(now))


def _entity(name: str, part: planar.HandPart) -> fm.SceneEntity:
    lines = [
        fm.LinePrimitive(
            type=fm.LinePrimitiveLineType.LineStrip,
            thickness=1e-3 * strip.width,
            points=[fm.Point3(x=float(x), y=float(y)) for x, y in strip.points],
            color=_colour(strip.colour),
        )
        for strip in part.strips
    ]
    arrows, texts = [], []
    for push in part.pushes:
        length, half = math.hypot(*push.way), 0.5 * math.atan2(push.way[1], push.way[0])
        arrows.append(
            fm.ArrowPrimitive(
                pose=_pose(push.at, fm.Quaternion(z=math.sin(half), w=math.cos(half))),
                shaft_length=0.75 * length,
                shaft_diameter=1.8e-3,
                head_length=0.25 * length,
                head_diameter=4e-3,
                color=_colour(push.colour),
            )
        )
        texts.append(
            fm.TextPrimitive(
                pose=_pose(push.at + push.way, fm.Quaternion(w=1.0)),
                billboard=True,
                font_size=12.0,
                scale_invariant=True,
                color=_colour(push.colour),
                text=push.text,
            )
        )
    return fm.SceneEntity(id=name, frame_id=_FRAME, lines=lines, arrows=arrows, texts=texts)


def _pose(place: planar.FloatArray, turn: fm.Quaternion) -> fm.Pose:
    return fm.Pose(position=fm.Vector3(x=float(place[0]), y=float(place[1])), orientation=turn)


def _colour(colour: Colour) -> fm.Color:
    red, green, blue = (part / 255.0 for part in colour)
    return fm.Color(r=red, g=green, b=blue, a=1.0)


def _channel(topic: bytes, context: foxglove.Context) -> foxglove.Channel:
    name, described = schema_of(topic)
    form = foxglove.Schema(name=name, encoding="jsonschema", data=orjson.dumps(described))
    return foxglove.Channel(topic.decode(), message_encoding="json", schema=form, context=context)


def _ns(stamp: float) -> int:
    return int(stamp * 1e9)


def serve(arguments: argparse.Namespace, ending: Ending) -> None:
    """Serve the stream until the end. Raises SoftfingerError."""
    keys = client_keys(arguments.keys)
    say = to_stderr("view")
    server = FoxgloveServer(arguments.foxglove, say)
    os.nice(NICE)
    try:
        print(f"view: {server.address} for Foxglove; layout: {LAYOUT}", flush=True)
        ending.begin()
        follow(arguments, keys, server, ending, say)
    finally:
        server.close()
    if server.states == 0:
        raise ViewError(f"{arguments.address}: nothing came that can be shown")
