"""Run ``softfinger analyse FILE``: compute d, θ, force and energy versus time.

The frames are processed with the daemon's perception code. A stream recording (.mcap) contains its
own settings and calibrations. All other files (.npz, .npy, a folder of .npy files, a Tekscan-style
export) contain only frames. These frames are analysed with the settings of the profile's left
sensor. The grid size is taken from the file. A pitch in the file overrides the pitch in the
profile.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError, SettingsError, SoftfingerError
from softfinger.daemon.own_files import write_text
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.profile.validation import sensor_warnings
from softfinger.daemon.tactile.frame_files import FrameRecording, load_recording
from softfinger.daemon.tactile.replay import GivenFrames, pitch_difference
from softfinger.daemon.types import FINGERS, Frame, State
from softfinger.daemon.wire import schema
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
from softfinger.tools.arguments import add_profile, profile, to_stderr
from softfinger.tools.recordings.channels import channel_name
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import counts_of, recorded_models, recorded_settings
from softfinger.tools.sweep import Progress, Sweep, add_sweep

if TYPE_CHECKING:
    from softfinger.daemon.perception.finger_model import FingerModel

_EPILOG = """\
FILE is a recording (.mcap), an .npz file with frames [n, rows, cols] and t, an .npy file with
frames, a folder of .npy files, or a Tekscan-style ASCII export. A recording contains its settings.
For the other files, select a profile with --config, or set the missing values, for example
  --set tip.radius=0.02 --set tactile.pitch=0.0013 --set tactile.pascal_per_count=4
  --set tactile.noise=500 --set material.law=constant --set material.modulus=3e5
The results are written to FILE.contacts.csv in the same folder; PlotJuggler can plot this file.
Several files are analysed in parallel, one per processor."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    add_profile(parser)
    parser.add_argument("--csv", type=Path, metavar="OUT", help="write the results to this file")
    add_sweep(parser)


def run(arguments: argparse.Namespace) -> int:
    """Analyse files and write the results. Errors are raised only if there is a single file."""
    settings, files = profile(arguments), arguments.files
    if len(files) == 1:
        print(_analysed(arguments, settings, files[0]), end="")
        return 0
    if arguments.csv:
        raise SettingsError("analyse: --csv requires exactly one FILE")
    status = 0
    _compile(settings)
    found = Sweep("analyse", partial(_one_of_many, arguments, settings), files)
    for told, complaint in found.run(arguments.processes, arguments.scheduler):
        print(told, end="", flush=True)
        print(complaint, end="", file=sys.stderr, flush=True)
        status |= bool(complaint)
    return status


def _one_of_many(arguments: argparse.Namespace, settings: Settings, path: Path) -> tuple[str, str]:
    """Analyse one of several files; return the text to print and any error message."""
    try:
        return _analysed(arguments, settings, path), ""
    except (SoftfingerError, OSError) as error:
        return "", f"analyse: {error}\n"


def _analysed(arguments: argparse.Namespace, settings: Settings, path: Path) -> str:
    path = path if path.name else path.resolve()  # The name of Path(".") is empty.
    table = arguments.csv or path.with_name(path.name + ".contacts.csv")
    own = arguments.config is None and not arguments.set
    source = open_source(path, settings, own)
    _compile(source.settings)
    began = time.perf_counter()
    with Progress("analyse", source.total) as progress:
        contacts = analyse(source, progress)
    elapsed = time.perf_counter() - began
    write_csv(table, contacts)
    frames = sum(each.t.size for each in contacts)
    touching = sum(int((each.contact & each.valid).sum()) for each in contacts)
    reasons = sum((each.reasons() for each in contacts), Counter[str]())
    told = (
        f"{frames} frames in {elapsed:.2f} s ({frames / max(elapsed, 1e-9):.0f} per second): "
        f"{touching} with contact, {reasons.total()} invalid; {table}\n"
    )
    if source.recording is not None and not touching and not reasons:
        told += _silence(source.recording, source.settings.tactile)
    told += "".join(f"  {n} invalid: {reason}\n" for reason, n in reasons.most_common())
    return told


