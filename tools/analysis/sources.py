"""Reads recorded frames from any of the supported files.

A recording of the stream (.mcap) has its own settings and calibrations. A file of frames alone
(.npz, .npy or a folder of these, a Tekscan-style export) is the profile's left sensor, with its own
number of cells, and its own pitch where the file has it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError, SettingsError
from softfinger.daemon.perception.finger_model import FingerModel, make_models
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.recording import load_recording
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.arguments import to_stderr
from softfinger.tools.recordings.reader import Recording

Counts = NDArray[np.uint16]
Progress = Callable[[int], None]


@dataclass(frozen=True)
class Source:
    """Frames of the sensors in one file: ``frames(progress)`` yields (finger, t [s], counts).

    ``t`` counts from the first frame; ``total`` is the end of ``progress``. ``truths`` is the true
    contact at each frame, by name, where a file of one sensor has it.
    """

    settings: Settings
    models: tuple[FingerModel, FingerModel]
    fingers: tuple[int, ...]
    total: int
    frames: Callable[[Progress], Iterator[tuple[int, float, Counts]]]
    truths: dict[str, NDArray[np.float64]]
    live: NDArray[np.bool_] | None = None


def open_source(path: Path, settings: Settings, cache: Path | None, own: bool) -> Source:
    """Open a file of frames.

    With ``own`` a recording of the stream uses the settings it was made with, else ``settings``;
    frames alone need ``settings``, and have their shape unless the file tells its pitch itself.
    Raises RecordingError with the file's name, and SettingsError or TactileError.
    """
    if path.suffix == ".mcap":
        return _stream(path, settings, cache, own)
    return _frames_alone(path, settings, cache, own)


def _stream(path: Path, settings: Settings, cache: Path | None, own: bool) -> Source:
    from softfinger.daemon.loop.process_replay import with_calibrations
    from softfinger.tools.recordings.recomputed import recorded_settings

    recording = Recording(path, to_stderr("analyse"))
    if not recording.count(schema.TACTILE):
        raise RecordingError(f"{path}: no tactile frames in it")
    if own:
        settings, calibrations = recorded_settings(recording)
        with tempfile.TemporaryDirectory() as folder:
            models = make_models(with_calibrations(settings, calibrations, Path(folder)), cache)
    else:
        models = make_models(settings, cache)
    present = tuple(
        finger
        for finger, name in enumerate(FINGERS)
        if f"{schema.TACTILE.decode()}/{name}" in recording.counts
    )

    shape = settings.tactile.rows, settings.tactile.cols

    def frames(progress: Progress) -> Iterator[tuple[int, float, Counts]]:
        first = None
        for _, message in recording.messages([schema.TACTILE], progress=progress):
            if message.get("unit") != "count":
                raise RecordingError(f"{path}: frames in {message.get('unit')!r}, expected counts")
            finger = FINGERS.index(message["finger"])
            counts = np.frombuffer(message["data"], "<u2").reshape(message["rows"], message["cols"])
            if counts.shape != shape:
                raise RecordingError(
                    f"{path}: a frame of {counts.shape[0]} × {counts.shape[1]} cells, expected "
                    f"{shape[0]} × {shape[1]}"
                )
            first = message["timestamp"] if first is None else first
            yield finger, message["timestamp"] - first, counts

    return Source(settings, models, present, recording.size, frames, {})


def _frames_alone(path: Path, settings: Settings, cache: Path | None, own: bool) -> Source:
    tactile = settings.tactile
    recording = load_recording(path, tactile.pascal_per_count, tactile.rate)
    if own:
        raise SettingsError(
            f"{path}: no settings in it: name the tip and the sensor by --config PROFILE, as "
            "--config paper, or by --set"
        )
    count, rows, cols = recording.counts.shape
    changes: dict[str, float] = {"rows": rows, "cols": cols}
    if recording.pitch is not None:
        changes["pitch"], changes["pitch_y"] = recording.pitch
    elif (rows, cols) != (tactile.rows, tactile.cols):
        raise SettingsError(
            f"{path}: frames of {rows} × {cols} cells, expected {tactile.rows} × {tactile.cols}: "
            "set tactile.rows, tactile.cols and tactile.pitch"
        )
    settings = settings.model_copy(update={"tactile": tactile.model_copy(update=changes)})

    def frames(progress: Progress) -> Iterator[tuple[int, float, Counts]]:
        for k, t in enumerate(recording.t.tolist()):
            progress(k)
            yield 0, t, recording.counts[k]

    models = make_models(settings, cache)
    return Source(settings, models, (0,), count, frames, recording.truths, recording.live)
