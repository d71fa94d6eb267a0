"""Frames for a calibration step: live, load by load or in one press, or recorded."""

from __future__ import annotations

import argparse
import contextlib
import math
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.perception.calibration_file import Calibration, Converter
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.base import TactileSensor, make_sensor
from softfinger.daemon.tactile.replay import TRUTHS, load_recording
from softfinger.daemon.types import FINGERS, Frame
from softfinger.kinematics.calibration.calibration import CalibrationError

_UNITS = {"force": 1.0, "d": 1e-3, "theta": math.pi / 180.0}
_PATIENCE = 10.0  # s without a new frame
_WAIT = 60.0  # s for a press to begin
_TOUCHED = 3  # cells above their noise: something touches the tip
_CLEAR = 6.0  # standard deviations, and two counts, from which a cell is above its noise
_FEWEST = 5  # frames of a press
_LOADS = 6  # at least, where there are frames enough, …
_TOGETHER = 12  # … which are a load together at most
_FEWEST_LOADS = 3  # where frames were lost
_UNSEEN = 0.5  # of the way at most: E is 1 % off without the half, 5 % without three quarters
_MISSED = 1.5  # periods between two frames: one is missing, …
_SKIPPED = 3e-3  # … if they are s enough: of a faster board not each frame is taken
_BACK = 0.95  # of the run's largest reading: below it the tip goes down yet, or is released


@dataclass(frozen=True)
class Loads:
    """``frames``: for each load counts uint16 [k, rows, cols]; ``truths``: float64 [loads] each."""

    frames: list[NDArray[np.uint16]]
    truths: dict[str, NDArray[np.float64]]


def gather(arguments: argparse.Namespace, settings: Settings, calibration: Calibration) -> Loads:
    """Return the step's loads. Raises TactileError, RecordingError or CalibrationError.

    ``calibration`` has the sensor's facts and, live, its zero.
    """
    sensor = calibration.sensor
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
            # A run: each pressed frame is a load.
            used = whole.truths["d"] > 0.0 if "d" in whole.truths else np.ones(len(whole.t), bool)
            frames = [whole.counts[k : k + 1] for k in np.flatnonzero(used)]
            return Loads(frames, {name: whole.truths[name][used] for name in whole.truths})
        return Loads([each.counts for each in runs], _spread(given, len(runs)))
    if arguments.speed is not None:
        return _live_run(arguments, settings, calibration, given)
    count = max([arguments.loads, 1, *(len(values) for values in given.values())])
    truths = _spread(given, count)
    return Loads(_live(arguments, settings, sensor.finger, truths, count), truths)


def _spread(given: dict[str, Any], count: int) -> dict[str, Any]:
    """Each list of values with one for each load; a single value holds for all."""
    for name, values in given.items():
        if len(values) not in (1, count):
            raise CalibrationError(f"--{name}: found {len(values)} values for {count} loads")
    return {name: np.broadcast_to(given[name], count).copy() for name in TRUTHS if name in given}


def _live(
    arguments: argparse.Namespace,
    settings: Settings,
    finger: str,
    truths: dict[str, Any],
    count: int,
) -> list[NDArray[np.uint16]]:
    clock = RealClock()
    loads = []
    with _opened(settings, clock, finger) as backend:
        for k in range(count):
            if count > 1 or truths:
                load = {name: values[k] / _UNITS[name] for name, values in truths.items()}
                words = ", ".join(f"{name} {value:g}" for name, value in load.items())
                told = f"load {k + 1} of {count}: {words or 'uniform pressure'}"
                bring(arguments, told, {"load": k + 1, **load})
            # A frame scanned before this moment may still show the last load.
            frames = _fresh(backend, clock, clock.now())
            loads.append(np.stack([next(frames).data for _ in range(arguments.frames)]))
    return loads


def bring(arguments: argparse.Namespace, told: str, load: Mapping[str, float | str]) -> None:
    """Say what is wanted, and wait for Enter or for ``--move``. Raises CalibrationError."""
    _say(told if arguments.move else f"{told}; then press Enter")
    if arguments.move:
        _move(arguments.move, load)
    elif not sys.stdin.readline():
        raise CalibrationError("ended before all loads were on")


def _move(command: str, load: Mapping[str, float | str]) -> None:
    """Run the stage's program for one load, until it ends. Raises CalibrationError."""
    try:
        words = [
            word.format(**{"force": 0.0, "d": 0.0, "theta": 0.0, **load})
            for word in shlex.split(command)
        ]
        done = subprocess.run(words, stdin=subprocess.DEVNULL, timeout=_WAIT).returncode
    except (LookupError, ValueError, OSError, subprocess.TimeoutExpired) as error:
        raise CalibrationError(f"--move: {command}: {error}") from None
    if done != 0:
        raise CalibrationError(f"--move: {command}: it ended with {done}")


