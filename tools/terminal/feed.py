"""What the live page shows of the stream: state, frames, last events, statistics, a history.

Without the sockets (`feed_sockets`), and nothing that draws. Every message is data of unknown
origin: a missing or wrong-typed field is NaN or an empty text, a message that can't be read is
counted and skipped.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from bisect import insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.connection import unpack
from softfinger.daemon.client.records import read
from softfinger.daemon.control.modes import UNLEASED
from softfinger.daemon.types import FINGERS, GRIP_SHARE
from softfinger.daemon.wire.schema import (
    COMMAND,
    EVENT,
    SETTINGS,
    STATE,
    STATS,
    TACTILE,
    TactileFrame,
)

HISTORY_STEP = 0.2  # s in one column of the trends
HISTORY_LENGTH = 600
WINDOW = 1.0  # s of statistics
LATELY = 3.0  # s in which waiting for a busy machine is shown
EVENTS = 200  # kept


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
class ShownFrame:
    """A tactile frame as the page draws it."""

    arrived: float  # monotonic s
    rows: int
    cols: int
    scale: float  # Pa per count, NaN when unknown
    counts: NDArray[np.uint16]  # [rows, cols]
    aspect: float  # a cell's height over its width

    def grid(self) -> NDArray[np.float64]:
        """Pressures [rows, cols], Pa; counts where the scale isn't known."""
        scale = 1.0 if math.isnan(self.scale) else self.scale
        return self.counts.astype(np.float64) * scale


@dataclass(frozen=True, slots=True)
class ShownEvent:
    """One line of hand/event."""

    timestamp: float  # Unix s, NaN when unknown
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
class RecentTicks:
    """Medians and worst values over the last second; NaN when unknown."""

    messages: float = math.nan  # states a second
    rate: float = math.nan  # ticks a second
    compute: float = math.nan
    compute_max: float = math.nan
    late: float = math.nan
    late_max: float = math.nan


@dataclass(frozen=True, slots=True)
class LoopTimes:
    """Times of all ticks so far, from ``hand/stats`` [s]; NaN when unknown."""

    compute: tuple[float, ...]  # median, p99, largest
    late: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Commanding:
    """Who has the commander's lease, and until when."""

    client: str  # empty: the clients that give no name
    until: float  # monotonic s


