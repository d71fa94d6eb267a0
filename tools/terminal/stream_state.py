"""Collect data from the daemon's sockets for display on a live page.

The contents of messages are not trusted. Fields that are missing or have the wrong type become NaN
or empty. Messages that cannot be decoded are counted and skipped.
"""

from __future__ import annotations

import json
import logging
import math
import time
from bisect import insort
from collections import deque
from collections.abc import Callable
from queue import Full, Queue
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.command_client import (
    LOCAL_STOP_TIMEOUT,
    UNCONFIRMED_TEXT,
    NoAnswer,
    send,
)
from softfinger.daemon.client.connection import REPLY_TIMEOUT, drain, unpack
from softfinger.daemon.client.stream import Gaps, read
from softfinger.daemon.types import FINGERS, GRIP_FRACTION, NO_LEASE_COMMANDS
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys

RECENT_TIME = 3.0  # period over which a simulated hand's pauses are summed [s]
EVENT_COUNT_MAX = 200  # number of stored events
GLOSSARY = (  # meanings of the terms on the pages
    ("d", "displacement of the tip by the object's face"),
    ("θ", "tilt of the object's face relative to the tip"),
    ("force", "F(d, θ), contact force on the tip, normal to the face"),
    ("energy", "U(d, θ), elastic energy in the tip"),
    ("±", "one standard deviation"),
    ("map age", "age of the newest pressure map"),
    ("joint, goal", "current and goal angle; positive when closing"),
    ("current, bound", "motor current and its limit in the latest goal"),
    ("object", "angle and width of the object between the tips"),
)
# Ratio of goal force to commanded force above which the page reports a force increase.
_INCREASED_RATIO = 1.01
# Maximum number of messages read per call, so that a flood of messages cannot block drawing.
DRAIN_COUNT_MAX = 4000
INVALID = (ValueError, TypeError, RecursionError)  # raised by `StreamState.process`


def field(record: object, *path: str) -> Any:
    """Return the value at ``path`` in nested maps, or None if it is missing."""
    for key in path:
        if not isinstance(record, dict):
            return None
        record = record.get(key)
    return record


def number(record: object, *path: str) -> float:
    """Return the number at ``path``, or NaN if it is missing."""
    value = field(record, *path)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return math.nan


def text(record: object, *path: str) -> str:
    """Return the string at ``path``, without terminal control characters."""
    value = field(record, *path)
    return printable(value) if isinstance(value, str) else ""


def printable(value: str) -> str:
    """Return ``value`` as one line without terminal control sequences."""
    return "".join(c if c.isprintable() else " " for c in value)


class ShownFrame(NamedTuple):
    """Tactile frame, prepared for drawing."""

    arrived: float  # monotonic time [s]
    scale: float  # Pa per count, or NaN if unknown
    grid: NDArray[np.float64]  # pressures in Pa, or in counts if the scale is unknown; [rows, cols]
    aspect: float  # cell height divided by cell width
    source: schema.TactileFrame


class ShownEvent(NamedTuple):
    """A single ``hand/event`` message, prepared for drawing."""

    timestamp: float  # Unix time [s], or NaN if unknown
    level: str
    kind: str
    text: str

    def clock(self) -> str:
        """Return the local time of day."""
        try:
            return time.strftime("%H:%M:%S", time.localtime(self.timestamp))
        except (ValueError, OverflowError, OSError):
            return "--:--:--"


