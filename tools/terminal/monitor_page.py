"""Lay out the ``softfinger monitor`` page as lines of styled text.

Lengths are in mm, angles in degrees, energies in mJ, pressures in kPa. The left finger's map is on
the left, and the right finger's map is on the right. The numbers for the fingers and the object are
between the maps. Widths are in terminal columns; a wide character takes two columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rich.text import Text

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.record_text import why_invalid
from softfinger.daemon.wire.schema import SCHEMA
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.stream_state import GLOSSARY, ShownReply, StreamState
from softfinger.tools.terminal.text_layout import (
    DIM,
    centred,
    dimmed,
    format_aligned,
    format_microseconds,
    format_narrow,
    format_value,
    justified,
    rule,
    truncated,
    wrapped,
)

WIDTH, HEIGHT = 80, 24  # minimum page size in columns and lines
CENTRE = 34  # width of the area with the numbers, in columns
MAP_LINES = 11  # height of each map at the minimum page size
OLD_AGE = 1.0  # age above which a frame is marked as old [s]
REPLY_TIME = 12.0  # time for which a reply is shown [s]
DELAY_MIN = 0.05  # delay of the simulated hand above which a message is displayed [s]

GOOD, WARN, BAD = "#1fa883", "#e69f00", "bold #ff6a3d"
KEY = "bold #56b4e9"
ALARM = "bold #ffffff on #b8360b"
FINGER_STYLES = {"left": KEY, "right": "bold #e69f00"}
_BADGES = {
    "disarmed": "bold #ffffff on #5a6068",
    "armed": "bold #ffffff on #0067a8",
    "holding": "bold #ffffff on #007a58",
    "fault": ALARM,
}
_BUSY = "bold #201800 on #e6a817"
_LEVELS = {"info": DIM, "warning": WARN, "error": BAD}
_KEYS = {
    "a": "arm",
    "g": "grasp",
    "+-": "",  # changes the force
    "←→": "turn 5°",
    "r": "release",
    "space": "stop",
    "c": "clear",
    "d": "disarm",
    "?": "",
    "q": "quit",
}
_KEYS_EXPLAINED = (
    ("w", "restarts the profile's task (only while disarmed)"),
    ("+ -", "increase or reduce the force, including that of the current grip"),
)

# Label, field, scale factor, number of decimals, unit, and field of the standard deviation.
_ROWS = (
    ("d", "d", 1e3, 2, "mm", "d_std"),
    ("θ", "theta", math.degrees(1.0), 1, "°", "theta_std"),
    ("force", "force", 1.0, 2, "N", "force_std"),
    ("energy", "energy", 1e3, 2, "mJ", ""),
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
    """Page that shows a `StreamState`; in all methods, ``now`` is the monotonic time [s]."""

    feed: StreamState
    address: str
    coloured: bool = True  # True if the terminal has more than 16 colours
    keys: bool = True  # True if a keyboard is available
    guarded: bool = False  # True if the page uses access keys
    force: float = math.nan  # force requested when the grasp key is pressed [N]
    explains: bool = False  # True if the page shows explanations instead of numbers
    _pressure: heatmap.FullScale = field(default_factory=lambda: heatmap.FullScale(5e3))

    def lines(self, width: int, height: int, now: float, reply: ShownReply | None) -> list[Text]:
        """Return the page as ``height`` lines of exactly ``width`` columns."""
        if width < WIDTH or height < HEIGHT:
            page = _too_small(width, height)
        else:
            page = self._page(width, height, now, reply)
        for line in page:
            line.truncate(width, overflow="ellipsis", pad=True)
        return page

    def _page(self, width: int, height: int, now: float, reply: ShownReply | None) -> list[Text]:
        status = self.feed.status(now)
        maps, events = _heights(width, height)
        numbers = [
            *(_meanings(maps + 2) if self.explains else self._body(width, maps, now)),
            rule(width, Text(self.feed.grip())),
            self._ticks(),
        ]
        if status in ("stale", "lost"):
            numbers = [dimmed(line) for line in numbers]
        return [
            self._header(width, now, status),
            self._notice(width, now, status),
            *numbers,
            *self._messages(width, events, now, reply),
            self._footer(width),
        ]

    def _header(self, width: int, now: float, status: str) -> Text:
        feed = self.feed
        badge = ALARM if feed.fault else _BADGES.get(feed.mode, _BUSY)
        if not feed.mode or status == "lost":
            badge = _BADGES["disarmed"]
        left = Text.assemble((" softfinger ", "bold"), (f" {feed.mode.upper() or '—'} ", badge))
        if status == "waiting":
            right = Text("○ waiting for the stream ", WARN)
        elif status == "live":
            right = Text.assemble(("● live ", GOOD), (f"{format_value(feed.rate, 0)} Hz ", DIM))
        else:
            sign, style = ("◐ stale", WARN) if status == "stale" else ("○ lost", BAD)
            right = Text(f"{sign} {format_value(feed.age(now), 1)} s ", style)
        unreadable = f"{feed.skipped_count} unreadable  " if feed.skipped_count else ""
        width_left = width - left.cell_len - right.cell_len - 2
        address = f"{self.address}  " if len(self.address + unreadable) <= width_left else ""
        return justified(left, Text.assemble((unreadable, WARN), (address, DIM), right), width)

    def _notice(self, width: int, now: float, status: str) -> Text:
        feed = self.feed
        if status == "lost":
            return Text(" the stream has stopped; the values below are outdated", BAD)
        if feed.fault:
            fault = truncated(Text(f" FAULT {feed.fault}"), width - len(self._way_out) - 1)
            line = justified(fault, Text(self._way_out), width)
            line.stylize(ALARM)
            return line
        if status == "waiting":
            keys = "" if self.guarded else " (or it requires --keys)"
            return Text(f" waiting for a daemon; start one with: softfinger run{keys}", WARN)
        if feed.state.schema != SCHEMA:
            what = f" the stream uses schema {feed.state.schema}, but this page supports schema "
            return Text(f"{what}{SCHEMA} and shows only known fields", WARN)
        lately = feed.waited(now)
        if lately > DELAY_MIN:
            what = f" this machine is busy: the simulated hand runs {lately:.2f} s behind"
            return Text(f"{what} ({format_value(feed.state.behind_s, 2)} s in total)", WARN)
        return Text(f" {why_invalid(feed.state)}", WARN)

    def _body(self, width: int, lines: int, now: float) -> list[Text]:
        """Draw both maps with titles and colour scales, and the numbers between the maps."""
        box = min(2 * lines, (width - CENTRE - 2) // 2)
        frames = self.feed.frames
        peak = max((float(frame.grid.max()) for frame in frames.values()), default=0.0)
        full = self._pressure.follow(peak, now)
        counts = any(math.isnan(frame.scale) for frame in frames.values())
        left, right = (self._map(name, lines, box, full, now, counts) for name in FINGERS)
        gap = min(max(1, (width - 2 * box - CENTRE) // 2), 6)
        margin = " " * max(0, (width - 2 * box - 2 * gap - CENTRE) // 2)
        page = []
        for parts in zip(left, self._numbers(lines + 2), right, strict=True):
            for part, width_left in zip(parts, (box, CENTRE, box), strict=True):
                part.truncate(width_left, overflow="crop", pad=True)
            page.append(Text.assemble(margin, parts[0], " " * gap, parts[1], " " * gap, parts[2]))
        return page

    def _map(
        self, name: str, lines: int, box: int, full: float, now: float, counts: bool
    ) -> list[Text]:
        """Draw a map of ``lines`` lines with its title and scale, at most ``box`` columns wide."""
        frame = self.feed.frames.get(name)
        title = Text(name.upper(), FINGER_STYLES[name])
        picture = _filled([], lines)
        if frame is None:
            picture[lines // 2] = centred(Text("no frames", DIM), box)
            return [title, *picture, Text()]
        unit, factor, decimals = ("counts", 1.0, 0) if counts else ("kPa", 1e-3, 1)
        touch = getattr(self.feed.state, name).contact
        text, style = ("contact", GOOD) if touch else ("free", DIM)
        if now - frame.arrived > OLD_AGE:
            text, style = "old", WARN
        peak = Text(f"{frame.grid.max() * factor:.{decimals}f} {unit}")
        title = justified(Text.assemble(title, (f" {text}", style)), peak, box)
        rows, cols = frame.grid.shape
        height, columns = heatmap.fit(rows, cols, lines, box, frame.aspect)
        above = (lines - height) // 2
        for i, line in enumerate(heatmap.picture(frame.grid, full, height, columns, self.coloured)):
            picture[above + i] = centred(line, box)
        end = f" {full * factor:g} {unit}"
        bar = heatmap.colour_bar(max(4, box - 2 - len(end)), self.coloured)
        return [title, *picture, Text.assemble(("0 ", DIM), bar, (end, DIM))]

    def _numbers(self, lines: int) -> list[Text]:
        """Draw headings, one row per quantity, and the object, all centred in ``lines`` lines."""
        rows = [self._row(*row) for row in _ROWS]
        if lines > len(rows) + 3:  # The headings and the object are set apart.
            rows = [Text(), *rows, Text()]
        block = [self._heads(), *rows, self._object()]
        above = (lines - len(block)) // 2
        return _filled(_filled([], above) + block, lines)

    def _heads(self) -> Text:
        line = Text(" " * 8)
        for name in FINGERS:
            here = getattr(self.feed.state, name).valid
            line.append(f"{name if here else name + ' —':^10} ", FINGER_STYLES[name])
        return line

    def _row(self, label: str, key: str, factor: float, decimals: int, unit: str, std: str) -> Text:
        line = Text(f"{label:<8}", DIM)
        for name in FINGERS:
            finger = getattr(self.feed.state, name)
            value, style = getattr(finger, key), "default" if finger.valid else DIM
            if key == "temperature":
                style = BAD if finger.time_to_limit < self.feed.heat_warning_time else style
                value = value or math.nan  # A temperature of 0 means unknown.
            spread = factor * getattr(finger, std) if std else math.nan
            shown = format_aligned(factor * value, decimals)
            beside = "" if math.isnan(spread) else "±" + format_narrow(spread)
            line.append(shown, style).append(f"{beside:<{11 - len(shown)}}", DIM)
        return line.append(f" {unit}", DIM)

    def _object(self) -> Text:
        pose = self.feed.state.object
        angle, width = (
            (math.degrees(pose.angle), 1e3 * pose.width) if pose.valid else [math.nan] * 2
        )
        return Text.assemble(
            (f"{'object':<8}", DIM),
            (f"{format_aligned(angle, 2):<6}", "bold"),
            (f"{' °':<5}", DIM),
            (f"{format_aligned(width, 2):<6}", "bold"),
            (" mm wide", DIM),
        )

    def _ticks(self) -> Text:
        """List the tick rate, the number of overruns, and the median, p99 and maximum tick time."""
        times, overruns = self.feed.times, self.feed.state.overruns
        rate = math.nan if times is None else times.rates.tick
        line = Text(f" tick {format_value(rate, 0)} Hz").append("  overruns ", DIM)
        known = str(overruns) if self.feed.mode else "—"
        line.append(known, WARN if overruns > 0 else "default").append("  p50/p99/max", DIM)
        for label, name in (("compute", "compute"), ("late", "wake")):
            of = getattr(times, name, None)
            values = [math.nan] * 3 if of is None else (of.p50, of.p99, of.max)
            line.append(f"  {label} ", DIM).append(
                "/".join(format_microseconds(value) for value in values)
            )
        return line.append(" µs", DIM)

    def _messages(self, width: int, count: int, now: float, reply: ShownReply | None) -> list[Text]:
        """List the commanding client, last reply and events; wrap long faults and replies."""
        who = truncated(Text(self.feed.commander(now)), 16)
        title = Text(f"events ─ {who} commands the hand" if who else "events")
        full: list[Text] = []
        if Text(self.feed.fault).cell_len > width - len(self._way_out) - 8:
            full = wrapped(Text(self.feed.fault, BAD), width - 2)
        text = Text()
        if reply is not None and now - reply.at <= REPLY_TIME:
            text = Text(f"{'✓' if reply.ok else '✗'} {reply.text}", GOOD if reply.ok else BAD)
        if text.cell_len > width - len(title) - 9:
            full += wrapped(text, width - 2)
            text = Text()
        full = full[:count]
        return [rule(width, title, text), *full, *self._events(count - len(full))]

    @property
    def _way_out(self) -> str:
        """Return the command that clears a fault."""
        return "c clears it " if self.keys else "softfinger send clear "

    def _events(self, count: int) -> list[Text]:
        lines = []
        for event in self.feed.events[-count:] if count else []:
            style = _LEVELS.get(event.level, "default")
            line = Text.assemble((f" {event.clock()}", DIM), (f" {event.kind:<9} ", style))
            lines.append(line.append(event.text, style if event.level != "info" else ""))
        return _filled(lines, count)

    def _footer(self, width: int) -> Text:
        """List the keys; a narrow terminal shows only keys that are useful in the current mode."""
        if not self.keys:
            return Text(" no keyboard input: send commands with softfinger send", DIM)
        force = f"{self.force:.3g} N" if math.isfinite(self.force) else "N"
        keys = _KEYS | {"+-": force}
        line = _named(keys)
        for spare in ("+-", "←→") if self.feed.fault else ("c", "d"):
            if line.cell_len - 2 > width:
                del keys[spare]
                line = _named(keys)
        return line


def _filled(lines: list[Text], count: int) -> list[Text]:
    """Add empty lines up to ``count`` lines."""
    return lines + [Text() for _ in range(count - len(lines))]


def _meanings(count: int) -> list[Text]:
    explained = GLOSSARY + _KEYS_EXPLAINED
    return _filled(
        [Text.assemble((f" {name:>15}  ", KEY), text) for name, text in explained], count
    )


def _named(keys: dict[str, str]) -> Text:
    line = Text(" ")
    for key, what in keys.items():
        line.append(key, KEY).append(f" {what}  ", DIM)
    return line


def _heights(width: int, height: int) -> tuple[int, int]:
    """Return the number of lines for each map and the number of lines for events."""
    spare = height - HEIGHT
    widest = (width - CENTRE - 2) // 4  # Each map has twice as many columns as lines.
    maps = max(MAP_LINES, min(widest, MAP_LINES + (2 * spare + 2) // 3))
    return maps, 5 + spare - (maps - MAP_LINES)


def _too_small(width: int, height: int) -> list[Text]:
    text = [
        "softfinger monitor",
        f"requires {WIDTH} × {HEIGHT},",
        f"this terminal: {width} × {height}",
        "q quits, space stops",
    ]
    lines = _filled([], (height - len(text)) // 2)
    lines += [centred(Text(line, WARN), width) for line in text]
    return _filled(lines, height)[:height]
