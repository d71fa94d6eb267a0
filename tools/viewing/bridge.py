"""From the stream's messages to what Rerun shows.

`Bridge.take` sorts a message in, `Bridge.draw` logs what came since: every state goes into the
plots, all else is drawn from the newest. Messages are data of unknown origin: what is missing or of
another type in them is left out.
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Any

import numpy as np
import rerun as rr

from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.terminal.feed import number, printable, text
from softfinger.tools.viewing import layout
from softfinger.tools.viewing.drawing import Drawing
from softfinger.tools.viewing.known import Hand, Wanted, read_settings
from softfinger.tools.viewing.statistics import table

TOPICS = (
    schema.SETTINGS,
    schema.COMMAND,
    schema.EVENT,
    schema.STATE,
    schema.TRUTH,
    schema.TACTILE,
    schema.STATS,
)
_EVENTS = 500  # events that wait to be drawn
_PATIENCE = 100  # states that the layout waits for the settings
_PLOTTED = 0.2  # s of the stream that go into the plots at once: fewer, larger pieces


class Bridge:
    """Takes messages, logs to ``recording``.

    What came is told apart from what was lost on the way: ``shown`` counts the states that went
    into the plots, ``dropped`` those that were passed over since more came than are kept for one
    drawing, ``swamped`` likewise the events, ``frames`` those that came and ``drawn`` the newest
    of them, ``unreadable`` messages that are none. ``notes`` is what a person should be told, once
    each.
    """

    def __init__(self, recording: rr.RecordingStream, keep: int = 2000) -> None:
        self._recording = recording
        self._states: deque[tuple[dict[str, Any], float, float]] = deque(maxlen=keep)
        self._frames: dict[str, dict[str, Any]] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        self._truth: dict[str, Any] | None = None
        self._statistics: dict[str, Any] | None = None
        self._gaps = {topic: Gaps() for topic in TOPICS}
        self._hand = Hand()
        self._known = False  # the settings have come
        self._wanted = Wanted()
        self._drawing: Drawing | None = None
        self._waited = 0
        self._newest: dict[str, Any] | None = None  # to be drawn
        self._state: dict[str, Any] | None = None  # the last that was
        self._plotted = math.nan
        self._mode = ""
        self._time = math.nan
        self._schema_told = False
        self._plots: dict[str, layout.Plot] = {}
        self.shown = 0
        self.dropped = 0
        self.swamped = 0
        self.frames = 0
        self.drawn = 0
        self.unreadable = 0
        self.notes: list[str] = []

    @property
    def lost(self) -> dict[str, int]:
        """Messages that were published and never came, by topic; none for topics without loss."""
        return {topic.decode(): gaps.lost for topic, gaps in self._gaps.items() if gaps.lost}

    @property
    def time(self) -> float:
        """The newest message's Unix time [s], NaN before the first."""
        return self._time

    def take(self, topic: bytes, message: Any) -> None:
        """One message, whatever it holds."""
        if not isinstance(message, dict) or topic not in self._gaps:
            self.unreadable += topic in self._gaps
            return
        if not self._gaps[topic].take(message):
            return  # told again for somebody who came later
        self._check_schema(message)
        when = number(message, "timestamp")
        if not math.isfinite(when) or not 0.0 <= when < 2.0**33:
            self.unreadable += 1
        elif topic == schema.STATE:
            self._take_state(message, when)
        elif topic == schema.TACTILE:
            finger = text(message, "finger")
            if finger in FINGERS:
                self._frames[finger] = message
                self.frames += 1
        elif topic == schema.EVENT:
            self.swamped += len(self._events) == _EVENTS
            self._events.append(message)
        elif topic == schema.STATS:
            self._statistics = message
        elif topic == schema.TRUTH:
            self._truth = message
        elif topic == schema.COMMAND:
            self._wanted.take(message, self._hand)
        elif topic == schema.SETTINGS:
            self._take_settings(message)

    def _take_state(self, message: dict[str, Any], when: float) -> None:
        newest = self._newest or self._state
        if newest is not None and number(message, "seq") < number(newest, "seq"):
            self._forget()
        self.dropped += len(self._states) == self._states.maxlen
        self._states.append((message, *self._wanted.of(message)))
        self._newest = message
        self._waited += 1
        self._time = when

    def _forget(self) -> None:
        """Another daemon, or the same one started again."""
        self._wanted = Wanted()
        if self._drawing is not None:
            self._drawing.forget()

    def _take_settings(self, message: dict[str, Any]) -> None:
        settings, passed = read_settings(message)
        if passed:
            version = text(message, "version") or "another version"
            self.notes.append(
                f"settings of {version} that are not known here: {printable(', '.join(passed))}"
            )
        if self._known and settings == self._hand.settings:
            return
        self._hand = Hand(settings)
        self._known = True
        self._drawing = None

    def _check_schema(self, message: dict[str, Any]) -> None:
        found = message.get("schema")
        if found != schema.SCHEMA and not self._schema_told:
            self._schema_told = True
            self.notes.append(
                f"the stream is of schema {found!r:.20}, this viewer knows {schema.SCHEMA}; "
                "it keeps to the fields it knows"
            )

    # Logging

    def draw(self, last: bool = False) -> None:
        """Log what came since the last drawing. The layout comes first, once settings are known.

        ``last``: nothing more will come, so that settings are not waited for.
        """
        if self._drawing is None:
            if not (self._states or self._frames or self._known):
                return
            if not self._known and self._waited < _PATIENCE and not last:
                return
            self._begin()
        drawing = self._drawing
        assert drawing is not None
        if self._newest is not None:
            self._recording.set_time(layout.TIME, timestamp=self._time)
            drawing.state(self._newest)
            self._state, self._newest = self._newest, None
        if self._states and (last or not abs(self._time - self._plotted) < _PLOTTED):
            self._plot()
            self._states.clear()
            self._plotted = self._time
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
        self._tell()

    def _begin(self) -> None:
        """The layout and all that stands still, for the hand as it is known now."""
        self._recording.send_blueprint(layout.blueprint(self._hand))
        self._drawing = Drawing(self._recording, self._hand)
        self._drawing.prepare()
        self._plots = layout.plots(self._hand)
        for plot in self._plots.values():
            self._recording.log(plot.entity, plot.style(), static=True)
        self._recording.log(
            "mode",
            rr.StateConfiguration(values=list(layout.MODES), colors=list(layout.MODES.values())),
            static=True,
        )
        self._mode = ""

    def _plot(self) -> None:
        """Every state since the last drawing, as columns."""
        states = [state for state, _, _ in self._states]
        force, angle = np.array([(force, angle) for _, force, angle in self._states]).T
        landscape = self._drawing.landscape if self._drawing is not None else None
        energy = np.full_like(force, np.nan) if landscape is None else landscape.energy_of(force)
        stamps = np.array([number(state, "timestamp") for state in states])
        times = [rr.TimeColumn(layout.TIME, timestamp=stamps)]
        fingers = self._hand.fingers

        def each(key: str, factor: float) -> list[Any]:
            return [
                factor * np.array([number(state, name, key) for state in states])
                for name in fingers
            ]

        degree = 180.0 / math.pi
        angles = np.array([number(state, "object", "angle") for state in states])
        held = [bool((state.get("object") or {}).get("valid")) for state in states]
        columns = {
            "force": [*each("force", 1.0), force],
            "energy": [*each("energy", 1e3), 1e3 * energy],
            "d": each("d", 1e3),
            "theta": each("theta", degree),
            "object": [degree * np.where(held, angles, np.nan), degree * angle],
            "q": [*each("q", degree), *each("goal_q", degree)],
            "current": [*each("current", 1.0), *each("goal_current", 1.0)],
            "tick": [
                1e6 * np.array([number(state, key) for state in states])
                for key in ("compute_s", "wake_late_s")
            ],
        }
        for name, plot in self._plots.items():
            values = np.column_stack(columns[name])
            scalars = rr.Scalars.columns(scalars=values.ravel())
            lengths = np.full(len(states), values.shape[1])
            self._recording.send_columns(plot.entity, times, scalars.partition(lengths))
        self._modes(states, stamps)
        self.shown += len(states)

    def _modes(self, states: list[dict[str, Any]], stamps: Any) -> None:
        for state, stamp in zip(states, stamps, strict=True):
            mode = text(state, "mode")
            if mode != self._mode:
                self._mode = mode
                self._recording.set_time(layout.TIME, timestamp=stamp)
                self._recording.log("mode", rr.StateChange(state=mode))

    def _tell(self) -> None:
        """Events, and the loop's own statistics."""
        while self._events:
            event = self._events.popleft()
            self._at(event)
            level, kind = text(event, "level"), text(event, "kind")
            self._recording.log(
                f"events/{kind if kind.isidentifier() else 'other'}",
                rr.TextLog(
                    f"{_clock(event)}  {kind}: {text(event, 'text')}",
                    level={"warning": "WARN", "error": "ERROR"}.get(level, "INFO"),
                    color=layout.LEVELS.get(level, layout.WANTED),
                ),
            )
        if self._statistics is not None:
            self._at(self._statistics)
            self._recording.log(
                "statistics",
                rr.TextDocument(table(self._statistics), media_type=rr.MediaType.MARKDOWN),
            )
            self._statistics = None

    def _at(self, message: dict[str, Any]) -> None:
        self._recording.set_time(layout.TIME, timestamp=number(message, "timestamp"))


def _clock(event: dict[str, Any]) -> str:
    return time.strftime("%H:%M:%S", time.localtime(number(event, "timestamp")))
