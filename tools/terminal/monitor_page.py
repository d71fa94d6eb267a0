"""The page of ``softfinger monitor`` as lines of styled text: layout, wording and colours.

Lengths are in mm, angles in degrees, energies in mJ, pressures in kPa. The left finger's map is on
the left, the right one's on the right, the numbers of both between them, with the object's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rich.cells import cell_len
from rich.segment import Segment
from rich.style import Style

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import SCHEMA
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.feed import Feed, RecentTicks, number, text
from softfinger.tools.terminal.feed import field as value_at
from softfinger.tools.terminal.feed_sockets import ShownReply
from softfinger.tools.terminal.monitor_keys import key_line
from softfinger.tools.terminal.typeset import (
    DIM,
    PLAIN,
    Line,
    aligned,
    apart,
    bars,
    centred,
    cut,
    exactly,
    faded,
    length,
    micro,
    narrow,
    rule,
    short,
    wrapped,
)

WIDTH, HEIGHT = 80, 24  # the least that everything fits into
CENTRE = 34  # columns of the numbers
MAP_LINES = 11  # of each map at the least size
OLD = 1.0  # s after which a frame is marked as old
REPLY_TIME = 12.0  # s a reply stays
LATE = 0.05  # s behind from which a line says so
_RAISED = 1.01  # share of the requested force above which the grip is reported as raised

BOLD = Style(bold=True)
GOOD = Style(color="#1fa883")
WARN = Style(color="#e69f00")
BAD = Style(color="#ff6a3d", bold=True)
ALARM = Style(color="#ffffff", bgcolor="#b8360b", bold=True)
SIDE = {"left": Style(color="#56b4e9", bold=True), "right": Style(color="#e69f00", bold=True)}

_BADGES = {
    "disarmed": Style(color="#ffffff", bgcolor="#5a6068", bold=True),
    "armed": Style(color="#ffffff", bgcolor="#0067a8", bold=True),
    "holding": Style(color="#ffffff", bgcolor="#007a58", bold=True),
    "fault": ALARM,
}
_BUSY = Style(color="#201800", bgcolor="#e6a817", bold=True)
_LEVELS = {"info": DIM, "warning": WARN, "error": BAD}

# (label, field, factor, decimals, unit, field of the standard deviation)
_ROWS = (
    ("d", "d", 1e3, 2, "mm", "d_std"),
    ("θ", "theta", math.degrees(1.0), 1, "°", "theta_std"),
    ("force", "force", 1.0, 2, "N", "force_std"),
    ("energy", "energy", 1e3, 2, "mJ", "energy_std"),
    ("map age", "frame_age_s", 1e3, 1, "ms", ""),
    ("joint", "q", math.degrees(1.0), 2, "°", ""),
    ("goal", "goal_q", math.degrees(1.0), 2, "°", ""),
    ("velocity", "dq", math.degrees(1.0), 1, "°/s", ""),
    ("current", "current", 1.0, 3, "A", ""),
    ("bound", "goal_current", 1.0, 3, "A", ""),
    ("servo", "temperature", 1.0, 1, "°C", ""),
)


@dataclass
class MonitorPage:
    """The page of a feed. ``now`` is monotonic seconds."""

    feed: Feed
    address: str
    depth: heatmap.Depth = "any"
    keys: bool = True  # a keyboard is there
    guarded: bool = False  # subscribed with keys
    force: float = math.nan  # N of the grasp key
    _pressure: heatmap.FullScale = field(
        default_factory=lambda: heatmap.FullScale(least=5e3, patience=3.0)
    )
    _force: heatmap.FullScale = field(
        default_factory=lambda: heatmap.FullScale(least=1.0, patience=0.0)
    )
    _statistics: RecentTicks = field(default_factory=RecentTicks)
    _statistics_at: float = -math.inf

    def lines(self, width: int, height: int, now: float, reply: ShownReply | None) -> list[Line]:
        """The page as ``height`` lines of exactly ``width`` columns."""
        if width < WIDTH or height < HEIGHT:
            return _too_small(width, height)
        if now - self._statistics_at >= 0.5:  # so that the numbers can be read
            self._statistics = self.feed.statistics(now)
            self._statistics_at = now
        status = self.feed.status(now)
        maps, trend, events = _shares(width, height)
        numbers = [
            *self._body(width, maps, now),
            rule(width, cut(self._goal(), width - 4)),
            *self._trends(width, trend),
            self._ticks(width),
        ]
        if status in ("stale", "lost"):
            numbers = [faded(line) for line in numbers]
        page = [
            self._header(width, now, status),
            self._notice(width, now, status),
            *numbers,
            *self._messages(width, events, now, reply),
            self._footer(width),
        ]
        return [exactly(line, width) for line in page]

    def _header(self, width: int, now: float, status: str) -> Line:
        mode = text(self.feed.state, "mode")
        fault = text(self.feed.state, "fault")
        badge = ALARM if fault else _BADGES.get(mode, _BUSY)
        if not mode or status == "lost":
            badge = _BADGES["disarmed"]
        left = [
            Segment(" softfinger ", BOLD),
            Segment(f" {mode.upper() or '—'} ", badge),
        ]
        if status == "waiting":
            right = [Segment("○ no stream yet ", WARN)]
        elif status == "live":
            rate = short(self._statistics.messages, 0)
            right = [Segment("● live ", GOOD), Segment(f"{rate} Hz ", DIM)]
        else:
            sign = "◐ stale" if status == "stale" else "○ lost"
            age = short(self.feed.age(now), 1)
            right = [Segment(f"{sign} {age} s ", WARN if status == "stale" else BAD)]
        room = width - length(left) - length(right) - 2
        unreadable = f"{self.feed.skipped} unreadable  " if self.feed.skipped else ""
        if len(self.address) + len(unreadable) <= room:
            right = [Segment(f"{self.address}  ", DIM), *right]
        right = [Segment(unreadable, WARN), *right]
        return apart(left, right, width)

    def _notice(self, width: int, now: float, status: str) -> Line:
        if status == "lost":
            return [Segment(" the stream has stopped; everything below is old", BAD)]
        fault = text(self.feed.state, "fault")
        if fault:
            line = [Segment(f" FAULT {cut(fault, width - len(self._way_out) - 8)}", ALARM)]
            return apart(line, [Segment(self._way_out, ALARM)], width, ALARM)
        if status == "waiting":
            what = " waiting for a daemon; start one with: softfinger run"
            what += "" if self.guarded else " (or it requires --keys)"
            return [Segment(cut(what, width), WARN)]
        schema = value_at(self.feed.state, "schema")
        if self.feed.state is not None and schema != SCHEMA:
            what = f" the stream has schema {schema!r:.12}, this page knows {SCHEMA}"
            return [Segment(what + " and shows the fields it knows", WARN)]
        lately = self.feed.waited(now)
        if lately > LATE:
            total = short(number(self.feed.state, "behind_s"), 2)
            what = f" this machine is busy: the simulated hand runs {short(lately, 2)} s behind"
            return [Segment(cut(f"{what} ({total} s in all)", width), WARN)]
        return []

    def _body(self, width: int, lines: int, now: float) -> list[Line]:
        """Titles, maps with the numbers between them, and the maps' scale with the object."""
        box = min(2 * lines, (width - CENTRE - 2) // 2)
        grids = {name: frame.grid() for name, frame in self.feed.frames.items()}
        peak = max((float(grid.max()) for grid in grids.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        counts = any(math.isnan(frame.scale) for frame in self.feed.frames.values())
        left, right = (self._map(name, lines, box, full, now, counts) for name in FINGERS)
        rows = self._numbers(lines + 2)
        gap = max(1, (width - 2 * box - CENTRE) // 2)
        gap = min(gap, 6)
        margin = Segment(" " * max(0, (width - 2 * box - 2 * gap - CENTRE) // 2))
        space = Segment(" " * gap)
        return [
            [
                margin,
                *exactly(a, box),
                space,
                *exactly(b, CENTRE),
                space,
                *exactly(c, box),
            ]
            for a, b, c in zip(left, rows, right, strict=True)
        ]

    def _map(
        self, name: str, lines: int, box: int, full: float, now: float, counts: bool
    ) -> list[Line]:
        """Title, ``lines`` of picture and the scale, each at most ``box`` columns."""
        frame = self.feed.frames.get(name)
        unit, factor, decimals = ("counts", 1.0, 0) if counts else ("kPa", 1e-3, 1)
        if frame is None:
            empty = [centred([Segment("no frames", DIM)], box) if i == lines // 2 else []
                     for i in range(lines)]  # fmt: skip
            return [[Segment(name.upper(), SIDE[name])], *empty, []]
        grid = frame.grid()
        old = now - frame.arrived > OLD
        touch = value_at(self.feed.state, name, "contact")
        said = "old" if old else "contact" if touch is True else "free" if touch is False else ""
        style = WARN if old else GOOD if touch is True else DIM
        peak = f"{grid.max() * factor:.{decimals}f} {unit}"
        title = apart(
            [Segment(name.upper(), SIDE[name]), Segment(f" {said}", style)], [Segment(peak)], box
        )
        height, columns = heatmap.fit(frame.rows, frame.cols, lines, box, frame.aspect)
        above = (lines - height) // 2
        picture: list[Line] = [[] for _ in range(lines)]
        for i, line in enumerate(heatmap.picture(grid, full, height, columns, self.depth)):
            picture[above + i] = centred([*line], box)
        end = f" {full * factor:g} {unit}"
        bar = heatmap.colour_bar(max(4, box - 2 - len(end)), self.depth)
        return [title, *picture, [Segment("0 ", DIM), *bar, Segment(end, DIM)]]

    def _numbers(self, lines: int) -> list[Line]:
        """Heads, one row a quantity, and the object, in the middle of ``lines``."""
        rows = [self._row(*row) for row in _ROWS]
        between: list[Line] = [[]] if lines > len(rows) + 3 else []
        block = [self._heads(), *between, *rows, *between, self._object()]
        above = (lines - len(block)) // 2
        return [[]] * above + block + [[]] * (lines - above - len(block))

    def _heads(self) -> Line:
        present = {name: value_at(self.feed.state, name, "valid") is not False for name in FINGERS}
        heads = [
            Segment(f"{name if present[name] else name + ' —':^10} ", SIDE[name])
            for name in FINGERS
        ]
        return [Segment(" " * 8), *heads]

    def _row(self, label: str, key: str, factor: float, decimals: int, unit: str, std: str) -> Line:
        line = [Segment(f"{label:<8}", DIM)]
        for name in FINGERS:
            finger = value_at(self.feed.state, name)
            here = value_at(finger, "valid") is not False
            value = number(finger, key)
            if key == "temperature" and value == 0.0:
                value = math.nan  # not known yet
            shown = aligned(factor * value, decimals)
            spread = number(finger, std) if std else math.nan
            beside = "" if math.isnan(spread) else "±" + narrow(factor * spread)
            style = PLAIN if here else DIM
            if key == "temperature" and value >= self.feed.warm:
                style = BAD
            line.append(Segment(shown, style))
            line.append(Segment(f"{beside:<{11 - len(shown)}}", DIM))
        line.append(Segment(f" {unit}", DIM))
        return line

    def _object(self) -> Line:
        pose = value_at(self.feed.state, "object")
        if value_at(pose, "valid") is False:
            pose = None
        angle = math.degrees(number(pose, "angle"))
        width = 1e3 * number(pose, "width")
        return [
            Segment(f"{'object':<8}", DIM),
            Segment(f"{aligned(angle, 2):<6}", BOLD),
            Segment(f"{' °':<5}", DIM),
            Segment(f"{aligned(width, 2):<6}", BOLD),
            Segment(" mm wide", DIM),
        ]

    def _goal(self) -> str:
        """The grip's goal in words; empty without a grip."""
        force = number(self.feed.state, "goal_force")
        angle = math.degrees(number(self.feed.state, "goal_angle"))
        if not math.isfinite(force):
            return ""
        said = f"grip: goal {force:.1f} N"
        asked = self.feed.asked
        if force > _RAISED * asked:
            said += f", raised from {asked:.1f} N"
        return said + (f", object to {angle:.1f}°" if math.isfinite(angle) else "")

    def _trends(self, width: int, lines: int) -> list[Line]:
        """The recent history of both forces, ``lines`` of bars each."""
        columns = width - 30
        recent = list(self.feed.history)[-columns:]
        peak = max((v for pair in recent for v in pair if math.isfinite(v)), default=0.0)
        full = self._force.follow(peak, 0.0)
        result: list[Line] = []
        for i, name in enumerate(FINGERS):
            value = aligned(number(self.feed.state, name, "force"), 2)
            for bar in bars([pair[i] for pair in recent], full, lines):
                result.append(
                    [Segment(" " * 23), Segment(f"{bar:>{columns}}", SIDE[name]), Segment(" ")]
                )
            result[-1][0] = Segment(f" force {name:<6}", DIM)
            result[-1].insert(1, Segment(f"{value:<8}"))
            result[-1].insert(2, Segment("N ", DIM))
            result[-lines].append(Segment(f"{full:g} N", DIM))
        return result

    def _ticks(self, width: int) -> Line:
        """Rate and overruns, then median, tail and largest times of all ticks.

        Until ``hand/stats`` arrives, those of the last second. Shorter in a narrow terminal.
        """
        now, all_ticks = self._statistics, self.feed.times
        overruns = number(self.feed.state, "overruns")
        head = [
            Segment(f" tick {short(now.rate, 0)} Hz"),
            Segment("  overruns ", DIM),
            Segment(short(overruns, 0), WARN if overruns > 0 else PLAIN),
        ]
        times: tuple[tuple[str, tuple[float, ...]], ...]
        words: tuple[str, ...]
        if all_ticks is None:
            times = (
                ("compute", (now.compute, now.compute_max)),
                ("late", (now.late, now.late_max)),
            )
            words = ("µs", "max")
        else:
            times = (("compute", all_ticks.compute), ("late", all_ticks.late))
            words = ("µs", "p99", "max")
        full, slim = [*head], [*head]
        for label, values in times:
            said = [micro(value) for value in values]
            tail = "".join(
                f" {word} {value}" for word, value in zip(words[1:], said[1:], strict=True)
            )
            full += [Segment(f"  {label} ", DIM), Segment(f"{said[0]} µs"), Segment(tail, DIM)]
            slim += [Segment(f"  {label} ", DIM), Segment("/".join(said))]
        slim.append(Segment(" µs", DIM))
        named = [*slim[:3], Segment(f"  p50/{'/'.join(words[1:])}", DIM), *slim[3:]]
        return next((line for line in (full, named) if length(line) <= width), slim)

    def _messages(self, width: int, count: int, now: float, reply: ShownReply | None) -> list[Line]:
        """A rule with the commander and the last reply, texts cut above in full, then events."""
        who = self.feed.commander(now)
        title = "events" if not who else f"events ─ {cut(who, 16)} commands the hand"
        said = _reply(reply, now)
        full: list[Line] = []
        fault = text(self.feed.state, "fault")
        if cell_len(fault) > width - len(self._way_out) - 8:
            full += [[Segment(f" {part}", BAD)] for part in wrapped(fault, width - 2)[:2]]
        if length(said) > width - len(title) - 9:
            parts = wrapped(said[0].text, width - 2)
            full += [[Segment(f" {part}", said[0].style)] for part in parts[:2]]
            said = []
        full = full[:count]
        return [rule(width, title, said), *full, *self._events(width, count - len(full))]

    @property
    def _way_out(self) -> str:
        """What clears a fault."""
        return "c clears it " if self.keys else "softfinger send clear "

    def _events(self, width: int, count: int) -> list[Line]:
        recent = self.feed.events[-count:] if count else []
        result: list[Line] = []
        for event in recent:
            style = _LEVELS.get(event.level, PLAIN)
            kind = f" {event.kind:<9}"
            line = [Segment(f" {event.clock()}", DIM), Segment(kind, style)]
            said = PLAIN if event.level == "info" else style
            line.append(Segment(" " + cut(event.text, width - length(line) - 1), said))
            result.append(line)
        return result + [[] for _ in range(count - len(result))]

    def _footer(self, width: int) -> Line:
        if not self.keys:
            return [Segment(" no keyboard here: commands go through softfinger send", DIM)]
        return key_line(width, self.force, bool(text(self.feed.state, "fault")))


def _shares(width: int, height: int) -> tuple[int, int, int]:
    """Lines of (each map, each trend, the events) on a page of this size."""
    spare = height - HEIGHT
    widest = (width - CENTRE - 2) // 4  # the maps' width is twice their height
    maps = min(widest, MAP_LINES + (2 * spare + 2) // 3)
    maps = max(MAP_LINES, maps)
    spare -= maps - MAP_LINES
    trend = 1 + min(3, spare // 4)
    spare -= 2 * (trend - 1)
    return maps, trend, 3 + spare


def _too_small(width: int, height: int) -> list[Line]:
    said = [
        "softfinger monitor",
        f"needs {WIDTH} × {HEIGHT},",
        f"this is {width} × {height}",
        "q quits, space stops",
    ]
    above = max(0, (height - len(said)) // 2)
    lines: list[Line] = [[] for _ in range(above)]
    lines += [centred([Segment(cut(line, width), WARN)], width) for line in said]
    lines += [[] for _ in range(height)]
    return [exactly(line, width) for line in lines[:height]]


def _reply(reply: ShownReply | None, now: float) -> Line:
    if reply is None or now - reply.at > REPLY_TIME:
        return []
    return [Segment(f"{'✓' if reply.ok else '✗'} {reply.text}", GOOD if reply.ok else BAD)]