def _live_run(
    arguments: argparse.Namespace,
    settings: Settings,
    calibration: Calibration,
    given: dict[str, Any],
) -> Loads:
    """One press at constant speed, from the first touch to the deepest frame.

    Some frames in a row are a load at their mean d: in one alone noise hides a light touch's rim.

    d counts from the last frame without a touch: its zero is off by the travel of one and a half
    frames at most.
    """
    clock = RealClock()
    converter = Converter(calibration, settings.tactile.pascal_per_count)
    if calibration.tare is None:
        raise CalibrationError("--speed: tare first: a touch is detected by the noise it measures")
    noise = calibration.tare.noise
    speed, rate = arguments.speed * 1e-3, settings.tactile.rate
    longest = max(_MISSED / rate, _SKIPPED)
    with _opened(settings, clock, calibration.sensor.finger) as backend:
        _say(f"press at {arguments.speed:g} mm/s, beginning clear of the tip, then release")
        begin, last_free, most = clock.now(), -math.inf, 0.0
        frames: list[NDArray[np.uint16]] = []
        d: list[float] = []
        for frame in _fresh(backend, clock, begin):
            readings = converter.readings(frame.data.astype(np.float64))
            total = float(readings.sum())
            if not frames and clock.now() - begin > _WAIT:
                raise CalibrationError(f"no press that begins clear of the tip within {_WAIT:g} s")
            if np.count_nonzero(readings > _CLEAR * noise + 2.0) < _TOUCHED:
                if frames:  # released between two frames
                    break
                last_free = frame.t_sample
            elif last_free > -math.inf:
                if total < _BACK * most:
                    break
                if not frames and frame.t_sample - last_free > longest:
                    gap = 1e3 * (frame.t_sample - last_free)
                    raise CalibrationError(
                        f"--speed: no frame came in the {gap:.0f} ms before the first touch, where "
                        f"tactile.rate is {rate:g} Hz: press again"
                    )
                most = max(most, total)
                frames.append(frame.data)
                d.append(speed * (frame.t_sample - last_free))
    totals = [float(converter.readings(each.astype(np.float64)).sum()) for each in frames]
    count = rising(totals)
    if count < _FEWEST:
        raise CalibrationError(f"{count} frames while it was pressed: press slower")
    _say(f"{count} frames of a press to {1e3 * d[count]:.2f} mm")
    size = min(max(count // _LOADS, 1), _TOGETHER)
    # No load spans frames that were lost: all have the same range of depths.
    depths, counts = np.array(d[:count]), np.stack(frames[:count])
    steps = np.diff(d[: count + 1])
    lost = np.flatnonzero(steps[:-1] > speed * longest) + 1
    unseen = (steps[steps > speed * longest] - speed / rate).sum()
    loads = [
        run[k : k + size]
        for run in np.split(np.arange(count), lost)
        for k in range(0, len(run) - size + 1, size)
    ]
    if len(loads) < _FEWEST_LOADS or unseen > _UNSEEN * d[count]:
        raise CalibrationError(
            f"--speed: {count} frames came of a press, with too many missing where tactile.rate "
            f"is {rate:g} Hz: press again"
        )
    truths = _spread(given, len(loads)) | {"d": np.array([depths[k].mean() for k in loads])}
    return Loads([counts[k] for k in loads], truths)


def rising(totals: list[float]) -> int:
    """Return how many frames came while the press went down, none that rest at its depth."""
    return int(np.argmax(np.array(totals) > _BACK * max(totals))) if totals else 0


@contextlib.contextmanager
def _opened(settings: Settings, clock: RealClock, finger: str) -> Iterator[TactileSensor]:
    """The finger's sensor, open. Raises TactileError."""
    hand = None
    if settings.tactile.backend == "simulated":
        from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand

        hand = SimulatedHand(settings, clock.now())
    backend = make_sensor(settings, clock, hand, FINGERS.index(finger))
    if backend is None:
        raise TactileError("tactile.backend: found none, expected a sensor")
    backend.open()
    try:
        yield backend
    finally:
        backend.close()


def _fresh(backend: TactileSensor, clock: RealClock, since: float) -> Iterator[Frame]:
    """Each new frame scanned after ``since``. Raises TactileError when the sensor stops."""
    last = backend.latest()
    waited = clock.now()
    while True:
        clock.sleep_until(clock.now() + 1e-3)
        frame = backend.latest()
        if frame is not last and frame is not None:
            last, waited = frame, clock.now()
            if not frame.valid:
                raise TactileError(f"the sensor stopped: {getattr(backend, 'error', '')}")
            if frame.t_sample >= since:
                yield frame
        elif clock.now() - waited > _PATIENCE:
            raise TactileError(f"no new frame within {_PATIENCE:g} s")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
