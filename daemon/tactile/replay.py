"""Recorded frames instead of a sensor's: read from files, at their own times, or set by the caller.

Files:
- ``.npz`` with ``frames`` [n, rows, cols] and optionally ``t`` [n] s, ``live`` [rows, cols] bool,
  and the true contact at each frame, where known: ``d`` [m], ``theta`` [rad], ``force`` [N], each
  [n].
- ``.npy``, one frame [rows, cols] or several [n, rows, cols]; or a folder of such files, in the
  order of their names with numbers read as numbers, and ``t.npy`` [n] s among them.
- a Tekscan-style ASCII export, any other file.

Frames of whole numbers are counts; others are Pa, and become counts by ``pascal_per_count``.
"""

from __future__ import annotations

import bisect
import math
import re
import zipfile
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.own_files import open_regular, read_file, unpacked_most
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile import tekscan
from softfinger.daemon.types import FINGERS, Frame

FloatArray = NDArray[np.float64]
TRUTHS = ("d", "theta", "force")
_FULL = 65535


@dataclass(frozen=True)
class FrameRecording:
    """Counts uint16 [n, rows, cols] at times t float64 [n], rising from 0 [s].

    ``live`` [rows, cols] is False where the sensor has no cell; ``truths`` is the true contact.
    """

    counts: NDArray[np.uint16]
    t: FloatArray
    live: NDArray[np.bool_]
    truths: dict[str, FloatArray] = field(default_factory=dict)
    pitch: tuple[float, float] | None = None  # x and y [m], where the file has it


def load_recording(path: Path, pascal_per_count: float, rate: float) -> FrameRecording:
    """Read a recording; without times its frames come at ``rate`` [Hz]. Raises RecordingError."""
    try:
        if path.is_dir():
            return _folder(path, pascal_per_count, rate)
        if path.suffix == ".npz":
            return _checked(_archive(path), pascal_per_count, rate)
        if path.suffix == ".npy":
            return _checked({"frames": _frames(path)}, pascal_per_count, rate)
        return _export(path, pascal_per_count, rate)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise RecordingError(f"{path}: {reason}") from None


def _folder(path: Path, scale: float, rate: float) -> FrameRecording:
    def order(file: Path) -> list[tuple[int, str]]:
        parts = re.findall(r"\d+|\D+", file.stem)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    parts = []
    arrays: dict[str, NDArray[Any]] = {}
    for file in sorted(path.glob("*.npy"), key=order):
        if file.stem in ("t", "live", *TRUTHS):
            arrays[file.stem] = _array(file)
        else:
            parts.append(_frames(file))
    if not parts:
        raise ValueError("no .npy file with a frame in this folder")
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError("frames of different shapes in this folder")
    return _checked({"frames": np.concatenate(parts), **arrays}, scale, rate)


def _frames(path: Path) -> NDArray[Any]:
    """The frames of one .npy file, [n, rows, cols]."""
    array = _array(path)
    if array.ndim not in (2, 3):
        raise ValueError(f"{path.name}: found shape {array.shape}, expected [n, rows, cols]")
    return array.reshape(-1, *array.shape[-2:])


