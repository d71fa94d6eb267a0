"""From the stream's messages to what a page draws: one picture for all pages, whole each time.

A picture is JSON: lines, dots, texts and images of each panel, and the last seconds of the plots.
Nothing in it refers to an earlier one, so that a page may miss as many as it likes. What stands
still, as the energy landscape, is the scene, which has a number.
"""

from __future__ import annotations

import base64
import math
import time
from collections import deque
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.feed import Feed, number, printable, text
from softfinger.tools.terminal.typeset import micro, short
from softfinger.tools.viewing.known import (
    HEIGHT,
    WIDTH,
    Landscape,
    ShownHand,
    palette,
    read_settings,
)
from softfinger.tools.viewing.live_stream import TOPICS
from softfinger.tools.viewing.planar import (
    COLOURS,
    GOAL,
    LATE,
    LEVELS,
    OBJECT,
    Colour,
    HandScene,
    Push,
    footprint,
    grid_of,
    tip_circle,
    touch,
)

SECONDS = 12.0  # of the past in the plots
_STEP = 0.1  # s from one column of the plots to the next
_EVENTS = 30  # shown
_LATELY = 5.0  # s for which a warning counts as present
_WHITE = (255, 255, 255)
_DEGREE = math.degrees(1.0)
_MODES = {
    "disarmed": (120, 120, 120),
    "armed": (86, 140, 190),
    "moving": (120, 100, 190),
    "grasping": (230, 160, 30),
    "holding": (0, 158, 115),
    "rotating": (60, 170, 210),
    "releasing": (190, 150, 90),
    "fault": (214, 54, 40),
}
_PLOTS = (  # title, factor, fields of `hand/state`; {}_std is a deviation, where there is one
    ("Force [N]", 1.0, "left.force right.force goal_force"),
    ("Displacement d [mm]", 1e3, "left.d right.d"),
    ("Object's angle [°]", _DEGREE, "object.angle goal_angle"),
    ("Tilt θ [°]", _DEGREE, "left.theta right.theta"),
    ("Energy [mJ]", 1e3, "left.energy right.energy goal_energy"),
    ("Joints [°]", _DEGREE, "left.q right.q left.goal_q right.goal_q"),
    ("Currents [A]", 1.0, "left.current right.current left.goal_current right.goal_current"),
    ("Tick [µs]", 1e6, "compute_s wake_late_s"),
)
_SERVOS = ("q", "goal_q", "current", "goal_current")  # what a hand without servos lacks
_OTHERS = {  # names and colours of lines that are no finger's
    "object.angle": ("object", OBJECT),
    "compute_s": ("work", OBJECT),
    "wake_late_s": ("late", LATE),
}
_BOUNDS = {  # fields of a finger, and what bounds them in the section `safety`
    "force": "force_max",
    "d": "d_max",
    "current": "current_max",
    "temperature": "temperature_max",
}


