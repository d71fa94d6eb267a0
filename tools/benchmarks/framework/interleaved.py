"""Times of many subjects in one run, taken in turns so that a slow minute slows all of them."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SLICE_NS = 4e5  # of one repetition: short against the machine's hiccups, long against the clock


@dataclass(frozen=True)
class Subject:
    """Something to time: ``run(repeat)`` does ``repeat`` × ``calls`` calls."""

    run: Callable[[int], object]
    calls: int = 1


def interleave(subjects: dict[str, Subject], rounds: int) -> dict[str, NDArray[np.float64]]:
    """Nanoseconds a call of each subject in each round, float64 [rounds].

    Each is called once before, which compiles it, and then repeated often enough to fill a slice.
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


def timed(call: Callable[[], object], count: int) -> list[float]:
    """Wall time of each of ``count`` calls [µs]."""
    samples = []
    for _ in range(count):
        before = time.perf_counter_ns()
        call()
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return samples
