"""From the stream's messages to what Rerun shows.

`Bridge.take` sorts a message in, `Bridge.draw` logs everything since the last drawing: every state
goes into the plots, all else is drawn from the newest message. Messages are data of unknown origin:
missing fields and fields of another type are left out.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr

from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.terminal.feed import field, number, printable, text
from softfinger.tools.viewing import views
from softfinger.tools.viewing.drawing import Drawing
from softfinger.tools.viewing.known import ShownHand, read_settings
from softfinger.tools.viewing.live_stream import TOPICS
from softfinger.tools.viewing.planar import GOAL, LEVELS

_EVENTS = 500  # kept for one drawing
_SETTINGS_WAIT = 100  # states that the layout waits for the settings
_PLOTTED = 0.2  # s of the stream that go into the plots at once: fewer, larger pieces
_DEGREE = 180.0 / math.pi
_QUANTILES = ("p50", "p99", "p999", "max")
_PARTS = {
    "wake": "wake-up late",
    "compute": "work",
    "bus": "of it: bus",
    "publish": "of it: publish",
}
_RATES = ("tick", "left", "right", "state", "tactile")


class Bridge:
    """Takes messages, logs to ``recording``, calls ``say`` with lines for people.

    Counts: ``shown`` states in the plots; ``dropped`` states and ``dropped_events`` that were
    skipped, more than are kept for one drawing; ``frames`` received, and ``drawn`` the newest of
    them; ``unreadable`` messages; ``lost`` messages that never arrived, by topic.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        say: Callable[[str], None] = lambda _: None,
        keep: int = 2000,
    ) -> None:
        self._recording = recording
        self._say = say
        self._states: deque[dict[str, Any]] = deque(maxlen=keep)
        self._frames: dict[str, dict[str, Any]] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        self._truth: dict[str, Any] | None = None
        self._statistics: dict[str, Any] | None = None
        self._gaps = {topic: Gaps() for topic in TOPICS}
        self._hand = ShownHand()
        self._known = False  # the settings have arrived
        self._drawing: Drawing | None = None
        self._waited = 0  # states
        self._newest: dict[str, Any] | None = None  # to be drawn
        self._state: dict[str, Any] | None = None  # drawn last
        self._plotted = math.nan
        self._mode = ""
        self._first = math.nan  # time of the first state or frame
        self._same_schema = True
        self._plots: dict[str, views.Plot] = {}
        self.time = math.nan  # Unix time of the newest state [s]
        self.shown = 0
        self.dropped = 0
        self.dropped_events = 0
        self.frames = 0
        self.drawn = 0
        self.unreadable = 0

    @property
    def lost(self) -> dict[str, int]:
        """Messages that were published and never arrived, by topic."""
        return {topic.decode(): gaps.lost for topic, gaps in self._gaps.items() if gaps.lost}

    def summary(self) -> str:
        """The counts in one line."""
        lost = ", ".join(f"{count} of {topic}" for topic, count in self.lost.items())
        parts = [
            (True, f"{self.shown} states shown"),
            (self.frames, f"{self.drawn} of {self.frames} frames drawn"),
            (self.dropped, f"{self.dropped} states skipped to keep up"),
            (self.dropped_events, f"{self.dropped_events} events skipped"),
            (True, f"lost on the way: {lost or 'none'}"),
            (self.unreadable, f"{self.unreadable} messages could not be read"),
        ]
        return ", ".join(part for known, part in parts if known)

    def take(self, topic: bytes, message: Any) -> None:
        """One message, whatever it holds."""
        if topic not in self._gaps:
            return
        if not isinstance(message, dict):
            self.unreadable += 1
            return
        if not self._gaps[topic].take(message):
            return  # repeated for a later subscriber
        if message.get("schema") != schema.SCHEMA and self._same_schema:
            self._same_schema = False
            self._say(
                f"the stream is of schema {message.get('schema')!r:.20}, this viewer knows "
                f"{schema.SCHEMA}; it keeps to the fields it knows"
            )
        when = number(message, "timestamp")
        if not math.isfinite(when) or not 0.0 <= when < 2.0**33:
            self.unreadable += 1
            return
        if topic in (schema.STATE, schema.TACTILE) and math.isnan(self._first):
            self._first = when
        if topic == schema.STATE:
            self._take_state(message, when)
        elif topic == schema.TACTILE:
            finger = text(message, "finger")
            if finger in FINGERS:
                self._frames[finger] = message
                self.frames += 1
        elif topic == schema.EVENT:
            self.dropped_events += len(self._events) == _EVENTS
            self._events.append(message)
        elif topic == schema.STATS:
            self._statistics = message
        elif topic == schema.TRUTH:
            self._truth = message
        elif topic == schema.SETTINGS:
            self._take_settings(message)

    def _take_state(self, message: dict[str, Any], when: float) -> None:
        newest = self._newest or self._state
        restarted = newest is not None and number(message, "seq") < number(newest, "seq")
        if restarted and self._drawing is not None:
            self._drawing.forget()
        self.dropped += len(self._states) == self._states.maxlen
        self._states.append(message)
        self._newest = message
        self._waited += 1
        self.time = when

    def _take_settings(self, message: dict[str, Any]) -> None:
        settings, unknown = read_settings(message)
        if unknown:
            version = text(message, "version") or "another version"
            keys = printable(", ".join(unknown))
            self._say(f"settings of {version} that are not known here: {keys}")
        if not self._known or settings != self._hand.settings:
            self._hand = ShownHand(settings)
            self._known = True
            self._drawing = None

    def draw(self, last: bool = False) -> None:
        """Log everything since the last drawing. The layout comes first, once settings are known.

        ``last``: nothing more will come, so settings are not waited for.
        """
        if self._drawing is None:
            if not (self._states or self._frames or self._known):
                return
            if not self._known and self._waited < _SETTINGS_WAIT and not last:
                return
            self._drawing = self._begin()
        drawing = self._drawing
        if self._newest is not None:
            self._at(self._newest)
            drawing.state(self._newest)
            self._state, self._newest = self._newest, None
        if self._states and (last or not abs(self.time - self._plotted) < _PLOTTED):
            self._plot(drawing)
            self._states.clear()
            self._plotted = self.time
        if self._truth is not None:
            self._at(self._truth)
            drawing.truth(self._truth)
            self._truth = None
        for frame in self._frames.values():
            self._at(frame)
            try:
                drawing.frame(frame, self._state)
                self.drawn += 1
            except ValueError:
                self.unreadable += 1
        self._frames.clear()
        if last or not math.isnan(self._first):
            self._log_events()

    def _begin(self) -> Drawing:
        """Log the layout and everything that stands still, for the hand as it is known now."""
        self._recording.send_blueprint(views.blueprint(self._hand))
        drawing = Drawing(self._recording, self._hand)
        self._plots = views.plots(self._hand)
        for plot in self._plots.values():
            self._recording.log(plot.entity, plot.style(), static=True)
        self._recording.log(
            "mode",
            rr.StateConfiguration(values=list(views.MODES), colors=list(views.MODES.values())),
            static=True,
        )
        self._mode = ""
        return drawing

    def _plot(self, drawing: Drawing) -> None:
        """Log every state since the last drawing, as columns."""
        states = list(self._states)

        def values(*path: str) -> Any:
            return np.array([number(state, *path) for state in states])

        def each(key: str, factor: float = 1.0) -> list[Any]:
            return [factor * values(name, key) for name in self._hand.fingers]

        stamps = values("timestamp")
        times = [rr.TimeColumn(views.TIME, timestamp=stamps)]
        force = values("goal_force")
        landscape = drawing.landscape
        energy = np.full_like(force, np.nan) if landscape is None else landscape.energy_of(force)
        valid = [field(state, "object", "valid") is True for state in states]
        angle = np.where(valid, values("object", "angle"), np.nan)
        columns = {
            "force": [*each("force"), force],
            "energy": [*each("energy", 1e3), 1e3 * energy],
            "d": each("d", 1e3),
            "theta": each("theta", _DEGREE),
            "object": [_DEGREE * angle, _DEGREE * values("goal_angle")],
            "q": [*each("q", _DEGREE), *each("goal_q", _DEGREE)],
            "current": [*each("current"), *each("goal_current")],
            "tick": [1e6 * values("compute_s"), 1e6 * values("wake_late_s")],
        }
        for name, plot in self._plots.items():
            table = np.column_stack(columns[name])
            scalars = rr.Scalars.columns(scalars=table.ravel())
            lengths = np.full(len(states), table.shape[1])
            self._recording.send_columns(plot.entity, times, scalars.partition(lengths))
        for state in states:
            mode = text(state, "mode")
            if mode != self._mode:
                self._mode = mode
                self._at(state)
                self._recording.log("mode", rr.StateChange(state=mode))
        self.shown += len(states)

    def _log_events(self) -> None:
        """Log the events, and the loop's own statistics."""
        while self._events:
            event = self._events.popleft()
            self._at(event)
            level, kind = text(event, "level"), text(event, "kind")
            clock = time.strftime("%H:%M:%S", time.localtime(number(event, "timestamp")))
            self._recording.log(
                f"events/{kind if kind.isidentifier() else 'other'}",
                rr.TextLog(
                    f"{clock}  {kind}: {text(event, 'text')}",
                    level={"warning": "WARN", "error": "ERROR"}.get(level, "INFO"),
                    color=LEVELS.get(level, GOAL),
                ),
            )
        if self._statistics is not None:
            self._at(self._statistics)
            self._recording.log(
                "statistics",
                rr.TextDocument(
                    statistics_table(self._statistics), media_type=rr.MediaType.MARKDOWN
                ),
            )
            self._statistics = None

    def _at(self, message: dict[str, Any]) -> None:
        """What is logged next is of the message's time; repeated events are of the first state's.

        Else they would stretch the time line to hours before the data.
        """
        stamp = number(message, "timestamp")
        if stamp < self._first:
            stamp = self._first
        self._recording.set_time(views.TIME, timestamp=stamp)


def statistics_table(message: dict[str, Any]) -> str:
    """A ``hand/stats`` in Markdown: times since the daemon's start [µs], last rates."""

    def shown(decimals: int, *path: str, factor: float = 1.0) -> str:
        value = factor * number(message, *path)
        return f"{value:.{decimals}f}" if math.isfinite(value) else "—"

    lines = [
        f"**{shown(0, 'ticks')} ticks** of {shown(3, 'period_s', factor=1e3)} ms, "
        f"**{shown(0, 'overruns')} overruns**",
        "",
        "| µs | median | 99 % | 99.9 % | longest |",
        "|---|---:|---:|---:|---:|",
    ]
    for key, name in _PARTS.items():
        values = " | ".join(shown(1, key, quantile, factor=1e6) for quantile in _QUANTILES)
        lines.append(f"| {name} | {values} |")
    rates = " · ".join(f"{name} {shown(1, 'rates', name)}" for name in _RATES)
    return "\n".join([*lines, "", f"Hz: {rates}"])
