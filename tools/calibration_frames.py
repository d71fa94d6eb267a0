"""Frames for a calibration step: load by load from the live sensor, or from recordings."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.calibration import Sensor
from daemon.clock import RealClock
from daemon.settings import Settings
from daemon.tactile import make_sensor
from daemon.tactile.base import TactileError
from daemon.tactile.recording import TRUTHS, RecordingError, load_recording
from kinematics.calibration import CalibrationError

_UNITS = {"force": 1.0, "d": 1e-3, "theta": math.pi / 180.0}
_PATIENCE = 3.0  # s without a new frame


@dataclass(frozen=True)
class Loads:
    """``frames``: for each load counts uint16 [k, rows, cols]; ``truths``: float64 [loads] each."""

    frames: list[NDArray[np.uint16]]
    truths: dict[str, NDArray[np.float64]]


def gather(arguments: argparse.Namespace, settings: Settings, sensor: Sensor) -> Loads:
    """The step's loads. Raises TactileError, RecordingError or CalibrationError."""
    given = {
        name: np.array(getattr(arguments, name)) * unit
        for name, unit in _UNITS.items()
        if getattr(arguments, name)
    }
    tactile = settings.tactile
    if arguments.recording:
        runs = [
            load_recording(path, tactile.pascal_per_count, tactile.rate)
            for path in arguments.recording
        ]
        for path, recording in zip(arguments.recording, runs, strict=True):
            if recording.counts.shape[1:] != (sensor.rows, sensor.cols):
                found = " × ".join(map(str, recording.counts.shape[1:]))
                raise RecordingError(
                    f"{path}: frames of {found} cells, {sensor.rows} × {sensor.cols} expected"
                )
        whole = runs[0]
        if len(runs) == 1 and whole.truths:
            # A run: each frame is a load of its own; only pressed ones tell something.
            used = whole.truths["d"] > 0.0 if "d" in whole.truths else np.ones(len(whole.t), bool)
            frames = [whole.counts[k : k + 1] for k in np.flatnonzero(used)]
            return Loads(frames, {name: whole.truths[name][used] for name in whole.truths})
        return Loads([each.counts for each in runs], _spread(given, len(runs)))
    count = max([arguments.loads, 1, *(len(values) for values in given.values())])
    truths = _spread(given, count)
    return Loads(_live(arguments, settings, sensor, truths, count), truths)


def _spread(given: dict[str, Any], count: int) -> dict[str, Any]:
    """Each list of values as long as there are loads; one value stands for all."""
    for name, values in given.items():
        if len(values) not in (1, count):
            raise CalibrationError(f"--{name}: found {len(values)} values for {count} loads")
    return {name: np.broadcast_to(given[name], count).copy() for name in TRUTHS if name in given}


def _live(
    arguments: argparse.Namespace,
    settings: Settings,
    sensor: Sensor,
    truths: dict[str, Any],
    count: int,
) -> list[NDArray[np.uint16]]:
    clock = RealClock()
    hand = None
    if settings.tactile.backend == "simulated":
        from daemon.simulation.hand import SimulatedHand

        hand = SimulatedHand(settings, clock.now())
    backend = make_sensor(settings, clock, hand, 0 if sensor.finger == "left" else 1)
    if backend is None:
        raise TactileError("tactile.backend: found none, expected a sensor")
    backend.open()
    try:
        loads = []
        for k in range(count):
            if count > 1 or truths:
                words = [f"{name} {values[k] / _UNITS[name]:g}" for name, values in truths.items()]
                print(
                    f"load {k + 1} of {count}: {', '.join(words) or 'uniform pressure'}; "
                    "then press Enter",
                    file=sys.stderr,
                    flush=True,
                )
                if not sys.stdin.readline():
                    raise CalibrationError("ended before all loads were on")
            loads.append(_take(backend, clock, arguments.frames))
        return loads
    finally:
        backend.close()


def _take(backend: Any, clock: RealClock, count: int) -> NDArray[np.uint16]:
    """The next ``count`` frames. Raises TactileError when the sensor stops."""
    frames: list[NDArray[np.uint16]] = []
    last = backend.latest()
    waited = clock.now()
    while len(frames) < count:
        clock.sleep_until(clock.now() + 1e-3)
        frame = backend.latest()
        if frame is not last and frame is not None:
            last, waited = frame, clock.now()
            if not frame.valid:
                raise TactileError(f"the sensor stopped: {getattr(backend, 'error', '')}")
            frames.append(frame.data)
        elif clock.now() - waited > _PATIENCE:
            raise TactileError(f"no new frame within {_PATIENCE:g} s")
    return np.stack(frames)
