"""d, θ, force and energy of recorded frames, by the daemon's own perception.

A recording of the stream (.mcap) has its own settings and calibrations. A file of frames alone
(.npz, .npy or a folder of these, a Tekscan-style export) is the profile's left sensor, with its own
number of cells, and its own pitch where the file has it.
"""

from __future__ import annotations

import csv
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError, SettingsError
from softfinger.daemon.own_files import write_text
from softfinger.daemon.perception.finger_model import FingerModel, make_models
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.replay import GivenFrames, load_recording
from softfinger.daemon.types import FINGERS, Frame, State
from softfinger.daemon.wire import schema
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
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


def open_source(path: Path, settings: Settings, own: bool) -> Source:
    """Open a file of frames.

    With ``own`` a recording of the stream uses the settings it was made with, else ``settings``;
    frames alone need ``settings``, and have their shape unless the file tells its pitch itself.
    Raises RecordingError with the file's name, and SettingsError or TactileError.
    """
    if path.suffix == ".mcap":
        return _stream(path, settings, own)
    return _frames_alone(path, settings, own)


def _stream(path: Path, settings: Settings, own: bool) -> Source:
    from softfinger.daemon.loop.process_replay import with_calibrations
    from softfinger.tools.recordings.recomputed import recorded_settings

    recording = Recording(path, to_stderr("analyse"))
    if not recording.count(schema.TACTILE):
        raise RecordingError(f"{path}: no tactile frames in it")
    if own:
        settings, calibrations = recorded_settings(recording)
        with tempfile.TemporaryDirectory() as folder:
            models = make_models(with_calibrations(settings, calibrations, Path(folder)))
    else:
        models = make_models(settings)
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


def _frames_alone(path: Path, settings: Settings, own: bool) -> Source:
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

    models = make_models(settings)
    return Source(settings, models, (0,), count, frames, recording.truths, recording.live)


FloatArray = NDArray[np.float64]

# The contact's fields and their units; the CSV's header says name_unit.
COLUMNS = (
    ("d", "m"),
    ("d_std", "m"),
    ("theta", "rad"),
    ("theta_std", "rad"),
    ("tilt_y", "rad"),
    ("force", "N"),
    ("energy", "J"),
    ("gain", ""),
)


@dataclass(frozen=True)
class Contacts:
    """One sensor's contacts, a row a frame. ``values`` by the names in COLUMNS, SI units."""

    finger: str
    t: FloatArray
    invalid: NDArray[np.int64]  # an `Invalid` each
    contact: NDArray[np.bool_]
    values: dict[str, FloatArray]
    truths: dict[str, FloatArray]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Frames whose estimate can be used."""
        return np.equal(self.invalid, Invalid.NONE)

    def reasons(self) -> Counter[str]:
        """Count the reasons for which frames can't be used."""
        return Counter(REASONS[k].text for k in self.invalid[~self.valid])


class _Pass:
    """One sensor's perception and its rows."""

    def __init__(self, source: Source, finger: int) -> None:
        self._sensor = GivenFrames(source.live)
        self._perception = Perception(source.settings, {finger: self._sensor}, source.models)
        self._state = State()
        self._contact = self._state.contacts[finger]
        self._rows: list[tuple[float, ...]] = []

    def add(self, t: float, counts: NDArray[np.uint16]) -> None:
        self._sensor.frame = Frame(len(self._rows) + 1, t, t, True, counts)
        self._state.t = t
        self._perception.update(self._state)
        contact = self._contact
        values = [getattr(contact, name) for name, _ in COLUMNS]
        self._rows.append((t, contact.invalid, contact.contact, *values))

    def contacts(self, finger: int, truths: dict[str, FloatArray]) -> Contacts:
        table = np.array(self._rows, np.float64).reshape(-1, 3 + len(COLUMNS)).T
        values = {name: table[3 + k] for k, (name, _) in enumerate(COLUMNS)}
        return Contacts(
            FINGERS[finger], table[0], table[1].astype(int), table[2] > 0.0, values, truths
        )


def analyse(source: Source, progress: Progress) -> list[Contacts]:
    """Return the contacts of each sensor. Raises what the source's frames raise."""
    passes = {finger: _Pass(source, finger) for finger in source.fingers}
    for finger, t, counts in source.frames(progress):
        passes[finger].add(t, counts)
    return [each.contacts(finger, source.truths) for finger, each in passes.items()]


def write_csv(path: Path, contacts: list[Contacts]) -> None:
    """Write one line a frame, sensors one after the other; names with units. Raises OSError."""
    names = [f"{name}_{unit}" if unit else name for name, unit in COLUMNS]
    truths = sorted({name for each in contacts for name in each.truths})
    units = dict(COLUMNS)
    with write_text(path, newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        known = [f"{name}_true_{units[name]}" for name in truths]
        writer.writerow(["t_s", "finger", "valid", "contact", *names, *known, "invalid"])
        for each in contacts:
            columns = [each.values[name] for name, _ in COLUMNS]
            columns += [each.truths[name] for name in truths]
            numbers = zip(*(column.tolist() for column in columns), strict=True)
            for t, invalid, touches, row in zip(
                each.t.tolist(), each.invalid.tolist(), each.contact.tolist(), numbers, strict=True
            ):
                start = f"{t:.6f}", each.finger, int(not invalid), int(touches)
                writer.writerow([*start, *row, REASONS[invalid].text])
