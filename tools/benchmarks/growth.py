"""How cost and error grow: with cells, tolerance and material, subscribers, sensors, rate, kernels.

Each table is of one run in turns, and ends with the fitted slopes: the exponent of a power law over
all points, and between the last two, which shows where it bends.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks import contact, estimator
from softfinger.tools.benchmarks.estimator import ERROR, LINEAR, NOISE, TIP, TRUTH, WIDTH
from softfinger.tools.benchmarks.measuring import (
    Report,
    Row,
    Subject,
    figure,
    interleave,
    slopes,
    timed,
)
from softfinger.tools.benchmarks.rigs import SOFTFINGER, busy_seconds, can, hold, virtual_daemon
from softfinger.tools.benchmarks.scenes import TimedScene, standing
from softfinger.tools.benchmarks.startup import start
from softfinger.tools.benchmarks.tick import in_place

_SIDES = (8, 16, 32, 44, 64, 96, 128)  # cells
_PITCH = WIDTH / 44
_TOLERANCES = tuple(10.0**-k for k in range(3, 14))
_SUBSCRIBERS = (0, 1, 3, 10, 30, 100)
_RATES = (100.0, 200.0, 500.0, 1000.0, 2000.0)  # Hz
# Words of scenes, each with more kernels.
_STARTS = (
    ("--set", "tactile.backend=none"),
    ("--set", "servos.backend=none"),
    (),
    ("--set", "tactile.blur=0.5e-3"),
)
MATERIALS = {
    "Table I": contact.LAW,
    "constant": LINEAR,
    "points": Material.from_points(
        np.linspace(0.1, 1.0, 10), 1e5 * np.sinh(np.linspace(0.1, 1.0, 10))
    ),
}
_FRAMES = 32
_IN_TURN = 20  # ticks: whole periods of frames and state


def measure(brief: bool = False) -> list[Report]:
    """All of them; ``brief`` takes every other point."""
    step, rounds = (2, 5) if brief else (1, 25)
    return [
        *cells(_SIDES[::step], rounds),
        *tolerances(_TOLERANCES[::step], rounds),
        *ticks(step, 2 * rounds),
        recording(_RATES[::step], rounds),
        starts(_STARTS[::step], 1 if brief else 3),
    ]


def _grown(title: str, rows: list[Row], x: str) -> Report:
    return Report(title, rows, x, notes=slopes(rows, x), grows=True)


def cells(sides: tuple[int, ...], rounds: int) -> list[Report]:
    """Time and error of an estimate, and of decoding, at the same sensor size and at one pitch."""
    x = "cells a side"
    random = np.random.default_rng(4)
    cases = {}
    limits = {}
    for n in sides:
        noise = NOISE * random.standard_normal((_FRAMES, n, n))
        for name, pitch in (("same pitch", _PITCH), ("same size", WIDTH / n)):
            grid = SensorGrid(n, n, pitch)
            frames = grid.pressure(TIP, LINEAR, *TRUTH) + noise
            for words, cold in (("warm", False), ("cold", True)):
                case = estimator.kernel_case(frames, TRUTH, grid=grid, cold=cold)
                cases[f"{words}; {name}: {n}"] = case, n
            empty = replace(estimator.kernel_case(noise, TRUTH, grid=grid), found=None)
            cases[f"no contact; {name}: {n}"] = empty, n
            sigma = estimator.bound(estimator.jacobian(grid, (*TRUTH, 1.0)), NOISE)[0, 0]
            limits[f"warm; {name}: {n}"] = 1e6 * math.sqrt(sigma)
        cases[f"decode: {n}"] = estimator.Timed(estimator.decode("cobs", frames[:8])), n
    times = interleave({name: case.subject for name, (case, _) in cases.items()}, rounds)
    rows, errors = [], []
    for name, (case, n) in cases.items():
        rows.append(figure(name, "µs", 1e-3 * times[name], **{x: n}))
        if name in limits:
            error = figure(name, "µm", [case.errors[ERROR]], **{x: n})
            errors.append(error | {"Cramér-Rao bound": limits[name]})
    return [_grown("a frame of n × n cells", rows, x), _grown("RMS of d", errors, x)]


def tolerances(wanted: tuple[float, ...], rounds: int) -> list[Report]:
    """A table's lookup time, size and build time, for each material."""
    x = "tolerance"
    d, theta = contact.points(512)
    built: dict[str, tuple[ContactTable, list[float], Row]] = {}
    for name, material in MATERIALS.items():
        for tolerance in wanted:
            with contextlib.suppress(TableError):  # not within 256 KiB
                table = ContactTable.build(TIP, material, tolerance)
                spent = timed(partial(ContactTable.build, TIP, material, tolerance), 2)
                facts = {x: tolerance, "bound": table.max_error}
                built[f"{name}: {tolerance:g}"] = table, spent, facts
    subjects = {
        name: Subject(partial(contact.loop, table, d, theta), d.size)
        for name, (table, _, _) in built.items()
    }
    times = interleave(subjects, rounds)
    found: dict[str, list[Row]] = {"lookup": [], "table's size": [], "table's build": []}
    for name, (table, spent, facts) in built.items():
        samples = ("ns", times[name]), ("KiB", [table.data.nbytes / 1024]), ("ms", spent)
        for rows, (unit, values) in zip(found.values(), samples, strict=True):
            rows.append(figure(name, unit, np.array(values), **facts))
    for row in found["table's build"]:
        row |= {key: 1e-3 * row[key] for key in ("median", "IQR", "p99")}
    return [_grown(title, rows, x) for title, rows in found.items()]


