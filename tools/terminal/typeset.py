"""Typesetting of numbers and lines for a page of fixed width.

Widths are terminal columns: a wide character takes two.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style

Line = list[Segment]

PLAIN = Style()
DIM = Style(color="#8b929c")
FADED = Style(color="#8b929c", bold=False)
BARS = " ▁▂▃▄▅▆▇█"


def bars(values: list[float], full: float, lines: int) -> list[str]:
    """Values as bars of eighths of a line, highest line first; blank for NaN."""
    steps = [
        -1 if math.isnan(v) else round(min(max(v / full, 0.0), 1.0) * 8 * lines) for v in values
    ]
    rows = []
    for row in reversed(range(lines)):
        floor = 1 if row == 0 else 0  # a zero still shows as a thin line
        cells = (max(floor, min(8, s - 8 * row)) if s >= 0 else 0 for s in steps)
        rows.append("".join(BARS[max(0, c)] for c in cells))
    return rows


def aligned(value: float, decimals: int) -> str:
    """The number with its decimal point in the fourth column, at most 7 wide."""
    if not math.isfinite(value):
        return "  —"
    shown = f"{value:{4 + decimals}.{decimals}f}"
    if len(shown) > 7:
        shown = f"{value:.1e}"
    return shown


def narrow(value: float) -> str:
    """A standard deviation in 4 columns."""
    return f"{value:.2f}" if value < 9.995 else f"{value:.0f}" if value < 9999.5 else "many"


def short(value: float, decimals: int) -> str:
    """The number, or a dash where there is none."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else "—"


def micro(seconds: float) -> str:
    """A time in µs, in at most 4 columns; from 10 ms on in ms, with its unit."""
    if not math.isfinite(seconds):
        return "—"
    return f"{1e6 * seconds:.0f}" if seconds < 9.9995e-3 else f"{1e3 * seconds:.0f}ms"


def cut(said: str, room: int) -> str:
    """``said`` in at most ``room`` columns, with an ellipsis where it was cut."""
    if cell_len(said) <= room:
        return said
    return set_cell_size(said, max(0, room - 1)) + ("…" if room > 0 else "")


def wrapped(said: str, room: int) -> list[str]:
    """``said`` in lines of at most ``room`` columns."""
    lines = [""]
    for word in said.split(" "):
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if cell_len(longer) <= room:
            lines[-1] = longer
        else:
            lines.append(cut(word, room))
    return [line for line in lines if line]


def length(line: Iterable[Segment]) -> int:
    """Columns that ``line`` takes."""
    return sum(segment.cell_length for segment in line)


def exactly(line: Line, width: int) -> Line:
    """``line`` cropped or padded to ``width`` columns."""
    return Segment.adjust_line_length(line, width, pad=True)


def apart(left: Line, right: Line, width: int, between: Style = PLAIN) -> Line:
    """``left`` and ``right`` at the two ends of ``width`` columns."""
    space = max(1, width - length(left) - length(right))
    return [*left, Segment(" " * space, between), *right]


def centred(line: Line, width: int) -> Line:
    """``line`` in the middle of ``width`` columns, not padded at its end."""
    return [Segment(" " * ((width - length(line)) // 2)), *line]


def rule(width: int, title: str = "", note: Line | None = None) -> Line:
    """A line across the page with a title at its left end and a note at its right end."""
    head = f"─ {title} " if title else ""
    if not note:
        return [Segment(head + "─" * (width - len(head)), DIM)]
    note = [Segment(cut(s.text, width - len(head) - 6), s.style) for s in note]
    fill = "─" * (width - len(head) - length(note) - 3)
    return [Segment(f"{head}{fill} ", DIM), *note, Segment(" ─", DIM)]


def faded(line: Line) -> Line:
    """``line`` without colours, except the maps: it is out of date."""
    return [s if "▀" in s.text else Segment(s.text, FADED) for s in line]
