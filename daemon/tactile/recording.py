"""Reads recordings of a tactile sensor from their files:

- ``.npz`` with ``frames`` [n, rows, cols] and optionally ``t`` [n] s, ``live`` [rows, cols] bool,
  and the true contact at each frame, where known: ``d`` [m], ``theta`` [rad], ``force`` [N], each
  [n].
- ``.npy``, one frame [rows, cols] or several [n, rows, cols]; or a folder of such files, in the
  order of their names with numbers read as numbers, and ``t.npy`` [n] s among them.
- a Tekscan-style ASCII export, any other file.

Frames of whole numbers are counts; others are Pa, and become counts by ``pascal_per_count``.
"""

from __future__ import annotations

import math
import re
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.tactile import tekscan

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
            with np.load(path, allow_pickle=False) as archive:
                held = {name: archive[name] for name in archive.files}
            return _checked(held, pascal_per_count, rate)
        if path.suffix == ".npy":
            return _checked({"frames": _frames(path)}, pascal_per_count, rate)
        return _export(path, pascal_per_count, rate)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise RecordingError(f"{path}: {reason}") from None


def _folder(path: Path, scale: float, rate: float) -> FrameRecording:
    def order(file: Path) -> list[tuple[int, str]]:
        parts = re.findall(r"\d+|\D+", file.stem)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    parts = []
    held: dict[str, NDArray[Any]] = {}
    for file in sorted(path.glob("*.npy"), key=order):
        if file.stem in ("t", "live", *TRUTHS):
            held[file.stem] = np.load(file, allow_pickle=False)
        else:
            parts.append(_frames(file))
    if not parts:
        raise ValueError("no .npy file with a frame in this folder")
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError("frames of different shapes in this folder")
    return _checked({"frames": np.concatenate(parts), **held}, scale, rate)


def _frames(path: Path) -> NDArray[Any]:
    """The frames of one .npy file, [n, rows, cols]."""
    array: NDArray[Any] = np.load(path, allow_pickle=False)
    if array.ndim not in (2, 3):
        raise ValueError(f"{path.name}: found shape {array.shape}, expected [n, rows, cols]")
    return array.reshape(-1, *array.shape[-2:])


def _export(path: Path, scale: float, rate: float) -> FrameRecording:
    export = tekscan.parse(path.read_text(encoding="latin-1"), 1.0 / rate)
    held: dict[str, NDArray[Any]] = {"frames": export.values, "t": export.t, "live": export.live}
    recording = _checked(held, 1.0 if export.raw else scale, rate)
    return recording if math.isnan(sum(export.pitch)) else replace(recording, pitch=export.pitch)


def _checked(held: dict[str, NDArray[Any]], scale: float, rate: float) -> FrameRecording:
    if "frames" not in held:
        raise ValueError("no array 'frames' in it")
    frames = held["frames"]
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
    t = _row(held, "t", count) if "t" in held else np.arange(count) / rate
    if (np.diff(t) <= 0.0).any():
        raise ValueError("t: the times must rise")
    live = np.ones(frames.shape[1:], np.bool_)
    if "live" in held:
        live = held["live"].astype(np.bool_)
        if live.shape != frames.shape[1:]:
            raise ValueError(f"live: found shape {live.shape}, expected {frames.shape[1:]}")
    truths = {name: _row(held, name, count) for name in TRUTHS if name in held}
    return FrameRecording(np.ascontiguousarray(frames, np.uint16), t - t[0], live, truths)


def _row(held: dict[str, NDArray[Any]], name: str, count: int) -> FloatArray:
    array = held[name]
    if array.shape != (count,) or array.dtype.kind not in "uif":
        raise ValueError(f"{name}: found shape {array.shape}, expected {count} numbers")
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: not finite")
    return values