_EIGHT_BITS = 255
_NOISE_RATIO = 1.5  # measured noise above this multiple of tactile.noise is reported


def _silence(recording: FrameRecording, tactile: TactileSettings) -> str:
    """Return the maximum reading, the threshold and the likely reason why no contact was found."""
    from softfinger.kinematics.estimation.detection import PEAK_LEVEL

    scale = tactile.pascal_per_count if recording.whole else 1.0
    pressure, level = recording.largest * scale, PEAK_LEVEL * tactile.noise
    found = f"{recording.largest:.4g} counts, " if recording.whole else ""
    if pressure == 0.0:
        cause = "all cells read 0: check the sensor's cable"
    elif not recording.whole and recording.largest <= 1.0:
        cause = (
            "floats between 0 and 1 are probably fractions of the sensor's range, not Pa: "
            "multiply them by the sensor's maximum pressure"
        )
    elif pressure < level and not recording.whole:
        cause = "floats are interpreted as Pa: convert kPa to Pa, and save counts as integers"
    elif pressure < level:
        cause = "the tip was not loaded, or tactile.pascal_per_count is wrong for this sensor"
        if recording.largest <= _EIGHT_BITS < tactile.full_count:
            cause = "the counts have 8 bits, so set a larger tactile.pascal_per_count"
    else:
        counts = recording.counts[:, recording.live].astype(np.float64)
        noise = tactile.pascal_per_count * math.sqrt(np.mean(counts[counts > 0.0] ** 2))
        cause = "no adjacent cells are above the threshold, and single cells count as outliers"
        if noise > _NOISE_RATIO * tactile.noise:
            cause = f"the measured cell noise is {noise:.0f} Pa: set tactile.noise to this value"
    return (
        f"  no contact in any frame: the largest reading is {found}{pressure:.4g} Pa, and the "
        f"threshold is {level:.4g} Pa ({PEAK_LEVEL:g} times tactile.noise); {cause}\n"
    )


def _compile(settings: Settings) -> None:
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.processes.compile import build_kernels, print_event

    build_kernels(settings, print_event, FRAMES)


FloatArray = NDArray[np.float64]
Counts = NDArray[np.uint16]
OnProgress = Callable[[int], None]


@dataclass(frozen=True)
class Source:
    """Frames from all sensors in one file; ``frames(progress)`` yields (finger, t [s], counts).

    The counts are None if a tare of the sensor began at this time.
    In a stream recording, ``t`` is relative to the first message. In files that contain only
    frames, ``t`` is relative to the first frame, and ``recording`` is set. At the end, ``progress``
    is called with ``total``. Kernels are loaded only when ``models`` is called, so that errors in
    the file are reported first.
    """

    settings: Settings
    models: Callable[[], tuple[FingerModel, FingerModel]]
    total: int
    frames: Callable[[OnProgress], Iterator[tuple[int, float, Counts | None]]]
    recording: FrameRecording | None = None

    @property
    def truths(self) -> dict[str, NDArray[np.float64]]:
        """True contact quantities for each frame, if a single-sensor file contains them."""
        return {} if self.recording is None else self.recording.truths


def open_source(path: Path, settings: Settings, own: bool) -> Source:
    """Open a file that contains frames. Raises RecordingError, SettingsError or TactileError.

    If ``own`` is True, the settings in a stream recording replace ``settings``. For a file with
    only frames, ``own`` must be False, and a pitch in this file replaces the pitch in ``settings``.
    """
    if path.suffix == ".mcap":
        return _stream(path, settings, own)
    return _frames_alone(path, settings, own)


