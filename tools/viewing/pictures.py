"""Convert the stream's messages to data for the web page: scene, pictures and plot rows.

A picture is a JSON text that contains each panel's lines, dots, texts and images at one point in
time. The scene contains the layout and the energy landscape, which are constant. A row contains the
values of all plots at one point in time. A page receives each row once, even if it skips pictures.
Colours are sent by name, and the page defines their RGB values.
"""

from __future__ import annotations

import base64
import math
import time
from collections import deque
from collections.abc import Callable
from itertools import takewhile
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from softfinger.daemon.control.modes import COMMANDS, GRIPPING_MODES, Mode
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import geometry_of
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.record_text import why_invalid
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.stream_state import INVALID, StreamState, number, printable, text
from softfinger.tools.terminal.text_layout import format_value
from softfinger.tools.viewing import hand_drawing
from softfinger.tools.viewing.hand_drawing import GOAL, OBJECT, FloatArray, touches
from softfinger.tools.viewing.landscape import THETA_END, landscape, read_settings

if TYPE_CHECKING:
    from softfinger.tools.viewing.foxglove_server import Foxglove

TOPICS = (*StreamState().topics, schema.TRUTH)
SECONDS = 60.0  # duration of the history that a newly opened page receives [s]
STEP = 0.1  # time between plot rows [s]
_TRAIL_LENGTH = 60  # number of rows in each trail on the landscape
_EVENT_COUNT = 50  # maximum number of displayed events
_WARNING_TIME = 5.0  # display time of a warning [s]
_LIMIT_FRACTION = 0.8  # fraction of a limit above which a value is reported
_DARK_SIGMA = 2.0  # minimum visible pressure, in standard deviations of the cell noise
_FULL_SCALE_MIN = 10.0  # minimum full scale, in standard deviations of the cell noise
_OLD_TIME = 0.35  # minimum age at which a message is shown as old [s]
_OLD_PERIODS = 4.0  # minimum age at which a message is shown as old, in stream periods
_NUMBER_MAX = 1e6  # maximum magnitude of drawn numbers; messages may contain any value
_DEGREE = math.degrees(1.0)


class _Plot(NamedTuple):
    """Plot of several signals versus time; ``span`` is the minimum range of the y axis."""

    title: str
    unit: str
    factor: float
    span: float
    paths: str  # `hand/state` fields
    detail: bool = False  # True if the plot is shown only on demand
    headline: int | None = None  # decimals of the numbers above the plots, or None for no numbers


_PLOTS = (
    _Plot("Force", "N", 1.0, 2.0, "left.force right.force goal_force", headline=1),
    _Plot("Object angle", "°", _DEGREE, 4.0, "object.angle goal_angle", headline=1),
    _Plot("Object width", "mm", 1e3, 1.0, "object.width", True, headline=1),
    _Plot("Displacement d", "mm", 1e3, 0.5, "left.d right.d", headline=2),
    _Plot("Tilt θ", "°", _DEGREE, 4.0, "left.theta right.theta"),
    _Plot("Elastic energy", "mJ", 1e3, 2.0, "left.energy right.energy", True),
    _Plot("Joint angles", "°", _DEGREE, 2.0, "left.q right.q left.goal_q right.goal_q", True),
    _Plot(
        "Motor current",
        "A",
        1.0,
        0.2,
        "left.current right.current left.goal_current right.goal_current",
        True,
    ),
    _Plot("Loop times", "µs", 1e6, 50.0, "compute_s wake_late_s", True),
)
_SERVOS = ("q", "current")  # fields that are not available without servos
_DEVIATED = ("force", "d", "theta")  # finger fields whose standard deviation ({}_std) is also drawn
_OTHERS = {  # names and colours of lines that do not belong to a finger
    "object.angle": ("object", OBJECT),
    "object.width": ("object", OBJECT),
    "compute_s": ("work", OBJECT),
    "wake_late_s": ("late", "late"),
}
# Finger fields that have a `safety.…_max` limit.
_BOUNDED = ("force", "d", "current", "temperature")
_FACTORS = {path: plot.factor for plot in _PLOTS for path in plot.paths.split()}
_FACTORS |= {
    f"{path}_std": factor
    for path, factor in _FACTORS.items()
    if path.rpartition(".")[2] in _DEVIATED
}
COLUMNS = {path: 3 + k for k, path in enumerate(_FACTORS)}  # columns 0 to 2: number, time, mode
_values = attrgetter(*_FACTORS)