class StreamState:
    """Process stream messages and store the data that a page shows.

    In all methods ``now`` is monotonic time [s]. ``events`` are sorted by time of occurrence,
    whereas `news` returns events in the order of arrival. After a late subscription, the order of
    arrival differs from the order of occurrence.
    """

    def __init__(self) -> None:
        self.state = read(schema.HandState, None)
        self.state_time = -math.inf
        self.mode = self.fault = ""  # mode and fault of the last state
        self.frames: dict[str, ShownFrame] = {}
        self.events: list[ShownEvent] = []
        self._news: deque[ShownEvent] = deque(maxlen=EVENT_COUNT_MAX)
        self.gaps = {topic: Gaps() for topic in schema.TOPICS}
        self.times: schema.LoopStatistics | None = None  # statistics of all ticks so far
        # A warning is shown if a servo is predicted to reach its temperature limit within this time
        # [s].
        self.heat_warning_time = 0.0
        self._lease_holder = "", -math.inf  # holder of the command lease, and end of the lease [s]
        self._lease = math.nan  # lease duration [s]
        self.commanded = math.nan  # force in the last grasp command from any client [N]
        self.force_default = math.nan  # default force of a grasp command [N]
        self.force_limit = math.inf  # maximum grip force that a command may request [N]
        self.skipped_count = 0
        self._waits: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._period = 0.0  # smoothed time between states [s]
        self.topics: dict[bytes, Callable[[Any, float], None]] = {
            schema.STATE: self._read_state,
            schema.TACTILE: self._read_frame,
            schema.EVENT: self._read_event,
            schema.STATS: self._read_stats,
            schema.COMMAND: self._read_command,
            schema.SETTINGS: self._read_settings,
        }

    def drain(self, socket: zmq.Socket[Any], now: float) -> None:
        """Process the messages queued on ``socket``."""
        for message in drain(socket, DRAIN_COUNT_MAX):
            self.read(message, now)

    def read(self, message: list[bytes], now: float) -> None:
        """Process one raw message; ignore a repetition."""
        try:
            topic, record = unpack(message)
            if topic in self.topics and self.gaps[topic].take(record):
                self.process(topic, record, now)
        except INVALID:
            self.skipped_count += 1

    def process(self, topic: bytes, record: dict[str, Any], now: float) -> None:
        """Process one unpacked message. Raises an error of `INVALID` for an invalid message."""
        if topic in self.topics:
            self.topics[topic](read(schema.TOPICS[topic].record, record), now)

    def _read_state(self, state: schema.HandState, now: float) -> None:
        before = self.state
        if state.seq < before.seq:  # The daemon was restarted.
            self._waits.clear()
            self.frames.clear()
            self._period = 0.0
            self.times, self._lease_holder = None, ("", -math.inf)
            self.commanded = math.nan
        elif before.mono_ns and 0.0 < (step := 1e-9 * (state.mono_ns - before.mono_ns)) < 60.0:
            self._period = step if self._period == 0.0 else 0.9 * self._period + 0.1 * step
            if (waited := state.behind_s - before.behind_s) > 0.0:
                self._waits.append((now, waited))
        self.state, self.state_time = state, now
        self.mode, self.fault = printable(state.mode), printable(state.fault)

    def _read_frame(self, frame: schema.TactileFrame, now: float) -> None:
        if frame.finger not in FINGERS:
            raise ValueError("found a frame of an unknown finger")
        known = 0.0 < frame.scale < math.inf
        grid = frame.counts.astype(np.float64) * (frame.scale if known else 1.0)
        aspect = frame.pitch_y / (frame.pitch or math.nan)
        self.frames[frame.finger] = ShownFrame(
            now,
            frame.scale if known else math.nan,
            grid,
            aspect if 0.01 < aspect < 100.0 else 1.0,
            frame,
        )

    def _read_event(self, event: schema.Event, _: float) -> None:
        self._happened(event.timestamp, event.level, event.kind, event.text)

    def _happened(self, timestamp: float, *texts: str) -> None:
        event = ShownEvent(timestamp, *map(printable, texts))
        self._news.append(event)
        if math.isnan(timestamp):
            self.events.append(event)
        else:
            insort(self.events, event, key=lambda each: each.timestamp)
        del self.events[:-EVENT_COUNT_MAX]

    def _read_stats(self, times: schema.LoopStatistics, _: float) -> None:
        self.times = times

    def _read_command(self, answered: schema.AnsweredCommand, now: float) -> None:
        """Store the commanding client, and show a refused command as an event."""
        client = printable(answered.client)
        if answered.again:
            return
        if not answered.ok:
            by = f" (to {client})" if client else ""
            self._happened(answered.timestamp, "warning", "refused", f"{answered.error}{by}")
            return
        if answered.command in ("grasp", "hold"):
            force = number(json.loads(answered.request or "{}"), "force")
            if not math.isnan(force):
                self.commanded = force
            elif answered.command == "grasp":
                self.commanded = self.force_default
        if answered.command not in NO_LEASE_COMMANDS and self._lease > 0.0:
            self._lease_holder = client, now + self._lease

    def _read_settings(self, message: schema.HandSettings, _: float) -> None:
        settings = json.loads(message.settings or "{}")
        self._lease = number(settings, "commands", "lease")
        warm = number(settings, "safety", "heat_warn")
        self.force_default = number(settings, "control", "force_default")
        limit = number(settings, "safety", "force_max")
        self.force_limit = math.inf if math.isnan(limit) else GRIP_FRACTION * limit
        self.heat_warning_time = 0.0 if math.isnan(warm) else warm

    def news(self) -> list[ShownEvent]:
        """Return the events that arrived since the last call."""
        fresh = list(self._news)
        self._news.clear()
        return fresh

    def commander(self, now: float) -> str:
        """Return the name of the client that holds the command lease, or an empty string."""
        client, until = self._lease_holder
        return client if now < until else ""

    @property
    def is_raised(self) -> bool:
        """True if the daemon has increased the grip force above the commanded force."""
        return self.state.goal_force > _INCREASED_RATIO * self.commanded

    def grip(self) -> str:
        """Describe the grip's goal; return an empty string if there is no grip."""
        force, angle = self.state.goal_force, math.degrees(self.state.goal_angle)
        if not math.isfinite(force):
            return ""
        raised = f", raised from {self.commanded:.1f} N" if self.is_raised else ""
        turned = f", object angle {angle:z.1f}°" if math.isfinite(angle) else ""
        return f"grip: goal {force:.1f} N{raised}{turned}"

    def age(self, now: float) -> float:
        """Return the time since the last state [s], or infinity before the first state."""
        return now - self.state_time

    def status(self, now: float) -> str:
        """Return ``waiting`` before the first state, then ``live``, ``stale`` or ``lost``."""
        age = self.age(now)
        if age == math.inf:
            return "waiting"
        if age > max(2.0, 10.0 * self._period):
            return "lost"
        return "stale" if age > max(0.5, 3.0 * self._period) else "live"

    def waited(self, now: float) -> float:
        """Return how long [s] a simulated hand recently paused because the machine was busy."""
        while self._waits and self._waits[0][0] < now - RECENT_TIME:
            self._waits.popleft()
        return sum(waited for _, waited in self._waits)

    @property
    def rate(self) -> float:
        """Number of states per second, or NaN if unknown."""
        return 1.0 / self._period if self._period else math.nan


