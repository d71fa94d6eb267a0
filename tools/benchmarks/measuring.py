"""Shared by all measurements: timing in turns, and tables of rows."""

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

# Result of one measurement; each key is a column heading, with "name" first.
Row = dict[str, Any]

# s of one repetition: short compared with interruptions, long compared with the clock's resolution.
_SLICE = 4e-4


@dataclass(frozen=True)
class Report:
    """Table with a title, rows and notes."""

    title: str
    rows: list[Row]
    notes: tuple[str, ...] = ()
    failed: bool = False

    def __str__(self) -> str:
        """Format aligned text, with four digits for numbers and blanks for None and NaN."""
        keys = list(dict.fromkeys(key for row in self.rows for key in row)) or ["name"]
        table = plain_table()
        for key in keys:
            left = any(isinstance(row.get(key), str) for row in self.rows)
            title = self.title if key == "name" else key
            table.add_column(title, justify="left" if left else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(_cell(row.get(key)) for key in keys))
        return "\n".join([table_text(table, 10_000), *self.notes])


def attempt(title: str, part: Callable[[], Report]) -> Report:
    """Return the table of one part of a measurement, or a failed one with the reason.

    If a hand loses its grip on a busy machine, the other parts continue.
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
    """Return median, interquartile range and 99th percentile of samples in ``unit``."""
    values = np.asarray(samples, dtype=np.float64)
    low, median, high, p99 = np.percentile(values, [25.0, 50.0, 75.0, 99.0]).tolist()
    spread = {"median": median, "IQR": high - low, "p99": p99}
    return {"name": name, **spread, "unit": unit, "aim ≤": aim, "n": int(values.size), **more}


def interleave(
    subjects: Mapping[str, Callable[[], object]], rounds: int
) -> dict[str, NDArray[np.float64]]:
    """Return the time per call [ns] of each subject in each round, float64 [rounds].

    The subjects take turns, so that a slow period of the machine affects all of them. Each subject
    is called once beforehand, which compiles it, and then repeated to fill a time slice. Garbage
    collection is off during the measurement.
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
    """Return the wall time of each of ``count`` calls [µs]."""
    samples = []
    for _ in range(count):
        before = time.perf_counter_ns()
        call()
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return samples
