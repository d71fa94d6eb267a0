"""What the public wire says, kept for one who looks at it: the newest state and frames, the last
events, statistics over the last second, a short history.

Holds the subscriber's side of the stream and the commands a person sends, and nothing that
draws. Every message is taken as data of unknown origin: a missing or wrong-typed field is a
NaN or an empty text, a message that can't be read is counted and skipped.
"""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
import zmq
from numpy.typing import NDArray

FINGERS = ("left", "right")
SCHEMA = 1  # of hand/state, the newest this module knows
TOPICS = (b"hand/state", b"hand/tactile", b"hand/event")

HISTORY_STEP = 0.2  # s in one column of the trends
HISTORY_LENGTH = 600
WINDOW = 1.0  # s of statistics
_DRAIN_LIMIT = 4000  # messages taken at once, so that a flood can't keep the page from drawing
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB


def field(record: object, *path: str) -> Any:
    """The value at ``path`` in nested maps, None where there is none."""
    for key in path:
        if not isinstance(record, dict):
            return None
        record = record.get(key)
    return record


def number(record: object, *path: str) -> float:
    """The number at ``path``, NaN where there is none."""
    value = field(record, *path)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return math.nan


def text(record: object, *path: str) -> str:
    """The text at ``path`` without control characters (they would reach the terminal)."""
    value = field(record, *path)
    return printable(value) if isinstance(value, str) else ""


def printable(value: str) -> str:
    """``value`` on one line, with nothing in it that a terminal would obey."""
    return "".join(c if c.isprintable() else " " for c in value)


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One frame as it came. ``scale`` is Pa per count, NaN when the message doesn't tell.

    ``aspect`` is a cell's height over its width.
    """

    arrived: float
    rows: int
    cols: int
    scale: float
    data: bytes
    aspect: float = 1.0

    def grid(self) -> NDArray[np.float64]:
        """Pressures [rows, cols], Pa; counts where the scale isn't known."""
        counts = np.frombuffer(self.data, dtype="<u2").reshape(self.rows, self.cols)
        return counts * (1.0 if math.isnan(self.scale) else self.scale)


@dataclass(frozen=True, slots=True)
class Event:
    """One line of hand/event."""

    timestamp: float  # Unix s, NaN when not told
    level: str
    kind: str
    text: str

    def clock(self) -> str:
        """Local time of day."""
        try:
            return time.strftime("%H:%M:%S", time.localtime(self.timestamp))
        except (ValueError, OverflowError, OSError):
            return "--:--:--"


@dataclass(frozen=True, slots=True)
class TickStatistics:
    """Medians and worst values over the last second; NaN where nothing was told."""

    messages: float = math.nan  # states a second
    rate: float = math.nan  # ticks a second
    compute: float = math.nan
    compute_max: float = math.nan
    late: float = math.nan
    late_max: float = math.nan


class Feed:
    """Takes messages, remembers what a page shows. ``now`` is monotonic seconds throughout."""

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self.state_at = -math.inf
        self.frames: dict[str, TactileFrame] = {}
        self.events: deque[Event] = deque(maxlen=200)
        self.event_count = 0
        self._event_seq = -math.inf
        self.skipped = 0
        self.history: deque[tuple[float, float]] = deque(maxlen=HISTORY_LENGTH)  # N, left, right
        self._bin: list[tuple[float, float]] = []
        self._bin_end = -math.inf
        self._ticks: deque[tuple[float, float, float, float]] = deque(maxlen=10_000)
        self._period = 0.0  # s between states, smoothed
        self._mono = math.nan

    def take(self, message: list[bytes], now: float) -> None:
        """One message off the wire, whatever it holds."""
        try:
            topic, payload = message
            record = msgpack.unpackb(payload)
            if not isinstance(record, dict):
                raise ValueError("not a map")
            if topic == b"hand/state":
                self._take_state(record, now)
            elif topic == b"hand/tactile":
                self._take_frame(record, now)
            elif topic == b"hand/event":
                self._take_event(record)
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
            self.skipped += 1

    def _take_state(self, record: dict[str, Any], now: float) -> None:
        mono = 1e-9 * number(record, "mono_ns")
        if number(record, "seq") < number(self.state, "seq"):  # another daemon: a new story
            self._ticks.clear()
            self.history.clear()
            self.frames.clear()
            self._bin.clear()
            self._period = 0.0
        elif 0.0 < mono - self._mono < 60.0:
            step = mono - self._mono
            self._period = step if self._period == 0.0 else 0.9 * self._period + 0.1 * step
        self._mono = mono
        self.state = record
        self.state_at = now
        self._ticks.append(
            (
                now,
                number(record, "tick_s"),
                number(record, "compute_s"),
                number(record, "wake_late_s"),
            )
        )
        if now >= self._bin_end:
            if self._bin:
                left, right = zip(*self._bin, strict=True)
                self.history.append((statistics.fmean(left), statistics.fmean(right)))
            self._bin.clear()
            self._bin_end = now + HISTORY_STEP
        self._bin.append((number(record, "left", "force"), number(record, "right", "force")))

    def _take_frame(self, record: dict[str, Any], now: float) -> None:
        finger, data = record.get("finger"), record.get("data")
        rows, cols = record.get("rows"), record.get("cols")
        if finger not in FINGERS or not isinstance(data, bytes):
            raise ValueError("not a frame of one of the fingers")
        if type(rows) is not int or type(cols) is not int or min(rows, cols) < 1:
            raise ValueError("not a grid")
        if len(data) != 2 * rows * cols:
            raise ValueError("a grid of another size than told")
        scale = number(record, "scale")
        aspect = number(record, "pitch_y") / (number(record, "pitch") or math.nan)
        self.frames[finger] = TactileFrame(
            now,
            rows,
            cols,
            scale if 0.0 < scale < math.inf else math.nan,
            data,
            aspect if 0.01 < aspect < 100.0 else 1.0,
        )

    def _take_event(self, record: dict[str, Any]) -> None:
        seq = number(record, "seq")
        if record.get("again") is True and seq <= self._event_seq:
            return  # told again for somebody who came later
        self._event_seq = seq
        self.event_count += 1
        self.events.append(
            Event(
                number(record, "timestamp"),
                text(record, "level"),
                text(record, "kind"),
                text(record, "text"),
            )
        )

    def age(self, now: float) -> float:
        """Seconds since the last state, infinite before the first."""
        return now - self.state_at

    def status(self, now: float) -> str:
        """``waiting`` before the first state, then ``live``, ``stale`` or ``lost`` by its age."""
        if self.state is None:
            return "waiting"
        age = self.age(now)
        if age > max(2.0, 10.0 * self._period):
            return "lost"
        return "stale" if age > max(0.5, 3.0 * self._period) else "live"

    def statistics(self, now: float) -> TickStatistics:
        """What the last second's states say of the tick."""
        while self._ticks and self._ticks[0][0] < now - WINDOW:
            self._ticks.popleft()
        if not self._ticks:
            return TickStatistics()
        _, tick, compute, late = zip(*self._ticks, strict=True)
        period = _median(tick)
        return TickStatistics(
            messages=len(self._ticks) / WINDOW,
            rate=1.0 / period if period > 0.0 else math.nan,
            compute=_median(compute),
            compute_max=_greatest(compute),
            late=_median(late),
            late_max=_greatest(late),
        )