def _row(number: int, state: HandState) -> list[Any]:
    """Create a plot row; quantities that the hand does not measure are NaN."""
    row = [number, state.timestamp, printable(state.mode)]
    for value, factor in zip(_values(state), _FACTORS.values(), strict=True):
        row.append(round(min(max(factor * value, -_NUMBER_MAX), _NUMBER_MAX), 4))
    if not state.object.valid:
        row[COLUMNS["object.angle"]] = row[COLUMNS["object.width"]] = math.nan
    return row


class Row(NamedTuple):
    """Plot row, packed for sending to a page; rows are numbered consecutively."""

    number: int
    text: str


class Pictures:
    """Process untrusted messages, and pass the scene and each picture to ``publish``.

    ``watched`` returns True if a page is open. ``say`` is called for messages that cannot be read.
    A ``live`` stream uses the machine's clock, and a recording uses the times in the messages.
    ``foxglove`` also receives the messages.
    """

    def __init__(
        self,
        publish: Callable[[str, str, list[Row]], None],
        watched: Callable[[], bool],
        say: Callable[[str], None],
        *,
        live: bool = True,
        period: float = STEP,
        foxglove: Foxglove | None = None,
    ) -> None:
        """Create a converter; ``period`` [s] is the time between pictures."""
        self._publish = publish
        self._watched = watched
        self._say = say
        self._live = live
        self._foxglove = foxglove
        self._period = period
        self._number = 0  # number of rows created so far
        self._marks: list[Any] = []
        self.recording: dict[str, Any] = {}  # status of the page's recorder
        self._settings_text = ""  # last settings message, unparsed
        self.seen = self.unreadable = 0  # number of states; number of unreadable messages
        self.clear()
        self._read_settings(Settings())

    def clear(self) -> None:
        """Discard all data except the hand's settings, for example before a jump in a recording."""
        self.feed = StreamState()
        self.states = 0  # number of states since the last `clear`
        self.time = math.nan  # Unix time of the newest state [s]
        self._truth: dict[str, Any] | None = None
        self._begin_rows()

    def _begin_rows(self) -> None:
        """Discard all rows; the pages then also discard their copies."""
        self._first = self._number
        self._past: deque[tuple[HandState, Row]] = deque(maxlen=round(SECONDS / STEP))

    def _moment(self) -> float:
        return time.monotonic() if self._live else self.time

    def take(self, topic: bytes, message: Any) -> None:
        """Process one untrusted message."""
        stamp = number(message, "timestamp")
        if topic not in TOPICS or not 0.0 <= stamp < 2.0**32:
            self.unreadable += 1
            return
        if not self.feed.gaps[topic].take(message):
            return
        if topic == schema.STATE:
            if number(message, "seq") < self.feed.state.seq:
                self._begin_rows()  # The daemon was restarted.
                self._truth = None
            elif self.states and self.time // STEP != stamp // STEP:
                last = self.feed.state  # last state of the previous time step
                self._past.append((last, Row(self._number, _packed(_row(self._number, last)))))
                self._number += 1
            self.time = stamp
            self.states += 1
            self.seen += 1
        elif topic == schema.TRUTH:
            self._truth = message
        elif topic == schema.SETTINGS and text(message, "settings") != self._settings_text:
            self._settings_text = text(message, "settings")
            settings, unknown = read_settings(message)
            if unknown:
                self._say(f"unknown settings: {printable(', '.join(unknown))}")
            self._read_settings(settings)
        try:
            self.feed.process(topic, message, self._moment())
        except INVALID:
            self.unreadable += 1
        if self._foxglove is not None:
            self._foxglove.take(topic, message)

    def _read_settings(self, settings: Settings) -> None:
        """Lay out the scene; only parts that the hand has get panels and plots."""
        self._settings = settings
        self._fingers = [FINGERS[k] for k in settings.scene.indices]
        self._pressure = heatmap.FullScale(
            heatmap.round_up(_FULL_SCALE_MIN * settings.tactile.noise)
        )
        hand, rows, cols = geometry_of(settings), settings.tactile.rows, settings.tactile.cols
        a = hand.tip_radius
        half, top = hand.half_separation + 1.3 * a, hand.reach + 1.9 * a
        panels = [_panel("hand", "Hand", -half, half, top, -0.4 * a, equal=True, scaled=True)]
        if settings.tactile.backend != "none":
            maps = [
                _panel(name, f"Pressure, {name} tip", 0, cols, 0, rows, equal=True)
                for name in self._fingers
            ]
            panels = [*maps[:1], *panels, *maps[1:]]
        if (energy := landscape(settings)) is not None:
            end = 1e3 * energy.d_end  # mm; θ in degrees
            depths = range(0, int(end) + 1, math.ceil(end / 6.0))
            angles = (-40.0, -20.0, 0.0, 20.0, 40.0)
            texts = [(GOAL, each, -0.06 * end, f"{each:g}°".replace("-", "−")) for each in angles]
            texts += [(GOAL, -1.15 * THETA_END, 1.0 * each, f"{each} mm") for each in depths]
            image = _image(energy.levels, -THETA_END, THETA_END, end, 0.0)
            still = {"image": image, "texts": texts}
            box = -1.3 * THETA_END, 1.05 * THETA_END, 1.05 * end, -0.1 * end
            title = f"Elastic energy U(d, θ), 0 to {1e3 * energy.highest:.0f} mJ"
            panels.append(_panel("landscape", title, *box, still=still))
        plots = [(plot, [*filter(self._has, plot.paths.split())]) for plot in _PLOTS]
        self._scene = {
            "live": self._live,
            "period": self._period,
            "panels": panels,
            "plots": [_described(plot, paths) for plot, paths in plots if paths],
            "palette": heatmap.colour_map(),
            "modes": [mode.value for mode in Mode],
            "commands": {name: list(each.modes) for name, each in COMMANDS.items()},
            "force_default": settings.control.force_default,
            "marks": self._marks,
        }
        self._scene_text = _packed(self._scene)

    def mark(self, marks: list[Any]) -> None:
        """Show the ``marks`` of a recording, as returned by `sources.marks_of`."""
        self._marks = self._scene["marks"] = marks
        self._scene_text = _packed(self._scene)

    def _has(self, path: str) -> bool:
        """Return True if the hand has the state field at this path."""
        finger, _, key = path.rpartition(".")
        no_servos = self._settings.servos.backend == "none"
        return not (
            (finger in FINGERS and finger not in self._fingers)
            or (no_servos and key.removeprefix("goal_") in _SERVOS)
            or (path in ("object.angle", "object.width", "goal_angle") and len(self._fingers) < 2)
        )

    def draw(self, place: dict[str, Any] | None = None) -> None:
        """If a page is waiting, publish a picture of the current data.

        ``place`` is the position in a recording; see `sources.Playback`.
        """
        now, feed, state = self._moment(), self.feed, self.feed.state
        if self._foxglove is not None and self.states:
            self._foxglove.draw(self._settings, state, self._truth)
        if not self._watched():
            return
        settings = self._settings
        picture = {
            "now": time.monotonic(),
            "time": self.time,
            "seq": state.seq,
            "mode": feed.mode,
            "age": feed.age(now),
            "patience": {
                "state": max(_OLD_TIME, _OLD_PERIODS / feed.rate),
                "frame": max(_OLD_TIME, _OLD_PERIODS / settings.stream.tactile_rate),
            },
            "fault": feed.fault,
            "place": place,
            "set": self._set(),
            "force_max": feed.force_limit,
            "notes": self._notes(),
            "facts": [part for fact in self._facts(now) for part in fact],
            "panels": self._maps(now) | {"hand": self._planar(), "landscape": self._contacts()},
            "events": [
                (each.timestamp, each.clock(), *each[1:]) for each in feed.events[-_EVENT_COUNT:]
            ],
            "recording": self.recording,
            "first": self._first,
            "row": _row(self._number, state) if self.states else None,
        }
        self._publish(self._scene_text, _packed(picture), [row for _, row in self._past])

    def _set(self) -> dict[str, float]:
        """Return the grip's requested force [N] and angle [°], or NaN if there is no grip."""
        feed, state = self.feed, self.feed.state
        angle = state.goal_angle if math.isfinite(state.goal_angle) else state.object.angle
        force = feed.commanded if math.isfinite(feed.commanded) else state.goal_force
        gripping = feed.mode in GRIPPING_MODES
        return {
            "force": force if gripping else math.nan,
            "angle": math.degrees(angle) if gripping else math.nan,
        }

    def _planar(self) -> dict[str, Any]:
        parts = hand_drawing.hand_parts(self._settings, self.feed.state, self._truth).values()
        lines = [(colour, wide, _flat(each)) for part in parts for colour, wide, each in part.lines]
        texts = [(colour, *_flat(at), words) for part in parts for colour, at, words in part.texts]
        return {"lines": lines, "texts": texts}

    def _maps(self, now: float) -> dict[str, Any]:
        """Draw each tip's pressure frame and rim, and each contact's footprint and centroid."""
        frames, tip = self.feed.frames, self._settings.tip.radius
        peak = max((float(frame.grid.max()) for frame in frames.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        maps = {}
        for name, frame in frames.items():
            unit, factor, dark = "kPa", 1e-3, _DARK_SIGMA * self._settings.tactile.noise
            if math.isnan(frame.scale):
                unit, factor, dark = "counts", 1.0, 0.0
            lines, dots, (rows, cols) = [], [], frame.grid.shape
            grid, contact = hand_drawing.grid_of(frame.source), self.feed.state.finger(name)
            if grid is not None:
                lines.append((name, 1.0, _flat(hand_drawing.tip_circle(grid, tip))))
            if grid is not None and touches(contact):
                tilts = contact.theta, contact.tilt_y if math.isfinite(contact.tilt_y) else 0.0
                if place := hand_drawing.footprint(grid, tip, contact.d, *tilts):
                    lines.append(("white", 1.5, _flat(place[0])))
                    dots.append((name, *_flat(place[1])))
            levels = heatmap.levels_of(frame.grid - dark, full - dark)
            maps[name] = {
                "image": _image(levels, 0, cols, 0, rows),
                "lines": lines,
                "dots": dots,
                "age": now - frame.arrived,
                "note": f"peak {factor * frame.grid.max():.1f} {unit}",
                "scale": (f"≤ {factor * dark:.0f}", f"{factor * full:g} {unit}"),
            }
        return maps

    def _contacts(self) -> dict[str, Any]:
        """Draw each contact and its trail on the landscape, in mm and degrees."""
        lines, dots = [], []
        states = [self.feed.state, *(state for state, _ in reversed(self._past))][
            : 1 + _TRAIL_LENGTH
        ]
        for name in self._fingers:
            tips = takewhile(touches, (state.finger(name) for state in states))
            if trail := [(_DEGREE * tip.theta, 1e3 * tip.d) for tip in tips]:
                lines.append((name, 2.0, _flat(np.array(trail))))
                dots.append((name, *trail[0]))
        return {"lines": lines, "dots": dots}

    def _notes(self) -> list[str]:
        """Return recent warnings, reasons for invalid estimates, and values near their limits."""
        state, safety, feed = self.feed.state, self._settings.safety, self.feed
        last = [each for each in feed.events[-1:] if each.level == "warning"]
        notes = [each.text for each in last if self.time - each.timestamp < _WARNING_TIME]
        if invalid := why_invalid(state):
            notes.append(invalid)
        if self.feed.is_raised:
            notes.append(self.feed.grip())
        used = [
            (value / getattr(safety, f"{key}_max"), name, key)
            for name in self._fingers
            for key in _BOUNDED
            if math.isfinite(value := abs(getattr(state.finger(name), key)))
        ]
        notes += [
            f"{name} {key} at {ratio:.0%} of safety.{key}_max"
            for ratio, name, key in sorted(used, reverse=True)
            if ratio >= _LIMIT_FRACTION
        ]
        if self.states and state.schema != schema.SCHEMA:
            notes.append(
                f"the stream uses schema {state.schema}, but this page supports schema "
                f"{schema.SCHEMA}"
            )
        return notes

    def _facts(self, now: float) -> list[tuple[str, str]]:
        """Return names and values for the details panel, e.g. loop times and lost messages."""
        feed, state, times = self.feed, self.feed.state, self.feed.times
        fingers = [state.finger(name) for name in self._fingers]

        def each(key: str, factor: float, decimals: int) -> str:
            return " / ".join(
                format_value(factor * getattr(finger, key), decimals) for finger in fingers
            )

        facts = [
            ("Age of the pressure maps", f"{each('frame_age_s', 1e3, 0)} ms"),
            ("Servos", f"{each('temperature', 1.0, 0)} °C, {each('voltage', 1.0, 1)} V"),
            ("Messages lost", f"{sum(gaps.lost for gaps in feed.gaps.values())}"),
            ("Messages unreadable", f"{self.unreadable}"),
            ("Loop overruns", f"{state.overruns}"),
        ]
        if times is not None:
            facts.append(("Loop rate", f"{format_value(times.rates.tick, 0)} Hz"))
            named = {"Loop work": times.compute, "Loop late": times.wake, "Servo bus": times.bus}
            for name, of in named.items():
                median, tail, most = (format_value(1e3 * t, 2) for t in (of.p50, of.p99, of.max))
                facts.append((name, f"median {median}, p99 {tail}, max {most} ms"))
        if who := feed.commander(now):
            facts.append(("Commanded by", who))
        return facts


def _described(plot: _Plot, paths: list[str]) -> dict[str, Any]:
    """Describe a plot for the page's layout, with one line per field in ``paths``."""
    lines = []
    for path in paths:
        finger, _, key = path.rpartition(".")
        role = f"{finger} goal".strip() if key.startswith("goal") else finger
        name, colour = _OTHERS.get(path, (role, finger))
        spread = COLUMNS.get(f"{path}_std")
        lines.append(
            {"name": name, "colour": colour or GOAL, "column": COLUMNS[path], "spread": spread}
        )
    return plot._asdict() | {"lines": lines}


def _panel(name: str, title: str, *box: float, **more: Any) -> dict[str, Any]:
    """Describe a panel whose ``box`` is (left, right, top, bottom).

    If ``scaled`` is set, line widths are in the box's unit.
    """
    return {"name": name, "title": title, "box": box, **more}


def _flat(points: FloatArray) -> FloatArray:
    """Return x and y alternately, rounded to four decimals (less than a tenth of a pixel)."""
    return np.clip(points, -_NUMBER_MAX, _NUMBER_MAX).round(4).ravel()


def _packed(shown: dict[str, Any] | list[Any]) -> str:
    return orjson.dumps(shown, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _image(levels: NDArray[np.integer[Any]], *box: float) -> dict[str, Any]:
    data = base64.b64encode(levels.astype(np.uint8).tobytes()).decode()
    return {"rows": len(levels), "cols": len(levels[0]), "data": data, "box": box}