class ShownReply(NamedTuple):
    """Reply to a command, prepared for drawing."""

    at: float
    ok: bool
    text: str


class _Command(NamedTuple):
    pressed: float  # monotonic time [s]
    label: str
    request: dict[str, Any]


class Commander(logging.Handler):
    """Send commands in other threads; ``reply`` is the newest reply.

    A command is sent after the reply to the previous command. A stop does not wait for other
    commands, and discards the commands that have not been sent yet. As a logging handler, the
    commander shows the warning that `send` logs if a reply takes long.
    """

    QUEUE_LENGTH = 8  # maximum number of waiting commands; further commands are dropped

    def __init__(self, address: str, client: str = "", keys: ClientKeys | None = None) -> None:
        super().__init__()
        self._address = address
        self._keys = keys
        self._envelope = {"client": client} if client else {}
        self._queue: Queue[_Command] = Queue(self.QUEUE_LENGTH)
        self._stopped = -math.inf  # time of the last stop
        self._stopping: list[Thread] = []
        self.reply: ShownReply | None = None
        logging.getLogger(send.__module__).addHandler(self)
        Thread(target=self._carry_out_queue, daemon=True).start()

    def send(self, now: float, label: str, command: str, **fields: float) -> None:
        """Send ``command`` with ``fields``; label its reply with ``label``."""
        asked = _Command(now, label, {"command": command, **self._envelope, **fields})
        if command == "stop":
            self._stopped = now
            self._stopping.append(Thread(target=self._carry_out, args=(asked,), daemon=True))
            self._stopping[-1].start()
            return
        try:
            self._queue.put_nowait(asked)
        except Full:
            self.refuse(now, f"{label}: discarded because the daemon does not respond")

    def refuse(self, now: float, why: str) -> None:
        """Show the reason why a command failed or was not sent."""
        self.reply = ShownReply(now, False, why)

    def emit(self, record: logging.LogRecord) -> None:
        self.refuse(time.monotonic(), record.getMessage())

    def close(self) -> None:
        """Wait briefly until the last stop has been sent."""
        for each in self._stopping[-1:]:
            each.join(LOCAL_STOP_TIMEOUT)
        super().close()

    def _carry_out_queue(self) -> None:
        while True:
            asked = self._queue.get()
            if asked.pressed > self._stopped:
                self._carry_out(asked)

    def _carry_out(self, asked: _Command) -> None:
        remaining = round(asked.pressed + REPLY_TIMEOUT - time.monotonic(), 1)
        if remaining <= 0.0:  # The daemon has not replied to the previous commands.
            return
        try:
            reply = send(self._address, asked.request, remaining, self._keys)
        except NoAnswer as error:
            self.refuse(time.monotonic(), f"{asked.label}: {error}")
        else:
            self.reply = judge(time.monotonic(), asked.label, reply)


def judge(now: float, label: str, record: Any) -> ShownReply:
    """Convert the daemon's reply into a reply for the page, labelled with ``label``."""
    if field(record, "ok") is True:
        if text(record, "torque_off") == "unconfirmed":
            return ShownReply(now, False, f"{label}: {UNCONFIRMED_TEXT}")
        return ShownReply(now, True, f"{label}: ok")
    why = text(record, "error") or "invalid answer"
    named = why.split(":")[0] == label.split(" ")[0]  # True if the message names the command
    return ShownReply(now, False, why if named else f"{label}: {why}")
