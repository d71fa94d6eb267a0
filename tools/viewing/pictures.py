"""The stream's messages as what a page draws: one picture for all pages, whole each time.

A picture is JSON: lines, dots, texts and images of each panel, and the last seconds of the plots.
Nothing in it refers to an earlier one, so that a page may miss as many as it likes. What stands
still, as the energy landscape, is the scene.
"""

from __future__ import annotations

import base64
import math
import time
from collections import deque
from collections.abc import Callable
from itertools import groupby, takewhile
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.control.modes import COMMANDS
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import geometry_of
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.feed import Feed, number, printable, text
from softfinger.tools.terminal.typeset import micro, short
from softfinger.tools.viewing import planar
from softfinger.tools.viewing.known import THETA_END, fingers_of, landscape, read_settings
from softfinger.tools.viewing.planar import COLOURS, GOAL, OBJECT, Colour, FloatArray, touches

if TYPE_CHECKING:
    from softfinger.tools.viewing.foxglove_server import Foxglove

TOPICS = (*Feed().topics, schema.TRUTH)
SECONDS = 12.0  # of the past in the plots
_STEP = 0.2  # s from one column of the plots to the next
_TRAIL = 30  # of these columns on the landscape
_EVENTS = 30  # shown
_LATELY = 5.0  # s for which a warning counts as present
_LATE = (204, 96, 150)
_WHITE = (255, 255, 255)
_GRID = (44, 48, 64)
_OUTSIDE = (112, 112, 116)  # where no such contact can be
_MOST = 1e6  # of what is drawn; a stranger's numbers are of any size
_DEGREE = math.degrees(1.0)
_LEVELS = {"info": (120, 120, 120), "warning": (214, 140, 0), "error": (214, 54, 40)}
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
_PLOTS = {  # title: factor, fields of `hand/state`
    "Force [N]": (1.0, "left.force right.force goal_force"),
    "Displacement d [mm]": (1e3, "left.d right.d"),
    "Object's angle [°]": (_DEGREE, "object.angle goal_angle"),
    "Tilt θ [°]": (_DEGREE, "left.theta right.theta"),
    "Energy [mJ]": (1e3, "left.energy right.energy"),
    "Joints [°]": (_DEGREE, "left.q right.q left.goal_q right.goal_q"),
    "Currents [A]": (1.0, "left.current right.current left.goal_current right.goal_current"),
    "Tick [µs]": (1e6, "compute_s wake_late_s"),
}
_SERVOS = ("q", "current")  # what a hand without servos lacks
_DEVIATED = ("force", "d", "theta")  # fields of a finger whose {}_std is drawn, too
_OTHERS = {  # names and colours of lines that are no finger's
    "object.angle": ("object", OBJECT),
    "compute_s": ("work", OBJECT),
    "wake_late_s": ("late", _LATE),
}
_BOUNDED = ("force", "d", "current", "temperature")  # of a finger, each by `safety.…_max`
_PATHS = [path for _, paths in _PLOTS.values() for path in paths.split()]
_PATHS += [f"{side}.{key}_std" for side in FINGERS for key in _DEVIATED]
_row = attrgetter("timestamp", "object.valid", *_PATHS)


