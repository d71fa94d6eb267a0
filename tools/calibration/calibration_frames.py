"""Collect the frames for a calibration step, either live for each load or from recordings."""

from __future__ import annotations

import argparse
import contextlib
import math
import shlex
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.perception.calibration_file import Calibration, Sensor
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.tactile.base import TactileSensor, make_sensor
from softfinger.daemon.tactile.frame_files import TRUTHS, FrameRecording, load_recording
from softfinger.daemon.tactile.replay import pitch_difference
from softfinger.daemon.types import FINGERS, Frame
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.tools.arguments import to_stderr

_UNITS = {"force": 1.0, "d": 1e-3, "theta": math.pi / 180.0}
_PATIENCE = 10.0  # maximum interval without a new frame [s]
_WAIT = 60.0  # time limit for `--move` [s]
_BEFORE = 4000  # maximum number of frames stored before a load is applied


@dataclass(frozen=True)
class Loads:
    """Loads that were applied in a calibration step; the lists have one element per load."""

    frames: list[NDArray[np.uint16]]  # counts [k, rows, cols]
    truths: dict[str, NDArray[np.float64]]  # known values [loads] of each quantity
    t: list[NDArray[np.float64]]  # times of the frames [k] [s]


def gather(arguments: argparse.Namespace, settings: Settings, calibration: Calibration) -> Loads:
    """Collect the loads of a step. Raises TactileError, RecordingError or CalibrationError."""
    sensor = calibration.sensor
    given = {
        name: np.array(getattr(arguments, name)) * unit
        for name, unit in _UNITS.items()
        if getattr(arguments, name)
    }
    if arguments.recording:
        runs = [_read(path, settings.tactile, sensor) for path in arguments.recording]
        whole = runs[0]
        by_frame = arguments.step not in ("tare", "equilibrate", "relaxation")
        if len(runs) == 1 and whole.truths and by_frame:
            # If one recording contains the whole run, each frame with a contact is a separate load.
            truths = whole.truths | _spread(given, len(whole.t))
            used = truths["d"] > 0.0 if "d" in truths else np.ones(len(whole.t), bool)
            loads = [slice(k, k + 1) for k in np.flatnonzero(used)]
            truths = {name: values[used] for name, values in truths.items()}
            return Loads([whole.counts[k] for k in loads], truths, [whole.t[k] for k in loads])
        return Loads(
            [each.counts for each in runs], _spread(given, len(runs)), [each.t for each in runs]
        )
    count = max([arguments.loads, 1, *(len(values) for values in given.values())])
    return _live(arguments, settings, sensor.finger, _spread(given, count), count)


def _read(path: Path, tactile: TactileSettings, sensor: Sensor) -> FrameRecording:
    """Read a recording, set saturated cells to ``full_count`` and print notes about defects.

    Raises RecordingError if the recording has other cells than the sensor.
    """
    found = load_recording(path, tactile)
    for note in found.notes:
        to_stderr("calibrate")(f"{path}: {note}")
    if found.counts.shape[1:] != (sensor.rows, sensor.cols):
        cells = " × ".join(map(str, found.counts.shape[1:]))
        raise RecordingError(
            f"{path}: found frames of {cells} cells, expected {sensor.rows} × {sensor.cols}"
        )
    if wrong := pitch_difference(found, sensor.pitch):
        raise RecordingError(f"{path}: {wrong}")
    if found.full_count is None:
        return found
    saturated = found.counts >= found.full_count
    counts = np.where(saturated, sensor.full_count, found.counts).astype(np.uint16)
    return replace(found, counts=counts)


def _spread(given: dict[str, Any], count: int) -> dict[str, Any]:
    """Expand each list to one value per load; a single value applies to all loads."""
    for name, values in given.items():
        if len(values) not in (1, count):
            raise CalibrationError(
                f"--{name}: found {len(values)} values for {count} loads, expected one value, or "
                "one value for each load"
            )
    return {name: np.broadcast_to(given[name], count).copy() for name in TRUTHS if name in given}


