"""Growth of cost and error: with cells, subscribers, sensors, rate.

Each table is of one run in turns, and ends with the fitted slopes.
"""

from __future__ import annotations

import contextlib
import math

import numpy as np

from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.estimator import (
    ERROR,
    LINEAR,
    NOISE,
    TIP,
    TRUTH,
    WIDTH,
    bound,
    decode,
    estimates,
    jacobian,
    rms_errors,
    timed_frames,
)
from softfinger.tools.benchmarks.measuring import (
    Report,
    Row,
    Subject,
    figure,
    interleave,
    slopes,
)
from softfinger.tools.benchmarks.scenes import TimedScene, standing
from softfinger.tools.benchmarks.tick import in_place

_SIDES = (8, 16, 32, 44, 64, 96, 128)  # cells
_PITCH = WIDTH / 44
_SUBSCRIBERS = (0, 1, 3, 10, 30, 100)
_RATES = (100.0, 200.0, 500.0, 1000.0, 2000.0)  # Hz
_FRAMES = 32
_IN_TURN = 20  # ticks: whole periods of frames and state


def measure(brief: bool = False) -> list[Report]:
    """Return all of them; ``brief`` takes every other point."""
    step, rounds = (2, 5) if brief else (1, 25)
    return [*cells(_SIDES[::step], rounds), *ticks(step, 2 * rounds)]


def cells(sides: tuple[int, ...], rounds: int) -> list[Report]:
    """Time and error of an estimate, and of decoding, at the same sensor size and at one pitch."""
    x = "cells a side"
    random = np.random.default_rng(4)
    subjects: dict[str, Subject] = {}
    found: list[Row] = []
    for n in sides:
        noise = NOISE * random.standard_normal((_FRAMES, n, n))
        for name, pitch in (("same pitch", _PITCH), ("same size", WIDTH / n)):
            grid = SensorGrid(n, n, pitch)
            frames = grid.pressure(TIP, LINEAR, *TRUTH) + noise
            warm = estimates(frames, grid)
            subjects[f"warm; {name}: {n}"] = timed_frames(warm)
            subjects[f"cold; {name}: {n}"] = timed_frames(estimates(frames, grid, cold=True))
            subjects[f"no contact; {name}: {n}"] = timed_frames(estimates(noise, grid))
            error = figure(f"warm; {name}: {n}", "µm", [rms_errors(warm(), TRUTH)[ERROR]], **{x: n})
            variance = bound(jacobian(grid, (*TRUTH, 1.0)), NOISE)[0, 0]
            found.append(error | {"Cramér-Rao bound": 1e6 * math.sqrt(variance)})
        subjects[f"decode: {n}"] = decode(frames[:8])
    rows = [
        figure(name, "µs", 1e-3 * taken, **{x: int(name.split(": ")[1])})
        for name, taken in interleave(subjects, rounds).items()
    ]
    return [
        Report("a frame of n × n cells", rows, slopes(rows, x)),
        Report("RMS of d", found, slopes(found, x)),
    ]


def ticks(step: int, rounds: int) -> list[Report]:
    """Return the mean tick of a hand that holds, idle without sensors; canned readings."""
    scenes: dict[str, dict[float, TimedScene]] = {
        "subscribers": {
            n: TimedScene(topics=("hand",), subscribers=n) for n in _SUBSCRIBERS[::step]
        },
        "sensors": {
            0: TimedScene({"tactile": {"backend": "none"}}, holds=False),
            1: TimedScene({"scene": {"fingers": ("left",)}}, holds=False),
            2: TimedScene(holds=False),
        },
        "rate [Hz]": {rate: TimedScene({"loop": {"rate": rate}}) for rate in _RATES[::step]},
    }
    return [_over(x, of_x, rounds) for x, of_x in scenes.items()]


def _over(x: str, scenes: dict[float, TimedScene], rounds: int) -> Report:
    means: dict[float, list[float]] = {value: [] for value in scenes}
    with contextlib.ExitStack() as stack:
        daemons = {value: standing(scene, stack) for value, scene in scenes.items()}
        stack.enter_context(RealTime(Settings()))
        for _ in range(rounds):
            for value, daemon in daemons.items():
                taken = in_place(daemon, 1.0 / daemon.loop.period, _IN_TURN)
                means[value].append(float(np.mean(taken)))
    rows = [figure(f"tick: {value:g}", "µs", found, **{x: value}) for value, found in means.items()]
    for row, daemon in zip(rows, daemons.values(), strict=True):
        row["of a processor %"] = 1e-4 * row["median"] / daemon.loop.period
    return Report(f"tick over {x}", rows, slopes(rows, x))