class Pictures:
    """Takes messages of any content, and gives ``publish`` the scene and each picture.

    ``watched``: whether anybody looks. ``say`` is told what can't be read. Times are the machine's
    of a ``live`` stream, the messages' of a recording. ``foxglove`` is given what is taken, too.
    """

    def __init__(
        self,
        publish: Callable[[str, str], None],
        watched: Callable[[], bool],
        say: Callable[[str], None],
        *,
        live: bool = True,
        foxglove: Foxglove | None = None,
    ) -> None:
        self._publish = publish
        self._watched = watched
        self._say = say
        self._live = live
        self._foxglove = foxglove
        self._settings_text = ""  # as they came
        self.seen = self.unreadable = 0  # states; messages
        self.clear()
        self._know(Settings())

    def clear(self) -> None:
        """Forget all but the hand: what comes next is of another time."""
        self.feed = Feed()
        self.states = 0  # since then
        self.time = math.nan  # of the newest state [Unix s]
        self._truth: dict[str, Any] | None = None
        self._gaps = {topic: Gaps() for topic in TOPICS}
        self._past: deque[tuple[HandState, tuple[float, ...]]] = deque(
            maxlen=round(SECONDS / _STEP)
        )
        self._pressure = heatmap.FullScale(5e3)

    def _moment(self) -> float:
        return time.monotonic() if self._live else self.time

    def take(self, topic: bytes, message: Any) -> None:
        """Take one message of any content."""
        stamp = number(message, "timestamp")
        if topic not in self._gaps or not 0.0 <= stamp < 2.0**32:
            self.unreadable += 1
            return
        if not self._gaps[topic].take(message):
            return
        if topic == schema.STATE:
            if number(message, "seq") < self.feed.state.seq:
                self._past.clear()  # another daemon's
            elif self.states and self.time // _STEP != stamp // _STEP:
                self._past.append((self.feed.state, _row(self.feed.state)))  # the step's last
            self.time = stamp
            self.states += 1
            self.seen += 1
        elif topic == schema.TRUTH:
            self._truth = message
        elif topic == schema.SETTINGS and text(message, "settings") != self._settings_text:
            self._settings_text = text(message, "settings")
            settings, unknown = read_settings(message)
            if unknown:
                self._say(f"settings not known here: {printable(', '.join(unknown))}")
            self._know(settings)
        self.feed.sort_in(topic, message, self._moment())
        if self._foxglove is not None:
            self._foxglove.take(topic, message)

    def _know(self, settings: Settings) -> None:
        """Lay out the scene of a hand: panels and plots of what it has, and no others."""
        self._settings, self._fingers = settings, fingers_of(settings)
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
            texts = [(GOAL, each, -0.06 * end, f"{each:g}°") for each in angles]
            texts += [(GOAL, -1.15 * THETA_END, 1.0 * each, f"{each} mm") for each in depths]
            image = _image(energy.levels, -THETA_END, THETA_END, end, 0.0)
            still = {"image": image, "texts": texts}
            box = -1.3 * THETA_END, 1.05 * THETA_END, 1.05 * end, -0.1 * end
            title = f"Energy U(d, θ) to {1e3 * energy.highest:.0f} mJ, ∝ ∛U"
            panels.append(_panel("landscape", title, *box, still=still))
        every = {
            title: (by, [*filter(self._has, of.split())]) for title, (by, of) in _PLOTS.items()
        }
        self._plots = {title: (by, paths) for title, (by, paths) in every.items() if paths}
        scene = {
            "step": _STEP,
            "panels": [*panels, *(_panel(title, title) for title in self._plots)],
            "modes": _MODES,
            "levels": _LEVELS,
            "palette": [*heatmap.colour_map(), _OUTSIDE],
            "commands": {name: list(modes) for name, (modes, _) in COMMANDS.items()},
        }
        self._scene = _packed(scene)

    def _has(self, path: str) -> bool:
        """Return whether the hand has what is at this path of the state."""
        finger, _, key = path.rpartition(".")
        no_servos = self._settings.servos.backend == "none"
        return not (
            (finger in FINGERS and finger not in self._fingers)
            or (no_servos and key.removeprefix("goal_") in _SERVOS)
            or (path in ("object.angle", "goal_angle") and len(self._fingers) < 2)
        )

    def draw(self, place: tuple[float, float, bool] | None = None) -> None:
        """Publish a picture of what has come so far, where anybody looks.

        ``place``: of a recording the position and duration [s], and whether it plays.
        """
        now, feed, state = self._moment(), self.feed, self.feed.state
        if self._foxglove is not None and self.states:
            self._foxglove.draw(self._settings, state, self._truth)
        if not self._watched():
            return
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
            "panels": self._maps(now)
            | {"hand": self._planar(), "landscape": self._contacts()}
            | self._graphs(),
            "events": [(each.clock(), *each[1:]) for each in feed.events[-_EVENTS:]],
        }
        self._publish(self._scene, _packed(picture))

    def _planar(self) -> dict[str, Any]:
        parts = planar.hand_parts(self._settings, self.feed.state, self._truth).values()
        lines = [(colour, wide, _flat(each)) for part in parts for colour, wide, each in part.lines]
        texts = [(colour, *_flat(at), words) for part in parts for colour, at, words in part.texts]
        return {"lines": lines, "texts": texts}

    def _maps(self, now: float) -> dict[str, Any]:
        """Each tip's frame with its rim, and footprint and centroid of the contact."""
        frames, radius = self.feed.frames, self._settings.tip.radius
        peak = max((float(frame.grid.max()) for frame in frames.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        maps = {}
        for name, frame in frames.items():
            unit, factor = ("counts", 1.0) if math.isnan(frame.scale) else ("kPa", 1e-3)
            lines, dots, (rows, cols) = [], [], frame.grid.shape
            grid, contact = planar.grid_of(frame.source), self.feed.state.finger(name)
            if grid is not None:
                lines.append((COLOURS[name], 1.0, _flat(planar.tip_circle(grid, radius))))
            if grid is not None and touches(contact):
                tilts = contact.theta, contact.tilt_y if math.isfinite(contact.tilt_y) else 0.0
                if place := planar.footprint(grid, radius, contact.d, *tilts):
                    lines.append((_WHITE, 1.5, _flat(place[0])))
                    dots.append((COLOURS[name], *_flat(place[1])))
            maps[name] = {
                "image": _image(heatmap.levels_of(frame.grid, full), 0, cols, 0, rows),
                "lines": lines,
                "dots": dots,
                "note": f"peak {factor * frame.grid.max():.1f} of {factor * full:g} {unit}",
            }
        return maps

    def _contacts(self) -> dict[str, Any]:
        """Each contact on the landscape, in mm and degrees, with its trail."""
        lines, dots = [], []
        states = [self.feed.state, *(state for state, _ in reversed(self._past))][: 1 + _TRAIL]
        for name in self._fingers:
            tips = takewhile(touches, (state.finger(name) for state in states))
            if trail := [(_DEGREE * tip.theta, 1e3 * tip.d) for tip in tips]:
                lines.append((COLOURS[name], 2.0, _flat(np.array(trail))))
                dots.append((COLOURS[name], *trail[0]))
        return {"lines": lines, "dots": dots}

    def _graphs(self) -> dict[str, Any]:
        """The plots over the last seconds, with a deviation to both sides, and the mode below."""
        now = self.feed.state, _row(self.feed.state)
        shown = [each for each in self._past if each[1][0] > self.time - SECONDS] + [now]
        table = np.array([row for _, row in shown]).T
        times, valid = table[0] - self.time, table[1] > 0.0
        columns = dict(zip(_PATHS, np.clip(table[2:], -_MOST, _MOST), strict=True))
        columns["object.angle"][~valid] = np.nan
        modes, k = [], 0
        for mode, run in groupby(state.mode for state, _ in shown):
            begin, k = k, k + len(list(run))
            modes.append((_MODES.get(mode, GOAL), times[begin], times[min(k, len(times) - 1)]))
        return {
            title: _graph(paths, factor, columns, times, modes)
            for title, (factor, paths) in self._plots.items()
        }

    def _limits(self) -> str:
        """Return what holds the hand back: a recent warning, the grip's goal, the nearest limit."""
        state, safety = self.feed.state, self._settings.safety
        last = [each for each in self.feed.events[-1:] if each.level == "warning"]
        parts = [each.text for each in last if self.time - each.timestamp < _LATELY]
        parts += filter(None, [self.feed.grip()])
        used = [
            (value / getattr(safety, f"{key}_max"), name, key)
            for name in self._fingers
            for key in _BOUNDED
            if math.isfinite(value := abs(getattr(state.finger(name), key)))
        ]
        for ratio, name, key in sorted(used)[-1:]:
            parts.append(f"nearest limit: {name} {key} at {ratio:.0%} of safety.{key}_max")
        return " · ".join(parts)

    def _facts(self, now: float) -> list[str]:
        """Small facts: tick and its times, frames, servos, object, losses, commander."""
        feed, state, times = self.feed, self.feed.state, self.feed.times
        fingers = [state.finger(name) for name in self._fingers]

        def each(key: str, factor: float, decimals: int) -> str:
            return " / ".join(short(factor * getattr(finger, key), decimals) for finger in fingers)

        facts = [
            f"map age {each('frame_age_s', 1e3, 0)} ms",
            f"servos {each('temperature', 1.0, 0)} °C, {each('voltage', 1.0, 1)} V",
            f"object {short(1e3 * state.object.width, 1)} mm wide",
            f"{sum(gaps.lost for gaps in self._gaps.values())} lost, {feed.skipped} unreadable",
            f"{state.overruns} overruns",
        ]
        if times is not None:
            facts.append(f"tick {short(times.rates.tick, 0)} Hz")
            for name, of in {"work": times.compute, "late": times.wake, "bus": times.bus}.items():
                facts.append(
                    f"{name} [µs] {micro(of.p50)}, p99 {micro(of.p99)}, max {micro(of.max)}"
                )
        if self.states and state.schema != schema.SCHEMA:
            facts.append(f"schema {state.schema}, this page knows {schema.SCHEMA}")
        if who := feed.commander(now):
            facts.append(f"{who} commands")
        return facts


def _graph(
    paths: list[str],
    factor: float,
    columns: dict[str, FloatArray],
    times: FloatArray,
    modes: list[tuple[Colour, float, float]],
) -> dict[str, Any]:
    """A plot of the columns at ``paths`` over ``times`` [s], with the modes from and to."""
    values = [factor * columns[path] for path in paths]
    spreads = [factor * np.nan_to_num(columns.get(f"{path}_std", 0.0 * times)) for path in paths]
    ends = np.array([np.subtract(values, spreads), np.add(values, spreads)])
    known = ends[np.isfinite(ends)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    slack = max(0.08 * (high - low), 0.02 * max(abs(low), abs(high)), 0.01)
    low, high = low - slack, high + slack
    step, foot = heatmap.round_up(0.25 * (high - low)), low - 0.05 * (high - low)
    lines: list[Any] = [(colour, 4, [begin, foot, end, foot]) for colour, begin, end in modes]
    texts: list[Any] = []
    for tick in step * np.arange(math.ceil(low / step), math.floor(high / step) + 1):
        lines.append((_GRID, 1, [-SECONDS, tick, 0.0, tick]))
        texts.append((GOAL, -1.07 * SECONDS, tick, f"{tick:.6g}"))
    for k, (path, value, std) in enumerate(zip(paths, values, spreads, strict=True)):
        finger, _, key = path.rpartition(".")
        goal = " goal" * key.startswith("goal")
        name, colour = _OTHERS.get(path, ((finger + goal).strip(), COLOURS.get(finger, GOAL)))
        spread = ""
        if std.any():
            bars = (times, value - std, times, value + std, times, times * np.nan)
            lines.append(((*colour, 0.25), 7, _flat(np.column_stack(bars))))
            spread = f" ± {std[-1]:.2g}"
        lines.append((colour, 0.8 if goal else 1.8, _flat(np.column_stack((times, value)))))
        if math.isfinite(value[-1]) and not (goal and finger):
            place = (k + 0.5) / len(paths) * SECONDS - SECONDS
            texts.append(
                (colour, place, low - 0.15 * (high - low), f"{name} {value[-1]:.3g}{spread}")
            )
    box = -1.15 * SECONDS, 0.0, high, low - 0.22 * (high - low)
    return {"box": box, "lines": lines, "texts": texts}


def _panel(name: str, title: str, *box: float, **more: Any) -> dict[str, Any]:
    """``box``: left, right, top, bottom; ``scaled``: lines' widths have its unit."""
    return {"name": name, "title": title, "box": box, **more}


def _flat(points: FloatArray) -> FloatArray:
    """x and y in turn; four decimals are a tenth of a pixel or less, in metres, too."""
    return np.clip(points, -_MOST, _MOST).round(4).ravel()


def _packed(shown: dict[str, Any]) -> str:
    return orjson.dumps(shown, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _image(levels: NDArray[np.integer[Any]], *box: float) -> dict[str, Any]:
    data = base64.b64encode(levels.astype(np.uint8).tobytes()).decode()
    return {"rows": len(levels), "cols": len(levels[0]), "data": data, "box": box}