class Feed:
    """Takes messages, remembers what a page shows. ``now`` is monotonic seconds throughout.

    ``events`` are in the order in which they happened, which after a late subscription is not the
    order in which they came; ``news`` hands them over as they came.
    """

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self.state_at = -math.inf
        self.frames: dict[str, ShownFrame] = {}
        self.events: list[ShownEvent] = []
        self._news: deque[ShownEvent] = deque(maxlen=EVENTS)
        self._heard: deque[tuple[float, float]] = deque(maxlen=2 * EVENTS)
        self.times: LoopTimes | None = None
        self.warm = math.inf  # °C from which a servo's temperature is warned about
        self.commanding: Commanding | None = None
        self._lease = math.nan  # s
        self.asked = math.nan  # N of the last grasp command, of any client
        self.force_default = math.nan  # N of a grasp without a force
        self.force_most = math.inf  # N that a grip may be asked for
        self.skipped = 0
        self.history: deque[tuple[float, float]] = deque(maxlen=HISTORY_LENGTH)  # N, left, right
        self._bin: list[tuple[float, float]] = []
        self._bin_end = -math.inf
        self._ticks: deque[tuple[float, float, float, float]] = deque(maxlen=10_000)
        self._waits: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._period = 0.0  # s between states, smoothed
        self._mono = math.nan
        self.topics: dict[bytes, Callable[[dict[str, Any], float], None]] = {
            STATE: self._take_state,
            TACTILE: self._take_frame,
            EVENT: self._take_event,
            STATS: self._take_stats,
            COMMAND: self._take_command,
            SETTINGS: self._take_settings,
        }

    def take(self, message: list[bytes], now: float) -> None:
        """One message off the wire, whatever it holds."""
        try:
            topic, record = unpack(message)
            take = self.topics.get(topic)
            if take is not None:
                take(record, now)
        except (ValueError, TypeError, RecursionError):
            self.skipped += 1

    def _take_state(self, record: dict[str, Any], now: float) -> None:
        mono = 1e-9 * number(record, "mono_ns")
        if number(record, "seq") < number(self.state, "seq"):  # another daemon: a new story
            self._ticks.clear()
            self._waits.clear()
            self.history.clear()
            self.frames.clear()
            self._bin.clear()
            self._period = 0.0
            self.times = self.commanding = None
            self.asked = math.nan
        elif 0.0 < mono - self._mono < 60.0:
            step = mono - self._mono
            self._period = step if self._period == 0.0 else 0.9 * self._period + 0.1 * step
            waited = number(record, "behind_s") - number(self.state, "behind_s")
            if waited > 0.0:
                self._waits.append((now, waited))
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
        frame = read(TactileFrame, record)
        if frame.finger not in FINGERS:
            raise ValueError("not a frame of one of the fingers")
        aspect = frame.pitch_y / (frame.pitch or math.nan)
        self.frames[frame.finger] = ShownFrame(
            now,
            frame.rows,
            frame.cols,
            frame.scale if 0.0 < frame.scale < math.inf else math.nan,
            frame.counts,
            aspect if 0.01 < aspect < 100.0 else 1.0,
        )

    def _take_event(self, record: dict[str, Any], _: float) -> None:
        # Told again for somebody who came later, it has its first seq and times; another daemon's
        # has other times.
        name = number(record, "seq"), number(record, "timestamp")
        if record.get("again") is True and name in self._heard:
            return
        self._heard.append(name)
        self._happened(
            ShownEvent(
                number(record, "timestamp"),
                text(record, "level"),
                text(record, "kind"),
                text(record, "text"),
            )
        )

    def _happened(self, event: ShownEvent) -> None:
        self._news.append(event)
        if math.isnan(event.timestamp):
            self.events.append(event)
        else:
            insort(self.events, event, key=lambda each: each.timestamp)
        del self.events[:-EVENTS]

    def _take_stats(self, record: dict[str, Any], _: float) -> None:
        compute, late = (
            tuple(number(record, part, share) for share in ("p50", "p99", "max"))
            for part in ("compute", "wake")
        )
        self.times = LoopTimes(compute, late)

    def _take_command(self, record: dict[str, Any], now: float) -> None:
        """Who commands; a refusal is shown as an event, for those who didn't send the command."""
        name, client = text(record, "command"), text(record, "client")
        if record.get("again") is True:
            return
        if record.get("ok") is not True:
            why = text(record, "error")
            by = f" (to {client})" if client else ""
            when = number(record, "timestamp")
            self._happened(ShownEvent(when, "warning", "refused", f"{why}{by}"))
            return
        if name == "grasp":
            force = number(json.loads(text(record, "request") or "{}"), "force")
            self.asked = self.force_default if math.isnan(force) else force
        if name not in UNLEASED and self._lease > 0.0:
            self.commanding = Commanding(client, now + self._lease)

    def _take_settings(self, record: dict[str, Any], _: float) -> None:
        settings = json.loads(text(record, "settings") or "{}")
        self._lease = number(settings, "commands", "lease")
        warm = number(settings, "safety", "temperature_warn")
        self.force_default = number(settings, "control", "force_default")
        most = number(settings, "safety", "force_max")
        self.force_most = math.inf if math.isnan(most) else GRIP_SHARE * most
        self.warm = math.inf if math.isnan(warm) else warm

    def news(self) -> list[ShownEvent]:
        """The events that have come since the last call."""
        fresh = list(self._news)
        self._news.clear()
        return fresh

    def commander(self, now: float) -> str | None:
        """The client that has the commander's lease, "" for one without a name; None: nobody."""
        if self.commanding is None or now >= self.commanding.until:
            return None
        return self.commanding.client

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

    def waited(self, now: float) -> float:
        """Seconds that a simulated hand has lately waited for a busy machine."""
        while self._waits and self._waits[0][0] < now - LATELY:
            self._waits.popleft()
        return sum(waited for _, waited in self._waits)

    def statistics(self, now: float) -> RecentTicks:
        """Statistics of the last second's states."""
        while self._ticks and self._ticks[0][0] < now - WINDOW:
            self._ticks.popleft()
        if not self._ticks:
            return RecentTicks()
        _, tick, compute, late = zip(*self._ticks, strict=True)
        period = _median(tick)
        return RecentTicks(
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