def ticks(step: int, rounds: int) -> list[Report]:
    """The mean tick in place of a hand that holds, but without sensors idle; canned readings."""
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
        rates = {value: 1.0 / daemon.loop.period for value, daemon in daemons.items()}
    rows = [figure(f"tick: {value:g}", "µs", found, **{x: value}) for value, found in means.items()]
    for row, rate in zip(rows, rates.values(), strict=True):
        row["of a processor %"] = 1e-4 * row["median"] * rate
    return _grown(f"tick over {x}", rows, x)


def recording(rates: tuple[float, ...], rounds: int) -> Report:
    """Processor time of a recorder that gets all topics, the state at every tick."""
    x = "rate [Hz]"
    rows = []
    for rate in rates:
        sections = {"loop": {"rate": rate}, "stream": {"state_rate": rate}}
        with tempfile.TemporaryDirectory() as folder, virtual_daemon(sections) as daemon:
            hold(daemon)
            can(daemon)
            words = ["record", "--address", daemon.settings.stream.address, f"{folder}/a.mcap"]
            with subprocess.Popen([*SOFTFINGER, *words], stdout=subprocess.DEVNULL) as recorder:
                publishing = daemon.loop._publishing
                assert publishing is not None
                while not publishing._publisher.wanted and recorder.poll() is None:
                    in_place(daemon, rate, _IN_TURN)
                shares = []
                for _ in range(min(rounds, 10)):
                    began, before = time.monotonic(), busy_seconds(recorder.pid)
                    in_place(daemon, rate, round(0.3 * rate))
                    taken = busy_seconds(recorder.pid) - before
                    shares.append(100.0 * taken / (time.monotonic() - began))
                recorder.terminate()
        rows.append(figure(f"record: {rate:g}", "% of a processor", shares, **{x: rate}))
    return _grown("recorder", rows, x)


def starts(scenes: tuple[tuple[str, ...], ...], count: int) -> Report:
    """First and later starts, to the first state, of scenes that need more and more kernels."""
    x = "kernels"
    rows: list[Row] = []
    for words in scenes:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            cold = [start(folder, *words).seconds]
            kernels = len(list(folder.rglob("*.nbc")))
            warm = [start(folder, *words).seconds for _ in range(count)]
        for kind, seconds in (("cold", cold), ("warm", warm)):
            rows.append(figure(f"{kind}: {kernels}", "s", seconds, **{x: kernels}))
    return _grown("start to the first state", rows, x)