def _live(
    arguments: argparse.Namespace,
    settings: Settings,
    finger: str,
    truths: dict[str, Any],
    count: int,
) -> Loads:
    """Read frames from the finger's sensor while each load is applied."""
    clock = RealClock()
    loads = []
    with _opened(settings, clock, finger) as backend:
        for k in range(count):
            if arguments.step != "tare":
                load = {name: values[k] / _UNITS[name] for name, values in truths.items()}
                words = ", ".join(f"{name} {value:g}" for name, value in load.items())
                told = f"apply load {k + 1} of {count}{f': {words}' * bool(words)}"
                if arguments.step == "relaxation":
                    loads.append(_while_pressed(arguments, backend, clock, told, load))
                    continue
                bring(arguments, told, load=k + 1, **load)
            frames = _fresh(backend, clock)
            loads.append([next(frames) for _ in range(arguments.frames)])
    counts = [np.stack([frame.data for frame in load]) for load in loads]
    times = [np.array([frame.t_sample for frame in load]) for load in loads]
    return Loads(counts, truths, times)


def _while_pressed(
    arguments: argparse.Namespace,
    backend: TactileSensor,
    clock: RealClock,
    told: str,
    load: Mapping[str, float],
) -> list[Frame]:
    """Return the last frames before a load is applied, and ``--frames`` frames under the load."""
    before: deque[Frame] = deque(maxlen=_BEFORE)
    frames = _fresh(backend, clock)
    is_applied = threading.Event()

    def collect() -> None:
        while not is_applied.is_set():
            before.append(next(frames))

    with ThreadPoolExecutor(1) as pool:
        collected = pool.submit(collect)
        try:
            # Ctrl-C interrupts only the main thread, so this thread waits for Enter.
            bring(arguments, told, load=1, **load)
        finally:
            is_applied.set()
        collected.result()
    return [*before, *(next(frames) for _ in range(arguments.frames))]


def bring(arguments: argparse.Namespace, told: str, **load: float | str) -> None:
    """Print an instruction, then wait for Enter, or until the ``--move`` program exits.

    ``load`` contains the values that replace the words in braces. Raises CalibrationError.
    """
    command = arguments.move
    print(told if command else f"{told}; then press Enter", file=sys.stderr, flush=True)
    if not command:
        if not sys.stdin.readline():
            raise CalibrationError("the input ended before all loads were applied")
        return
    try:
        values = {"force": 0.0, "d": 0.0, "theta": 0.0, **load}
        words = [word.format(**values) for word in shlex.split(command)]
        done = subprocess.run(words, stdin=subprocess.DEVNULL, timeout=_WAIT).returncode
    except (
        LookupError,
        ValueError,
        AttributeError,
        TypeError,
        OSError,
        subprocess.TimeoutExpired,
    ) as error:
        raise CalibrationError(f"--move: {command}: {error}") from None
    if done != 0:
        raise CalibrationError(f"--move: {command}: the program exited with status {done}")


@contextlib.contextmanager
def _opened(settings: Settings, clock: RealClock, finger: str) -> Iterator[TactileSensor]:
    """Open the finger's sensor for the duration of this context. Raises TactileError."""
    hand = None
    if settings.tactile.backend == "simulated":
        from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand

        hand = SimulatedHand(settings, clock.now())
    backend = make_sensor(settings, clock, hand, FINGERS.index(finger))
    if backend is None:
        raise TactileError("tactile.backend: found none, expected a sensor")
    backend.open()
    with contextlib.closing(backend):
        yield backend


def _fresh(backend: TactileSensor, clock: RealClock) -> Iterator[Frame]:
    """Yield new frames. Raises TactileError.

    Frames that were scanned before the first call are skipped, because they may still show the
    previous load.
    """
    last = backend.latest()
    since = waited = clock.now()
    while True:
        clock.sleep_until(clock.now() + 1e-3)
        frame = backend.latest()
        if frame is not last and frame is not None:
            last, waited = frame, clock.now()
            if not frame.valid:
                raise TactileError(f"the sensor stopped sending: {getattr(backend, 'error', '')}")
            if frame.t_sample >= since:
                yield frame
        elif clock.now() - waited > _PATIENCE:
            raise TactileError(f"no new frame from the sensor within {_PATIENCE:g} s")
