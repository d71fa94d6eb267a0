"""Time functions alternately, and format the results as tables."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from timeit import Timer
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.daemon.errors import SoftfingerError
from softfinger.tools.terminal.text_layout import plain_table, table_text

# Result of one measurement. Each key is a column heading, and "name" is the first column.
Row = dict[str, Any]

# Duration of a repetition [s]. A repetition is short enough to avoid most interruptions, but much
# longer than the clock resolution.
_SLICE = 4e-4


@dataclass(frozen=True)
class Report:
    """Table with a title, rows and notes."""

    title: str
    rows: list[Row]
    notes: tuple[str, ...] = ()
    failed: bool = False

    def __str__(self) -> str:
        """Format as aligned text with four significant digits.

        None and NaN are blank; lists are omitted.
        """
        shown = (key for row in self.rows for key in row if not isinstance(row[key], list))
        keys = list(dict.fromkeys(shown)) or ["name"]
        table = plain_table()
        for key in keys:
            left = any(isinstance(row.get(key), str) for row in self.rows)
            title = self.title if key == "name" else key
            table.add_column(title, justify="left" if left else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(_cell(row.get(key)) for key in keys))
        return "\n".join([table_text(table, 10_000), *self.notes])


def attempt(title: str, part: Callable[[], Report]) -> Report:
    """Run one part of a measurement; if it fails, return a report that states the reason.

    The other parts therefore run even if, for example, a hand loses its grip on a busy machine.
    """
    try:
        return part()
    except (RuntimeError, SoftfingerError) as error:
        return Report(title, [], notes=(f"{title}: {error}",), failed=True)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def figure(name: str, unit: str, samples: ArrayLike, aim: float | None = None, **more: Any) -> Row:
    """Return a row with the median, interquartile range and 99th percentile of the samples."""
    values = np.asarray(samples, dtype=np.float64)
    low, median, high, p99 = np.percentile(values, [25.0, 50.0, 75.0, 99.0]).tolist()
    spread = {"median": median, "IQR": high - low, "p99": p99}
    return {"name": name, **spread, "unit": unit, "aim ≤": aim, "n": int(values.size), **more}


def interleave(
    subjects: Mapping[str, Callable[[], object]], rounds: int
) -> dict[str, NDArray[np.float64]]:
    """Measure each subject's time per call [ns], with one value per round.

    Calls to the subjects alternate, so a slow phase of the machine affects all subjects. The first
    call compiles the subject and is not counted. Each measurement repeats the call to fill a time
    slice. Garbage collection is disabled during the measurement.
    """
    timers, repeats = {name: Timer(run) for name, run in subjects.items()}, {}
    for name, timer in timers.items():
        timer.timeit(1)
        repeats[name] = max(1, round(_SLICE / max(timer.timeit(1), 1e-9)))
    times = {name: np.empty(rounds) for name in subjects}
    for i in range(rounds):
        for name, timer in timers.items():
            times[name][i] = 1e9 * timer.timeit(repeats[name]) / repeats[name]
    return times


def timed(call: Callable[[], object], count: int = 1) -> list[float]:
    """Return the wall-clock times of ``count`` calls [µs]."""
    samples = []
    for _ in range(count):
        before = time.perf_counter_ns()
        call()
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return samples