def _stream(path: Path, settings: Settings, own: bool) -> Source:
    recording = Recording(path, to_stderr("analyse"))
    if not recording.count(schema.TACTILE):
        raise RecordingError(f"{path}: the file does not contain any tactile frames")
    models = partial(recorded_models, recording) if own else partial(_models_of, settings)
    if own:
        settings, _ = recorded_settings(recording)
    channels = [channel_name(schema.TACTILE, {"finger": name}) for name in FINGERS]
    recorded = [finger for finger, name in enumerate(channels) if name in recording.counts]

    def frames(progress: OnProgress) -> Iterator[tuple[int, float, Counts | None]]:
        wanted = (schema.TACTILE, schema.COMMAND)
        for topic, message in recording.messages(wanted, progress=progress):
            t = recording.time(message)
            if topic == schema.TACTILE:
                counts = counts_of(recording, message, settings)
                yield FINGERS.index(message["finger"]), t, counts
            elif message.get("command") == "tare" and message.get("ok") is True:
                for finger in recorded:
                    yield finger, t, None

    return Source(settings, models, recording.size, frames)


def _frames_alone(path: Path, settings: Settings, own: bool) -> Source:
    tactile = settings.tactile
    recording = load_recording(path, tactile)
    if own:
        raise SettingsError(
            f"{path}: the file does not contain settings: describe the tip and the sensor with "
            "--config PROFILE, for example --config paper, or with --set"
        )
    count, rows, cols = recording.counts.shape
    for note in (*recording.notes, pitch_difference(recording, tactile.pitches)):
        if note:
            to_stderr("analyse")(f"{path}: {note}")
    changes: dict[str, float] = {"rows": rows, "cols": cols}
    if recording.pitch is not None:
        changes["pitch"], changes["pitch_y"] = recording.pitch
    elif (rows, cols) != (tactile.rows, tactile.cols):
        raise SettingsError(
            f"{path}: found frames of {rows} × {cols} cells, expected {tactile.rows} × "
            f"{tactile.cols}: set tactile.rows, tactile.cols and tactile.pitch"
        )
    settings = settings.changed(tactile=changes)
    for warning in sensor_warnings(settings):
        to_stderr("analyse")(f"{path}: {warning}")

    def frames(progress: OnProgress) -> Iterator[tuple[int, float, Counts]]:
        for k, t in enumerate(recording.t.tolist()):
            progress(k)
            yield 0, t, recording.counts[k]

    models = partial(_models_of, settings)
    return Source(settings, models, count, frames, recording)


def _models_of(settings: Settings) -> tuple[FingerModel, FingerModel]:
    from softfinger.daemon.perception.finger_model import make_models

    return make_models(settings)


# Contact fields and their units. CSV column names have the form name_unit.
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
    """Contacts of one sensor, one row per frame; COLUMNS lists the keys of ``values``."""

    finger: str
    t: FloatArray
    invalid: NDArray[np.int64]  # one `Invalid` value per frame
    contact: NDArray[np.bool_]
    values: dict[str, FloatArray]
    truths: dict[str, FloatArray]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask of the frames with a valid estimate."""
        return np.equal(self.invalid, Invalid.NONE)

    def reasons(self) -> Counter[str]:
        """Count the invalid frames for each reason."""
        return Counter(REASONS[k].text for k in self.invalid[~self.valid])


class _Pass:
    """Run the perception code for one sensor and store the computed rows."""

    def __init__(
        self, source: Source, models: tuple[FingerModel, FingerModel], finger: int
    ) -> None:
        from softfinger.daemon.perception.perception import Perception

        own = source.recording
        self._sensor = GivenFrames() if own is None else GivenFrames(own.live, own.full_count)
        self._perception = Perception(source.settings, {finger: self._sensor}, models)
        self._state = State()
        self._contact = self._state.contacts[finger]
        self._rows: list[tuple[float, ...]] = []

    def add(self, t: float, counts: Counts | None) -> None:
        if counts is None:
            self._perception.tare()
            return
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


def analyse(source: Source, progress: OnProgress) -> list[Contacts]:
    """Compute each sensor's contacts. Errors in ``source.frames`` are propagated."""
    models = source.models()
    passes: dict[int, _Pass] = {}
    for finger, t, counts in source.frames(progress):
        if finger not in passes:
            passes[finger] = _Pass(source, models, finger)
        passes[finger].add(t, counts)
    return [each.contacts(finger, source.truths) for finger, each in sorted(passes.items())]


def write_csv(path: Path, contacts: list[Contacts]) -> None:
    """Write a header with units, then one line per frame for each sensor. Raises OSError."""
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