def _archive(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file that are ours."""
    held = {}
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        left = unpacked_most(file)
        for name in ("frames", "t", "live", *TRUTHS):
            if f"{name}.npy" in archive.namelist():
                part = archive.getinfo(f"{name}.npy")
                # As NumPy packs them: others unpack beyond what they claim.
                if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{name}: found another compression than deflate")
                left -= part.file_size
                if left < 0:
                    raise ValueError(f"{name}: unpacks to more than a recording of this size does")
                with archive.open(part) as unpacked:
                    held[name] = _read_array(unpacked, part.file_size)
    return held


def _array(path: Path) -> NDArray[Any]:
    with open_regular(path) as file:
        return _read_array(file, min(path.stat().st_size, unpacked_most(file)))


def _read_array(file: IO[bytes], size: int) -> NDArray[Any]:
    """The array of a .npy file of so many bytes. Raises ValueError where it claims to be larger."""
    lib = np.lib.format
    header = {(1, 0): lib.read_array_header_1_0, (2, 0): lib.read_array_header_2_0}
    version = lib.read_magic(file)
    if version not in header:
        raise ValueError(f"found version {version} of .npy, expected 1.0 or 2.0")
    shape, _, kind = header[version](file)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(f"claims to hold {shape} of {kind}, more than the file has")
    file.seek(0)
    return np.asarray(lib.read_array(file, allow_pickle=False))


def _export(path: Path, scale: float, rate: float) -> FrameRecording:
    export = tekscan.parse(read_file(path).decode("latin-1"), 1.0 / rate)
    arrays: dict[str, NDArray[Any]] = {"frames": export.values, "t": export.t, "live": export.live}
    recording = _checked(arrays, 1.0 if export.raw else scale, rate)
    return recording if math.isnan(sum(export.pitch)) else replace(recording, pitch=export.pitch)


def _checked(arrays: dict[str, NDArray[Any]], scale: float, rate: float) -> FrameRecording:
    if "frames" not in arrays:
        raise ValueError("no array 'frames' in it")
    frames = arrays["frames"]
    if frames.ndim != 3 or frames.size == 0:
        raise ValueError(f"frames: found shape {frames.shape}, expected [n, rows, cols]")
    if frames.dtype.kind not in "uif":
        raise ValueError(f"frames: found {frames.dtype}, expected numbers")
    if frames.dtype.kind == "f":
        with np.errstate(over="ignore"):
            frames = np.round(frames / scale)
    if not (frames >= 0).all() or (frames > _FULL).any():
        raise ValueError(f"frames: found readings outside 0 to {_FULL} counts")
    count = len(frames)
    t = _row(arrays, "t", count) if "t" in arrays else np.arange(count) / rate
    if (np.diff(t) <= 0.0).any():
        raise ValueError("t: the times must rise")
    live = np.ones(frames.shape[1:], np.bool_)
    if "live" in arrays:
        live = arrays["live"].astype(np.bool_)
        if live.shape != frames.shape[1:]:
            raise ValueError(f"live: found shape {live.shape}, expected {frames.shape[1:]}")
    truths = {name: _row(arrays, name, count) for name in TRUTHS if name in arrays}
    return FrameRecording(np.ascontiguousarray(frames, np.uint16), t - t[0], live, truths)


def _row(arrays: dict[str, NDArray[Any]], name: str, count: int) -> FloatArray:
    array = arrays[name]
    if array.shape != (count,) or array.dtype.kind not in "uif":
        raise ValueError(f"{name}: found shape {array.shape}, expected {count} numbers")
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: not finite")
    return values


class GivenFrames:
    """A sensor whose newest frame the caller sets in ``frame``.

    ``live`` [rows, cols] is False where the sensor has no cell; None: it has all.
    """

    def __init__(self, live: NDArray[np.bool_] | None = None) -> None:
        self.frame: Frame | None = None
        self.live = live

    def open(self) -> None:
        """Do nothing: there is no port."""

    def latest(self) -> Frame | None:
        """Return the frame that was set last."""
        return self.frame

    def counters(self) -> dict[str, int]:
        """Return no counts: nothing can go wrong."""
        return {}

    def close(self) -> None:
        """Do nothing: there is no port."""


class ReplayTactile:
    """Frames of a recording at its own times, counted from ``open``.

    After its last frame and one mean interval it starts again, or, with ``tactile.replay_again``
    false, repeats that frame once with ``valid`` False.
    ``live`` [rows, cols] is False where the recording has no cell.
    """

    def __init__(self, settings: TactileSettings, clock: Clock, finger: int) -> None:
        """Raises TactileError when the recording can't be read or has another grid."""
        path = settings.recording[finger]
        if not path:
            raise TactileError(f"tactile.recording: found none for the {FINGERS[finger]} finger")
        try:
            recording = load_recording(Path(path), settings.pascal_per_count, settings.rate)
        except RecordingError as error:
            raise TactileError(str(error)) from None
        if recording.counts.shape[1:] != (settings.rows, settings.cols):
            rows, cols = recording.counts.shape[1:]
            raise TactileError(
                f"{path}: frames of {rows} × {cols} cells, {settings.rows} × {settings.cols} "
                f"expected: set tactile.rows and tactile.cols"
            )
        self.live: NDArray[np.bool_] = recording.live
        self._recording: FrameRecording = recording
        self._again = settings.replay_again
        self._clock = clock
        self._latency = settings.latency
        self._times: list[float] = recording.t.tolist()
        count = len(self._times)
        interval = self._times[-1] / (count - 1) if count > 1 else 1.0 / settings.rate
        self._period = self._times[-1] + interval
        self._start = 0.0
        self._due = math.inf
        self._frame: Frame | None = None

    def open(self) -> None:
        """Start with the recording's first frame, now."""
        self._start = self._due = self._clock.now()
        self._frame = None
        self.latest()

    def latest(self) -> Frame | None:
        """Return the newest frame that is due, None when not open."""
        now = self._clock.now() + 1e-9  # a frame due now counts as come
        if now < self._due:
            return self._frame
        turn = math.floor((now - self._start) / self._period)
        if turn and not self._again:
            return self._end()
        begin = self._start + turn * self._period
        count = len(self._times)
        k = max(bisect.bisect_right(self._times, now - begin) - 1, 0)
        arrival = begin + self._times[k]
        self._due = begin + (self._times[k + 1] if k + 1 < count else self._period)
        data = self._recording.counts[k]
        seq = turn * count + k + 1
        self._frame = Frame(seq, arrival - self._latency, arrival, True, data)
        return self._frame

    def counters(self) -> dict[str, int]:
        """Return ``frames`` that were due since open; ``resyncs`` and ``skipped_bytes`` stay 0."""
        frames = 0 if self._frame is None else self._frame.seq
        return {"frames": frames, "resyncs": 0, "skipped_bytes": 0}

    def close(self) -> None:
        """Deliver nothing more."""
        self._due = math.inf

    def _end(self) -> Frame | None:
        self._due = math.inf
        old = self._frame
        if old is not None:
            data = self._recording.counts[-1]
            arrival = self._start + self._times[-1]
            seq = len(self._times) + 1
            self._frame = Frame(seq, arrival - self._latency, arrival, False, data)
        return self._frame
