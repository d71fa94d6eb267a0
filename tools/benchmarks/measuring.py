"""Shared by all measurements: times in turns, tables of rows."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.tools.terminal.typeset import plain_table, table_text

# One measured thing; each key is the heading of its column, "name" the first of them.
Row = dict[str, Any]

_SLICE_NS = 4e5  # of one repetition: short against the machine's hiccups, long against the clock


@dataclass(frozen=True)
class Report:
    """Rows under a title, and notes below them."""

    title: str
    rows: list[Row]
    notes: tuple[str, ...] = ()
    failed: bool = False

    def __str__(self) -> str:
        """Aligned text; numbers with four digits, nothing for None and NaN."""
        keys = list(dict.fromkeys(key for row in self.rows for key in row)) or ["name"]
        table = plain_table()
        for key in keys:
            left = any(isinstance(row.get(key), str) for row in self.rows)
            title = self.title if key == "name" else key
            table.add_column(title, justify="left" if left else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(_cell(row.get(key)) for key in keys))
        return "\n".join([table_text(table, 10_000), *self.notes])


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


@dataclass(frozen=True)
class Subject:
    """Something to time: ``run(repeat)`` does ``repeat`` × ``calls`` calls."""

    run: Callable[[int], object]
    calls: int = 1


def each(call: Callable[..., object], arguments: Sequence[tuple[Any, ...]]) -> Subject:
    """Return calls from Python with each of these arguments."""

    def run(repeat: int) -> None:
        for _ in range(repeat):
            for one in arguments:
                call(*one)

    return Subject(run, len(arguments))


def interleave(subjects: dict[str, Subject], rounds: int) -> dict[str, NDArray[np.float64]]:
    """Return nanoseconds a call of each subject in each round, float64 [rounds].

    They take turns, so that a slow minute slows all of them. Each is called once before, which
    compiles it, and then repeated often enough to fill a slice.
    """
    repeats = {}
    for name, subject in subjects.items():
        subject.run(1)
        before = time.perf_counter_ns()
        subject.run(1)
        spent = max(time.perf_counter_ns() - before, 1)
        repeats[name] = max(1, round(_SLICE_NS / spent))
    times = {name: np.empty(rounds) for name in subjects}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for i in range(rounds):
            for name, subject in subjects.items():
                repeat = repeats[name]
                before = time.perf_counter_ns()
                subject.run(repeat)
                spent = time.perf_counter_ns() - before
                times[name][i] = spent / (repeat * subject.calls)
    finally:
        if collecting:
            gc.enable()
    return times


def timed(call: Callable[[], object], count: int = 1) -> list[float]:
    """Wall time of each of ``count`` calls [µs]."""
    samples = []
    for _ in range(count):
        before = time.perf_counter_ns()
        call()
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return samples
