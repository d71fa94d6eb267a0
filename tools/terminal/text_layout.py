"""Format numbers and lines for a fixed-width page.

Widths are in terminal columns; a wide character takes two columns.
"""

from __future__ import annotations

import math

from rich.console import Console
from rich.style import Style
from rich.table import Table
from rich.text import Text

DIM = "#8b929c"


def plain_table(*, heads: bool = True) -> Table:
    """Create a table without borders, with two blanks between columns."""
    return Table(box=None, padding=(0, 2, 0, 0), show_header=heads)


def table_text(table: Table, width: int) -> str:
    """Convert a table to uncoloured text with a maximum width of ``width`` columns."""
    console = Console(width=width, highlight=False, markup=False, color_system=None)
    with console.capture() as printed:
        console.print(table)
    return "\n".join(line.rstrip() for line in printed.get().splitlines())


def truncated(line: Text, columns: int) -> Text:
    """Truncate ``line`` to at most ``columns`` columns, with an ellipsis at the end."""
    line.truncate(max(columns, 0), overflow="ellipsis")
    return line


def wrapped(line: Text, columns: int) -> list[Text]:
    """Wrap ``line`` to ``columns`` columns, indented by one column; return the first two lines."""
    lines = line.wrap(Console(), columns)[:2]
    for each in lines:
        each.pad_left(1)
    return list(lines)


def justified(left: Text, right: Text, width: int) -> Text:
    """Place ``left`` and ``right`` at the two ends of a line with ``width`` columns."""
    return Text.assemble(left, " " * max(1, width - left.cell_len - right.cell_len), right)


def centred(line: Text, width: int) -> Text:
    """Centre ``line`` in ``width`` columns, without trailing blanks."""
    line.pad_left(max(0, (width - line.cell_len) // 2))
    return line


def rule(width: int, title: Text, note: Text | None = None) -> Text:
    """Draw a horizontal rule with a title at the left end and a note at the right end."""
    head = f"─ {truncated(title, width - 4)} " if title else ""
    if not note:
        return Text(head + "─" * (width - len(head)), DIM)
    truncated(note, width - len(head) - 6)
    fill = "─" * (width - len(head) - note.cell_len - 3)
    return Text.assemble((f"{head}{fill} ", DIM), note, (" ─", DIM))


def dimmed(line: Text) -> Text:
    """Fade ``line``, except for map characters, to mark outdated data."""
    maps = [span for span in line.spans if isinstance(span.style, Style) and span.style.bgcolor]
    return Text(line.plain, DIM, spans=maps)


def format_aligned(value: float, decimals: int) -> str:
    """Format a number in up to 7 columns, with the decimal point in the fourth column."""
    if not math.isfinite(value):
        return "  —"
    shown = f"{value:{4 + decimals}.{decimals}f}"
    return shown if len(shown) <= 7 else f"{value:.1e}"


def format_narrow(value: float) -> str:
    """Format a standard deviation in 4 columns."""
    return f"{value:.2f}" if value < 9.995 else f"{value:.0f}" if value < 9999.5 else "many"


def format_value(value: float, decimals: int) -> str:
    """Format a number, or return a dash if the number is missing."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else "—"


def format_microseconds(seconds: float) -> str:
    """Format a duration in up to 4 columns.

    Durations of 10 ms or more are printed in ms with the unit. Shorter durations are printed in µs
    without the unit.
    """
    if not math.isfinite(seconds):
        return "—"
    return f"{1e6 * seconds:.0f}" if seconds < 9.9995e-3 else f"{1e3 * seconds:.0f}ms"