class Pictures:
    """Takes messages (`live_stream.Taker`), and gives ``publish`` the scene and each picture.

    ``watched`` tells whether anybody looks: without, nothing is drawn. ``shown`` counts states.
    Times are the machine's of a ``live`` stream, the messages' of a recording.
    """

    def __init__(
        self,
        publish: Callable[[bytes, bytes], None],
        watched: Callable[[], bool],
        say: Callable[[str], None] = lambda _: None,
        *,
        live: bool = True,
    ) -> None:
        self._publish = publish
        self._watched = watched
        self._say = say
        self._live = live
        self._same_schema = True
        self._known = ""  # the settings, as they came
        self.unreadable = 0
        self.shown = 0
        self.hand = ShownHand()
        self.clear()
        self._know(self.hand)

    def clear(self) -> None:
        """Forget all but the hand: what comes next is of another time."""
        self.feed = Feed()
        self.time = math.nan
        self._parts = HandScene(self.hand)
        self._state: dict[str, Any] = {}
        self._truth: dict[str, Any] | None = None
        self._frames: dict[str, dict[str, Any]] = {}
        self._columns: deque[list[Any]] = deque(maxlen=round(SECONDS / _STEP))
        self._trails: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=60) for name in FINGERS
        }
        self._pressure = heatmap.FullScale(5e3)
        self._gaps = {topic: Gaps() for topic in TOPICS}

    def _moment(self) -> float:
        return time.monotonic() if self._live else self.time

    def take(self, topic: bytes, message: Any) -> None:
        """One message, whatever it holds."""
        if topic not in self._gaps:
            return
        when = number(message, "timestamp")
        if not 0.0 <= when < 2.0**33:
            self.unreadable += 1
            return
        self._gaps[topic].take(message)
        if message.get("schema") != schema.SCHEMA and self._same_schema:
            self._same_schema = False
            self._say(
                f"the stream is of schema {message.get('schema')!r:.20}, this viewer knows "
                f"{schema.SCHEMA}; it keeps to the fields it knows"
            )
        if topic == schema.STATE:
            if number(message, "seq") < number(self._state, "seq"):  # another daemon's
                self._columns.clear()
                for trail in self._trails.values():
                    trail.clear()
            self.time, self._state = when, message
            self.shown += 1
        self.feed.sort_in(topic, message, self._moment())
        if topic == schema.STATE:
            self._take_column(when)
        elif topic == schema.TACTILE:
            self._frames[text(message, "finger")] = message
        elif topic == schema.TRUTH:
            self._truth = message
        elif topic == schema.SETTINGS and text(message, "settings") != self._known:
            self._known = text(message, "settings")
            settings, unknown = read_settings(message)
            if unknown:
                version = text(message, "version") or "another version"
                keys = printable(", ".join(unknown))
                self._say(f"settings of {version} that are not known here: {keys}")
            self._know(ShownHand(settings))

    def _know(self, hand: ShownHand) -> None:
        """Lay out the scene of a hand: panels and plots of what it has, and no others."""
        self.hand = hand
        self._parts = HandScene(hand)
        self._landscape = hand.landscape()
        self._columns.clear()
        self._fields: list[tuple[str, float]] = []  # what the plots' columns hold, and its factor
        a = hand.geometry.tip_radius
        half, top = hand.geometry.half_separation + 1.3 * a, hand.geometry.reach + 1.9 * a
        panels = [_panel("hand", "Hand", -half, half, top, -0.4 * a, scaled=True)]
        if hand.sensors:
            rows, cols = hand.settings.tactile.rows, hand.settings.tactile.cols
            maps = [
                _panel(name, f"Pressure, {name} tip", 0, cols, 0, rows) for name in hand.fingers
            ]
            panels = [*maps[:1], *panels, *maps[1:]]
        if self._landscape is not None:
            box = -30.0, WIDTH + 8.0, -6.0, HEIGHT + 14.0
            still = self._still(self._landscape)
            panels.append(_panel("landscape", "Energy landscape U(d, θ)", *box, still=still))
        plots = [
            {"title": title, "lines": self._lines(factor, fields)}
            for title, factor, fields in _PLOTS
        ]
        self._scene = orjson.dumps(
            {
                "seconds": SECONDS,
                "panels": panels,
                "plots": [plot for plot in plots if plot["lines"]],
                "modes": {name: _css(colour) for name, colour in _MODES.items()},
                "levels": {name: _css(colour) for name, colour in LEVELS.items()},
                "palettes": {"pressure": heatmap.colour_map(), "energy": palette().tolist()},
            }
        )

    def _lines(self, factor: float, fields: str) -> list[dict[str, Any]]:
        """A plot's lines: name, colour, and the columns of values and of their deviations."""
        lines = []
        hand = self.hand
        for path in fields.split():
            finger, _, key = path.rpartition(".")
            if (
                (finger in FINGERS and finger not in hand.fingers)
                or (key in _SERVOS and not hand.servos)
                or (path in ("object.angle", "goal_angle") and len(hand.fingers) < 2)
            ):
                continue
            goal = " goal" if key.startswith("goal") else ""
            name, colour = _OTHERS.get(path, ((finger + goal).strip(), COLOURS.get(finger, GOAL)))
            spread = [f"{path}_std"] if hasattr(self.feed.state.left, f"{key}_std") else []
            first = len(self._fields) + 2  # after the time and the mode
            self._fields += [(each, factor) for each in (path, *spread)]
            columns = list(range(first, len(self._fields) + 2))
            lines.append({"name": name, "colour": _css(colour), "goal": goal, "columns": columns})
        return lines

    def _still(self, landscape: Landscape) -> dict[str, Any]:
        contours = [each for each in landscape.contours() if len(each.line) > 1]
        labels = [
            (each.line[len(each.line) // 8], f"{1e3 * each.energy:g} mJ") for each in contours
        ]
        return {
            "image": _image(landscape.picture(), "energy"),
            "lines": [_line(each.line, "#ffffff90", 1.0) for each in contours],
            "texts": [_text(*each, _WHITE) for each in labels]
            + [_text(*each, GOAL) for each in landscape.ticks()],
        }

    def _take_column(self, when: float) -> None:
        """The newest state is the last column, and stays when the next step begins."""
        state, columns = self.feed.state, self._columns
        if columns and when // _STEP == columns[-1][0] // _STEP:
            columns.pop()
        elif columns:
            for name, trail in self._trails.items():
                contact = touch(self._state, name)
                if contact is None:
                    trail.clear()
                else:
                    trail.append((contact.d, contact.theta))
        row: list[Any] = [when, self.feed.mode]
        for path, factor in self._fields:
            value: Any = math.nan
            if path == "goal_energy" and self._landscape is not None:
                value = self._landscape.energy_of(np.array(state.goal_force))
            elif path != "goal_energy" and (path != "object.angle" or state.object.valid):
                value = attrgetter(path)(state)
            row.append(float(f"{factor * value:.5g}"))
        columns.append(row)

    def draw(self, last: bool = False) -> None:
        """Publish a picture of what has come so far, where anybody looks."""
        if not self._watched():
            return
        now, feed = self._moment(), self.feed
        picture = {
            "time": self.time,
            "seq": feed.state.seq,
            "mode": feed.mode,
            "status": feed.status(now) if self._live else "recording",
            "fault": feed.fault,
            "limits": self._limits(),
            "facts": self._facts(now),
            "panels": {"hand": self._hand(), "landscape": self._contacts(), **self._maps(now)},
            "columns": list(self._columns),
            "events": [
                (each.clock(), each.level, each.kind, each.text) for each in feed.events[-_EVENTS:]
            ],
        }
        self._publish(self._scene, orjson.dumps(picture))

    def _hand(self) -> dict[str, Any]:
        parts = self._parts.parts(self._state)
        every = [*parts.values(), self._parts.simulated(self._truth)]
        pushes = [push for part in every for push in part.pushes]
        lines = [
            _line(strip.points, _css(strip.colour), 1e-3 * strip.width)
            for part in every
            for strip in part.strips
        ]
        return {
            "lines": [*lines, *(_arrow(push) for push in pushes)],
            "texts": [_text(push.at - (0.0, 0.02), push.text, push.colour) for push in pushes],
        }

    def _maps(self, now: float) -> dict[str, Any]:
        """Each tip's frame with its rim, and footprint and centroid of the contact."""
        frames = {name: each for name, each in self.feed.frames.items() if name in self._frames}
        peak = max((float(frame.grid.max()) for frame in frames.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        maps = {}
        for name, frame in frames.items():
            counts = math.isnan(frame.scale)
            unit, factor = ("counts", 1.0) if counts else ("kPa", 1e-3)
            levels = heatmap.levels_of(frame.grid, full).astype(np.uint8)
            drawn: dict[str, Any] = {"image": _image(levels, "pressure"), "lines": [], "dots": []}
            drawn["note"] = f"peak {factor * frame.grid.max():.1f} of {factor * full:g} {unit}"
            grid, radius = grid_of(self._frames[name]), self.hand.settings.tip.radius
            contact = touch(self._state, name)
            if grid is not None:
                drawn["lines"].append(_line(tip_circle(grid, radius), _css(COLOURS[name]), 1.0))
            if grid is not None and contact is not None:
                tilt_y = number(self._state, name, "tilt_y")
                tilt_y = tilt_y if math.isfinite(tilt_y) else 0.0
                place = footprint(grid, radius, contact.d, contact.theta, tilt_y)
                if place is not None:
                    drawn["lines"].append(_line(place.outline, _css(_WHITE), 1.5))
                    drawn["dots"].append(_dot(place.centroid, COLOURS[name]))
            maps[name] = drawn
        return maps

    def _contacts(self) -> dict[str, Any]:
        """Each contact on the landscape, with its trail."""
        lines, dots = [], []
        for name in self.hand.fingers:
            contact = touch(self._state, name)
            if contact is None or self._landscape is None:
                continue
            trail = np.array([*self._trails[name], (contact.d, contact.theta)])
            places = self._landscape.place(trail[:, 0], trail[:, 1])
            lines.append(_line(places, _css(COLOURS[name]), 2.0))
            dots.append(_dot(places[-1], COLOURS[name]))
        return {"lines": lines, "dots": dots}

    def _limits(self) -> str:
        """What holds the hand back: a recent warning, the grip's goal, and the nearest limit."""
        state, safety = self.feed.state, self.hand.settings.safety
        parts = [
            each.text
            for each in self.feed.events[-1:]
            if each.level == "warning" and self.time - each.timestamp < _LATELY
        ]
        if math.isfinite(state.goal_force):
            asked = self.feed.commanded
            raised = f", raised from {asked:.1f} N" if state.goal_force > 1.01 * asked else ""
            parts.append(f"grip: goal {state.goal_force:.1f} N{raised}")
        used = {
            f"{name} {key} at {{:.0%}} of safety.{bound}": value / getattr(safety, bound)
            for name in self.hand.fingers
            for key, bound in _BOUNDS.items()
            if math.isfinite(value := abs(getattr(getattr(state, name), key)))
        }
        if used:
            nearest = max(used, key=lambda words: used[words])
            parts.append("nearest limit: " + nearest.format(used[nearest]))
        return " · ".join(parts)

    def _facts(self, now: float) -> list[str]:
        """Small facts, one cell each: tick and its times, frames, servos, losses, commander."""
        feed, state = self.feed, self.feed.state
        ticks, times = feed.statistics(now), feed.times
        fingers = [getattr(state, name) for name in self.hand.fingers]

        def each(key: str, factor: float, decimals: int) -> str:
            return " / ".join(short(factor * getattr(finger, key), decimals) for finger in fingers)

        facts = [f"tick {short(ticks.rate, 0)} Hz", f"overruns {state.overruns}"]
        if times is not None:
            spreads = (times.compute, times.wake, times.bus, times.publish)
            for name, of in zip(("work", "late", "bus", "publish"), spreads, strict=True):
                spread = ", ".join(micro(value) for value in (of.p50, of.p99, of.p999, of.max))
                facts.append(f"{name} [µs] p50, 99, 99.9, max: {spread}")
            rates = short(times.rates.left, 0), short(times.rates.right, 0)
            facts.append(f"frames {' / '.join(rates)} Hz")
        facts += [
            f"frames {each('frame_age_s', 1e3, 0)} ms old",
            f"servos {each('temperature', 1.0, 0)} °C, {each('voltage', 1.0, 1)} V",
            f"object {short(1e3 * state.object.width, 1)} mm wide",
            f"{sum(gaps.lost for gaps in self._gaps.values())} lost, {feed.skipped} unreadable",
        ]
        who = feed.commander(now)
        return [*facts, f"{who} commands"] if who else facts


def _panel(name: str, title: str, *box: float, **more: Any) -> dict[str, Any]:
    """``box``: left, right, top, bottom; ``scaled``: lines' widths have its unit."""
    return {"name": name, "title": title, "box": box, **more}


def _css(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _flat(points: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.5g}") for value in np.ravel(points).tolist()]


def _line(points: NDArray[np.float64], colour: str, width: float) -> list[Any]:
    return [colour, width, _flat(points)]


def _dot(place: NDArray[np.float64], colour: Colour) -> list[Any]:
    return [_css(colour), *_flat(place)]


def _text(place: NDArray[np.float64], words: str, colour: Colour) -> list[Any]:
    return [_css(colour), *_flat(place), words]


def _arrow(push: Push) -> list[Any]:
    end, back = push.at + push.way, -0.2 * push.way
    side = np.array([-back[1], back[0]])
    points = np.array([push.at, end, end + back + 0.6 * side, end, end + back - 0.6 * side])
    return _line(points, _css(push.colour), 1.8e-3)


def _image(levels: NDArray[np.uint8], colours: str) -> dict[str, Any]:
    rows, cols = levels.shape
    data = base64.b64encode(levels.tobytes()).decode()
    return {"rows": rows, "cols": cols, "palette": colours, "data": data}
