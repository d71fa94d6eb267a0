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
from collections.abc import Callable, Sequence
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
from softfinger.tools.viewing.known import HEIGHT, WIDTH, ShownHand, palette, read_settings
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
# Title, factor, fields of each finger (the second is dashed; {}_std is its deviation, where the
# stream has one), and other lines: name, field, colour.
_PLOTS: tuple[tuple[str, float, str, tuple[tuple[str, str, Colour], ...]], ...] = (
    ("Force [N]", 1.0, "force", (("goal", "goal_force", GOAL),)),
    ("Displacement d [mm]", 1e3, "d", ()),
    (
        "Object's angle [°]",
        _DEGREE,
        "",
        (("object", "object.angle", OBJECT), ("goal", "goal_angle", GOAL)),
    ),
    ("Tilt θ [°]", _DEGREE, "theta", ()),
    ("Energy [mJ]", 1e3, "energy", (("goal", "goal_energy", GOAL),)),
    ("Joints [°]", _DEGREE, "q goal_q", ()),
    ("Currents [A]", 1.0, "current goal_current", ()),
    ("Tick [µs]", 1e6, "", (("work", "compute_s", OBJECT), ("late", "wake_late_s", LATE))),
)
_BOUNDS = (  # field of a finger, setting in `safety`, factor, unit
    ("force", "force_max", 1.0, "N"),
    ("d", "d_max", 1e3, "mm"),
    ("current", "current_max", 1.0, "A"),
    ("temperature", "temperature_max", 1.0, "°C"),
)


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
        self._scenes = 0
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
        """Lay out the scene of a hand: panels for what it has, and no others."""
        self.hand = hand
        self._parts = HandScene(hand)
        self._landscape = hand.landscape()
        self._columns.clear()
        self._scenes += 1
        self._lines: list[tuple[str, float]] = []  # field and factor of each column
        plots = []
        for title, factor, fields, others in _PLOTS:
            if ("goal_q" in fields or "current" in fields) and not hand.servos:
                continue
            if "Object" in title and len(hand.fingers) < 2:
                continue
            lines = [
                (name + " goal" * dashed, f"{name}.{key}", COLOURS[name], dashed)
                for dashed, key in enumerate(fields.split())
                for name in hand.fingers
            ] + [(name, key, colour, name == "goal") for name, key, colour in others]
            plots.append({"title": title, "lines": [self._line(factor, *each) for each in lines]})
        geometry = hand.geometry
        a = geometry.tip_radius
        half, top = geometry.half_separation + 1.3 * a, geometry.reach + 1.9 * a
        panels = [_panel("hand", "Hand", (-half, half, top, -0.4 * a), scaled=True)]
        if hand.sensors:
            tactile = hand.settings.tactile
            box = (0.0, tactile.cols, 0.0, tactile.rows)
            maps = [_panel(name, f"Pressure, {name} tip", box) for name in hand.fingers]
            panels = [*maps[:1], *panels, *maps[1:]]
        if self._landscape is not None:
            box = (-30.0, WIDTH + 8.0, -6.0, HEIGHT + 14.0)
            still = self._still()
            panels.append(_panel("landscape", "Energy landscape U(d, θ)", box, still=still))
        self._scene = orjson.dumps(
            {
                "number": self._scenes,
                "seconds": SECONDS,
                "panels": panels,
                "plots": plots,
                "modes": {name: _css(colour) for name, colour in _MODES.items()},
                "levels": {name: _css(colour) for name, colour in LEVELS.items()},
                "palettes": {"pressure": heatmap.colour_map(), "energy": palette().tolist()},
            }
        )

    def _line(
        self, factor: float, name: str, key: str, colour: Colour, dashed: bool
    ) -> dict[str, Any]:
        """One line of a plot: which column it is, and which its deviation."""
        columns = [len(self._lines) + 2]  # after the time and the mode
        self._lines.append((key, factor))
        if key.rpartition(".")[2] in ("d", "theta", "force"):
            columns.append(len(self._lines) + 2)
            self._lines.append((f"{key}_std", factor))
        return {"name": name, "colour": _css(colour), "dashed": dashed, "columns": columns}

    def _still(self) -> dict[str, Any]:
        assert self._landscape is not None
        contours = [each for each in self._landscape.contours() if len(each.line) > 1]
        labels = [
            (each.line[len(each.line) // 8], f"{1e3 * each.energy:g} mJ") for each in contours
        ]
        return {
            "image": _image(self._landscape.picture(), "energy"),
            "lines": [_line(each.line, "#ffffff90", 1.0) for each in contours],
            "texts": [_text(*each, _WHITE) for each in labels]
            + [_text(*each, GOAL) for each in self._landscape.ticks()],
        }

    def _take_column(self, when: float) -> None:
        """The newest state is the last column; a step later it begins another."""
        state, columns = self.feed.state, self._columns
        if len(columns) > 1 and when - columns[-2][0] < _STEP:
            columns.pop()
        elif columns:
            for name, trail in self._trails.items():
                contact = touch(self._state, name)
                if contact is None:
                    trail.clear()
                else:
                    trail.append((contact.d, contact.theta))
        row: list[Any] = [when, self.feed.mode]
        for key, factor in self._lines:
            if key == "goal_energy":
                force = np.array([state.goal_force])
                known = self._landscape is not None
                value = float(self._landscape.energy_of(force)[0]) if known else math.nan
            else:
                value = attrgetter(key)(state)
            if key == "object.angle" and not state.object.valid:
                value = math.nan
            row.append(float(f"{factor * value:.5g}"))
        columns.append(row)

    def draw(self, last: bool = False) -> None:
        """Publish a picture of what has come so far, where anybody looks."""
        if not self._watched():
            return
        now, feed = self._moment(), self.feed
        panels = {"hand": self._hand(), **self._maps(now)}
        if self._landscape is not None:
            panels["landscape"] = self._contacts()
        picture = {
            "scene": self._scenes,
            "time": self.time,
            "seq": feed.state.seq,
            "mode": feed.mode,
            "status": feed.status(now) if self._live else "recording",
            "fault": feed.fault,
            "limits": self._limits(),
            "facts": self._facts(now),
            "panels": panels,
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
            "texts": [_text(push.at + 1.1 * push.way, push.text, push.colour) for push in pushes],
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
        assert self._landscape is not None
        lines, dots = [], []
        for name in self.hand.fingers:
            contact = touch(self._state, name)
            if contact is None:
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
            asked = self.feed.asked
            raised = f", raised from {asked:.1f} N" if state.goal_force > 1.01 * asked else ""
            parts.append(f"grip: goal {state.goal_force:.1f} N{raised}")
        near = []
        for name in self.hand.fingers:
            for key, setting, factor, unit in _BOUNDS:
                value, bound = abs(getattr(getattr(state, name), key)), getattr(safety, setting)
                words = (
                    f"{name} {key} at {100.0 * value / bound:.0f} % of {factor * bound:g} {unit}"
                )
                near.append((value / bound, words))
        known = [each for each in near if math.isfinite(each[0])]
        return " · ".join([*parts, *(f"nearest limit: {max(known)[1]}" for _ in known[:1])])

    def _facts(self, now: float) -> list[str]:
        """Small facts, one cell each: tick and its times, frames, servos, losses, commander."""
        feed, state = self.feed, self.feed.state
        ticks, times = feed.statistics(now), feed.times
        fingers = [getattr(state, name) for name in self.hand.fingers]

        def each(key: str, factor: float, decimals: int) -> str:
            return " / ".join(short(factor * getattr(finger, key), decimals) for finger in fingers)

        facts = [
            f"tick {short(ticks.rate, 0)} Hz",
            f"overruns {state.overruns}",
            f"work {micro(ticks.compute)} µs",
            f"late {micro(ticks.late)} µs",
        ]
        if times is not None:
            spreads = (("work", times.compute), ("late", times.wake), ("bus", times.bus))
            spreads += (("publish", times.publish),)
            facts += [
                f"{name} p50 {micro(each.p50)}, p99 {micro(each.p99)}, p99.9 {micro(each.p999)}, "
                f"max {micro(each.max)} µs"
                for name, each in spreads
            ]
            facts.append(f"frames {short(times.rates.left, 0)} / {short(times.rates.right, 0)} Hz")
        facts += [
            f"frames {each('frame_age_s', 1e3, 0)} ms old",
            f"servos {each('temperature', 1.0, 0)} °C, {each('voltage', 1.0, 1)} V",
            f"object {short(1e3 * state.object.width, 1)} mm wide" if state.object.valid else "",
            f"{sum(gaps.lost for gaps in self._gaps.values())} lost, {feed.skipped} unreadable",
            f"{feed.commander(now)} commands" if feed.commander(now) else "",
        ]
        waited = feed.waited(now)
        if waited > 0.05:
            facts.append(f"this machine is busy: the simulated hand runs {waited:.2f} s behind")
        return [fact for fact in facts if fact]


def _panel(name: str, title: str, box: Sequence[float], **more: Any) -> dict[str, Any]:
    """``box``: left, right, top, bottom; lines are ``scaled`` where widths have its unit."""
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