def _finite(values: tuple[float, ...]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _median(values: tuple[float, ...]) -> float:
    finite = _finite(values)
    return statistics.median(finite) if finite else math.nan


def _greatest(values: tuple[float, ...]) -> float:
    return max(_finite(values), default=math.nan)


class Subscriber:
    """The stream's socket: everything that waits is taken into a feed."""

    def __init__(self, context: zmq.Context[Any], address: str, feed: Feed) -> None:
        self.feed = feed
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, _DRAIN_LIMIT)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        for topic in TOPICS:
            self._socket.setsockopt(zmq.SUBSCRIBE, topic)
        self._socket.connect(address)

    def drain(self, now: float) -> int:
        """Take what waits; how many messages that was."""
        for count in range(_DRAIN_LIMIT):
            try:
                message = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return count
            self.feed.take(message, now)
        return _DRAIN_LIMIT

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@dataclass(frozen=True, slots=True)
class Reply:
    """What came of a command, for the page."""

    at: float
    ok: bool
    text: str


class Commander:
    """Sends commands without ever waiting. The newest reply is kept in ``reply``.

    Each command has a request socket of its own: an answer that never comes holds nothing up,
    a stop least of all.
    """

    PATIENCE = 1.0  # s for an answer
    OPEN_LIMIT = 8  # commands under way; further ones are dropped, except stop

    def __init__(self, context: zmq.Context[Any], address: str) -> None:
        self._context = context
        self._address = address
        self._pending: list[tuple[str, zmq.Socket[bytes], float]] = []
        self.reply: Reply | None = None

    def send(self, now: float, label: str, command: str, **fields: float) -> None:
        """Send ``command`` with ``fields``; the reply is shown under ``label``."""
        if len(self._pending) >= self.OPEN_LIMIT and command != "stop":
            self.reply = Reply(now, False, f"{label}: dropped, the daemon doesn't answer")
            return
        request = self._context.socket(zmq.REQ)
        request.setsockopt(zmq.LINGER, 0)
        request.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
        request.connect(self._address)
        request.send(msgpack.packb({"command": command, **fields}), zmq.NOBLOCK)
        self._pending.append((label, request, now + self.PATIENCE))

    def refuse(self, now: float, why: str) -> None:
        """Say that a key was not turned into a command."""
        self.reply = Reply(now, False, why)

    def collect(self, now: float) -> None:
        """Take the replies that came, give up on those that are overdue."""
        waiting = []
        for label, request, deadline in self._pending:
            try:
                payload = request.recv(zmq.NOBLOCK)
            except zmq.Again:
                if now < deadline:
                    waiting.append((label, request, deadline))
                    continue
                self.reply = Reply(now, False, f"{label}: no answer from {self._address}")
            else:
                self.reply = self._read(now, label, payload)
            request.close()
        self._pending = waiting

    @staticmethod
    def _read(now: float, label: str, payload: bytes) -> Reply:
        try:
            record = msgpack.unpackb(payload)
        except (ValueError, RecursionError, msgpack.UnpackException):
            record = None
        if field(record, "ok") is True:
            return Reply(now, True, f"{label}: ok")
        why = text(record, "error") or "an answer that can't be read"
        said = why.split(":")[0] == label.split()[0]  # the daemon names the command itself
        return Reply(now, False, why if said else f"{label}: {why}")

    def close(self) -> None:
        """Close what is open; commands that were not taken yet are dropped."""
        for _, request, _ in self._pending:
            request.close()
        self._pending = []
