"""The stream's messages as what a page draws: one picture for all pages, whole each time.

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

from softfinger.daemon.control.modes import COMMANDS
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.feed import Feed, number
from softfinger.tools.terminal.typeset import micro, short
from softfinger.tools.viewing import planar
from softfinger.tools.viewing.known import HEIGHT, WIDTH, ShownHand
from softfinger.tools.viewing.live_stream import Viewer
from softfinger.tools.viewing.planar import COLOURS, GOAL, LATE, LEVELS, OBJECT, touches

SECONDS = 12.0  # of the past in the plots
_STEP = 0.1  # s from one column of the plots to the next
_EVENTS = 30  # shown
_LATELY = 5.0  # s for which a warning counts as present
_WHITE = (255, 255, 255)
_OUTSIDE = (112, 112, 116)  # where no such contact can be
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
_PLOTS = {  # title: factor, fields of `hand/state`; {}_std is a deviation, where there is one
    "Force [N]": (1.0, "left.force right.force goal_force"),
    "Displacement d [mm]": (1e3, "left.d right.d"),
    "Object's angle [°]": (_DEGREE, "object.angle goal_angle"),
    "Tilt θ [°]": (_DEGREE, "left.theta right.theta"),
    "Energy [mJ]": (1e3, "left.energy right.energy"),
    "Joints [°]": (_DEGREE, "left.q right.q left.goal_q right.goal_q"),
    "Currents [A]": (1.0, "left.current right.current left.goal_current right.goal_current"),
    "Tick [µs]": (1e6, "compute_s wake_late_s"),
}
_SERVOS = ("q", "goal_q", "current", "goal_current")  # what a hand without servos lacks
_OTHERS = {  # names and colours of lines that are no finger's
    "object.angle": ("object", OBJECT),
    "compute_s": ("work", OBJECT),
    "wake_late_s": ("late", LATE),
}
_BOUNDED = ("force", "d", "current", "temperature")  # of a finger, each by `safety.…_max`


class Pictures(Viewer):
    """Gives ``publish`` the scene and each picture, where it is ``watched``.

    Times are the machine's of a ``live`` stream, the messages' of a recording.
    """

    def __init__(
        self,
        publish: Callable[[bytes, bytes], None],
        watched: Callable[[], bool],
        say: Callable[[str], None],
        *,
        live: bool = True,
    ) -> None:
        self._publish = publish
        self._watched = watched
        self._live = live
        super().__init__(say)

    def clear(self) -> None:
        """Forget all but the hand: what comes next is of another time."""
        self.feed = Feed()
        self._columns: deque[list[Any]] = deque(maxlen=round(SECONDS / _STEP))
        self._trails = {name: deque[tuple[float, float]](maxlen=60) for name in FINGERS}
        self._pressure = heatmap.FullScale(5e3)
        super().clear()

    def _moment(self) -> float:
        return time.monotonic() if self._live else self.time

    def take(self, topic: bytes, message: Any) -> bool:
        """Take one message of any content."""
        state, when = self.feed.state, self.time
        if not super().take(topic, message):
            return False
        if topic == schema.STATE and number(message, "seq") < state.seq:
            self._columns.clear()  # they are another daemon's
            for trail in self._trails.values():
                trail.clear()
        elif topic == schema.STATE and 0.0 <= when // _STEP != self.time // _STEP:
            self._columns.append(self._column(when))  # the last state of a step stays
            for name, trail in self._trails.items():
                finger = state.finger(name)
                if touches(finger):
                    trail.append((finger.d, finger.theta))
                else:
                    trail.clear()
        self.feed.sort_in(topic, message, self._moment())
        return True

    def know(self, hand: ShownHand) -> None:
        """Lay out the scene of a hand: panels and plots of what it has, and no others."""
        super().know(hand)
        self._columns.clear()
        self._fields: list[tuple[str, float]] = []  # what the plots' columns hold, and its factor
        a = hand.geometry.tip_radius
        half, top = hand.geometry.half_separation + 1.3 * a, hand.geometry.reach + 1.9 * a
        panels = [_panel("hand", "Hand", -half, half, top, -0.4 * a, scaled=True)]
        if hand.sensors:
            box = 0, hand.settings.tactile.cols, 0, hand.settings.tactile.rows
            maps = [_panel(name, f"Pressure, {name} tip", *box) for name in hand.fingers]
            panels = [*maps[:1], *panels, *maps[1:]]
        self._landscape = landscape = hand.landscape()
        if landscape is not None:
            texts = [(GOAL, *_flat(place), words) for place, words in landscape.ticks()]
            still = {"image": _image(landscape.picture()), "texts": texts}
            box = -30, WIDTH + 8, -6, HEIGHT + 14
            panels.append(_panel("landscape", "Energy landscape U(d, θ)", *box, still=still))
        plots = [{"title": name, "lines": self._lines(*of)} for name, of in _PLOTS.items()]
        scene = {
            "seconds": SECONDS,
            "panels": panels,
            "plots": [plot for plot in plots if plot["lines"]],
            "modes": _MODES,
            "levels": LEVELS,
            "palette": [*heatmap.colour_map(), _OUTSIDE],
            "commands": {name: list(modes) for name, (modes, _) in COMMANDS.items()},
        }
        self._scene = orjson.dumps(scene)

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
            std = [f"{path}_std"] if hasattr(self.feed.state.left, f"{key}_std") else []
            columns = [len(self._fields) + 2 + k for k in range(1 + len(std))]  # after time, mode
            self._fields += [(each, factor) for each in (path, *std)]
            lines.append({"name": name, "colour": colour, "goal": goal, "columns": columns})
        return lines

    def _column(self, when: float) -> list[Any]:
        state = self.feed.state
        row: list[Any] = [when, self.feed.mode]
        for path, factor in self._fields:
            known = path != "object.angle" or state.object.valid
            value = attrgetter(path)(state) if known else math.nan
            row.append(float(f"{factor * value:.5g}"))
        return row

    def draw(self, place: tuple[float, float, bool] | None = None) -> None:
        """Publish a picture of what has come so far, where anybody looks.

        ``place``: of a recording the position and duration [s], and whether it plays.
        """
        if not self._watched():
            return
        now, feed, state = self._moment(), self.feed, self.feed.state
        angle = state.goal_angle if math.isfinite(state.goal_angle) else state.object.angle
        picture = {
            "now": time.monotonic(),
            "time": self.time,
            "seq": state.seq,
            "mode": feed.mode,
            "status": feed.status(now) if self._live else "recording",
            "fault": feed.fault,
            "place": place,
            "angle": math.degrees(angle),
            "force_max": feed.force_limit,
            "limits": self._limits(),
            "facts": self._facts(now),
            "panels": {"hand": self._hand(), "landscape": self._contacts(), **self._maps(now)},
            "columns": [*self._columns, self._column(self.time)],
            "events": [(each.clock(), *each[1:]) for each in feed.events[-_EVENTS:]],
        }
        self._publish(self._scene, orjson.dumps(picture))

    def _hand(self) -> dict[str, Any]:
        truth = self.newest.get(schema.TRUTH)
        every = planar.hand_parts(self.hand, self.feed.state, truth).values()
        strips = [strip for part in every for strip in part.strips]
        lines = [(strip.colour, 1e-3 * strip.width, _flat(strip.points)) for strip in strips]
        texts = []
        for push in (push for part in every for push in part.pushes):
            end, back = push.at + push.way, -0.2 * push.way
            side = 0.6 * np.array([-back[1], back[0]])
            arrow = np.array([push.at, end, end + back + side, end, end + back - side])
            lines.append((push.colour, 1.8e-3, _flat(arrow)))
            texts.append((push.colour, *_flat(push.at - (0.0, 0.02)), push.text))
        return {"lines": lines, "texts": texts}

    def _maps(self, now: float) -> dict[str, Any]:
        """Each tip's frame with its rim, and footprint and centroid of the contact."""
        frames = self.feed.frames
        peak = max((float(frame.grid.max()) for frame in frames.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        maps = {}
        for name, frame in frames.items():
            unit, factor = ("counts", 1.0) if math.isnan(frame.scale) else ("kPa", 1e-3)
            lines, dots = [], []
            grid, radius = planar.grid_of(frame.source), self.hand.settings.tip.radius
            if grid is not None:
                lines.append((COLOURS[name], 1.0, _flat(planar.tip_circle(grid, radius))))
            contact = self.feed.state.finger(name)
            if grid is not None and touches(contact):
                tilts = contact.theta, contact.tilt_y if math.isfinite(contact.tilt_y) else 0.0
                place = planar.footprint(grid, radius, contact.d, *tilts)
                if place is not None:
                    lines.append((_WHITE, 1.5, _flat(place.outline)))
                    dots.append((COLOURS[name], *_flat(place.centroid)))
            maps[name] = {
                "image": _image(heatmap.levels_of(frame.grid, full).astype(np.uint8)),
                "lines": lines,
                "dots": dots,
                "note": f"peak {factor * frame.grid.max():.1f} of {factor * full:g} {unit}",
            }
        return maps

    def _contacts(self) -> dict[str, Any]:
        """Each contact on the landscape, with its trail."""
        lines, dots = [], []
        for name in self.hand.fingers:
            contact = self.feed.state.finger(name)
            if touches(contact) and self._landscape is not None:
                trail = np.array([*self._trails[name], (contact.d, contact.theta)])
                places = self._landscape.place(*trail.T)
                lines.append((COLOURS[name], 2.0, _flat(places)))
                dots.append((COLOURS[name], *_flat(places[-1])))
        highest = math.nan if self._landscape is None else 1e3 * self._landscape.highest
        return {"lines": lines, "dots": dots, "note": f"0 to {short(highest, 0)} mJ, ∝ ∛U"}

    def _limits(self) -> str:
        """Return what holds the hand back: a recent warning, the grip's goal, the nearest limit."""
        state, safety = self.feed.state, self.hand.settings.safety
        last = [each for each in self.feed.events[-1:] if each.level == "warning"]
        parts = [each.text for each in last if self.time - each.timestamp < _LATELY]
        if math.isfinite(state.goal_force):
            asked = self.feed.commanded
            raised = f", raised from {asked:.1f} N" if state.goal_force > 1.01 * asked else ""
            parts.append(f"grip: goal {state.goal_force:.1f} N{raised}")
        used = [
            (value / getattr(safety, f"{key}_max"), name, key)
            for name in self.hand.fingers
            for key in _BOUNDED
            if math.isfinite(value := abs(getattr(getattr(state, name), key)))
        ]
        for ratio, name, key in sorted(used)[-1:]:
            parts.append(f"nearest limit: {name} {key} at {ratio:.0%} of safety.{key}_max")
        return " · ".join(parts)

    def _facts(self, now: float) -> list[str]:
        """Small facts, one cell each: tick and its times, frames, servos, losses, commander."""
        feed, state = self.feed, self.feed.state
        fingers = [getattr(state, name) for name in self.hand.fingers]

        def each(key: str, factor: float, decimals: int) -> str:
            return " / ".join(short(factor * getattr(finger, key), decimals) for finger in fingers)

        facts = [f"overruns {state.overruns}"]
        if (times := feed.times) is not None:
            stages = {"work": times.compute, "late": times.wake}
            for name, of in {**stages, "bus": times.bus, "publish": times.publish}.items():
                spread = ", ".join(micro(value) for value in (of.p50, of.p99, of.p999, of.max))
                facts.append(f"{name} [µs] p50, 99, 99.9, max: {spread}")
            rates = times.rates
            facts.insert(0, f"tick {short(rates.tick, 0)} Hz")
            facts.append(f"frames {short(rates.left, 0)} / {short(rates.right, 0)} Hz")
        who = feed.commander(now)
        return [
            *facts,
            f"frames {each('frame_age_s', 1e3, 0)} ms old",
            f"servos {each('temperature', 1.0, 0)} °C, {each('voltage', 1.0, 1)} V",
            f"object {short(1e3 * state.object.width, 1)} mm wide",
            f"{sum(gaps.lost for gaps in self.gaps.values())} lost, {feed.skipped} unreadable",
            *([f"{who} commands"] if who else []),
        ]


def _panel(name: str, title: str, *box: float, **more: Any) -> dict[str, Any]:
    """``box``: left, right, top, bottom; ``scaled``: lines' widths have its unit."""
    return {"name": name, "title": title, "box": box, **more}


def _flat(points: NDArray[np.float64]) -> list[float]:
    """x and y in turn; four decimals are a tenth of a pixel or less, in metres, too."""
    flat: list[float] = np.clip(points, -1e6, 1e6).round(4).ravel().tolist()
    return flat


def _image(levels: NDArray[np.uint8]) -> dict[str, Any]:
    rows, cols = levels.shape
    return {"rows": rows, "cols": cols, "data": base64.b64encode(levels.tobytes()).decode()}
