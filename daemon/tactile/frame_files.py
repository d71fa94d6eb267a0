"""Read recorded pressure frames from files.

Supported files:

- ``.npz`` with ``frames`` [n, rows, cols], or with a single three-dimensional array of any name.
  The arrays ``t`` [n] and ``live`` [rows, cols] (bool) are optional. If the true contacts are
  known, the arrays ``d`` [m], ``theta`` [rad] and ``force`` [N], all [n], contain them.
- ``.npy`` with one frame [rows, cols] or several frames [n, rows, cols], or a folder of such files.
  The files are sorted by name; numbers in the names are compared by value. The folder may contain
  ``t.npy`` [n].
- Other files are read as Tekscan-style ASCII exports.

Integer frames contain counts. Floating-point frames are in Pa and are converted with
``pascal_per_count``. A cell that is NaN in all frames counts as dead. Negative readings are set to
0 if noise around a tared zero can explain them. Times are in seconds by default. Another unit is
detected from the intervals between the times or, for Unix times, also from the values.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import open_regular, read_file, unpacked_size_max
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile import tekscan

FloatArray = NDArray[np.float64]
TRUTHS = ("d", "theta", "force")
_TIMES = ("t", "time", "times", "timestamp", "timestamps")
_COUNT_MAX = 65535
_RANGE_ERROR = f"frames: found readings outside 0 to {_COUNT_MAX} counts"
_LISTED_COUNT_MAX = 8  # maximum number of arrays listed in a message
_SAMPLE_COUNT_MAX = 200  # maximum number of frames used to estimate the zero level and the noise
_NOISE_SIGMA_MAX = 6.0  # maximum magnitude of negative readings, in noise standard deviations
_CLIPPED_COUNT_MIN = 3  # minimum number of saturated cells that causes a warning
_UNITS = {1e-3: "ms", 1e-6: "µs", 1e-9: "ns"}  # time units other than s
_DATE_RANGE = (1e9, 4e9)  # range of Unix times [s], 2001 to 2096
# If the ratio of actual to expected frame interval is larger, the times are not in s.
_INTERVAL_RATIO_MAX = 100.0
_INTERVAL_RATIO_NOTED = 10.0  # ratio of actual to expected frame interval that causes a note


@dataclass(frozen=True)
class FrameRecording:
    """Recorded counts uint16 [n, rows, cols] and times t float64 [n] [s], which increase from 0.

    ``live`` [rows, cols] is False where the sensor has no cell. ``truths`` contains the true
    contact of each frame. ``largest`` is the maximum reading, in counts if ``whole`` is True and
    otherwise in Pa. ``notes`` lists corrections and suspicious values.
    """

    counts: NDArray[np.uint16]
    t: FloatArray
    live: NDArray[np.bool_]
    truths: dict[str, FloatArray]
    largest: float
    whole: bool
    pitch: tuple[float, float] | None = None  # pitch in x and y [m], None if unknown
    full_count: int | None = None  # reading of saturated cells, None if unknown
    notes: tuple[str, ...] = ()


def load_recording(path: Path, settings: TactileSettings) -> FrameRecording:
    """Read a recording from a file or a folder.

    The frame rate in the settings applies to a recording without times.

    Raises RecordingError if the recording cannot be read. The message names the file and the
    problem.
    """
    notes: list[str] = []
    try:
        if path.is_dir():
            found = _checked(_folder(path), settings, notes)
        elif path.suffix == ".npz":
            found = _checked(_archive(path, notes), settings, notes)
        elif path.suffix == ".npy":
            found = _checked({"frames": _frames(path)}, settings, notes)
        else:
            found = _export(path, settings, notes)
        if found.full_count is None and (clipped := _clipped(found, settings)):
            notes.append(clipped)
        return replace(found, notes=tuple(notes))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise RecordingError(f"{path}: {reason}") from None


def _folder(path: Path) -> dict[str, NDArray[Any]]:
    def order(file: Path) -> list[tuple[int, str]]:
        parts = re.findall(r"\d+|\D+", file.stem)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    parts = []
    arrays: dict[str, NDArray[Any]] = {}
    for file in sorted(path.glob("*.npy"), key=order):
        if file.stem in (*_TIMES, "live", *TRUTHS):
            arrays["t" if file.stem in _TIMES else file.stem] = _array(file)
        else:
            parts.append(_frames(file))
    if not parts:
        raise ValueError("this folder does not contain an .npy file with a frame")
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError("this folder contains frames of different shapes")
    return {"frames": np.concatenate(parts), **arrays}


def _frames(path: Path) -> NDArray[Any]:
    """Return the frames [n, rows, cols] in an .npy file."""
    array = _array(path)
    if array.ndim not in (2, 3):
        raise ValueError(f"{path.name}: found shape {array.shape}, expected [n, rows, cols]")
    return array.reshape(-1, *array.shape[-2:])


def _archive(path: Path, notes: list[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays with known names in an .npz file."""
    held: dict[str, NDArray[Any]] = {}
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        names = [name[:-4] for name in archive.namelist() if name.endswith(".npy")]
        wanted = {"frames": _frames_among(archive, names, notes)}
        wanted |= {name: name for name in ("live", *TRUTHS) if name in names}
        if times := next((name for name in _TIMES if name in names), None):
            wanted["t"] = times
        left = unpacked_size_max(file)
        for ours, name in wanted.items():
            part = _part(archive, name)
            left -= part.file_size
            if left < 0:
                raise ValueError(
                    f"{name}: the unpacked data are suspiciously large for a file of this size"
                )
            with archive.open(part) as unpacked:
                held[ours] = _read_array(unpacked, part.file_size)
    return held


def _frames_among(archive: zipfile.ZipFile, names: list[str], notes: list[str]) -> str:
    """Return the name of the frames array. Raises ValueError unless exactly one qualifies."""
    if "frames" in names:
        return "frames"
    shapes = {name: _shape(archive, name) for name in names[: 4 * _LISTED_COUNT_MAX]}
    stacks = [name for name, (shape, kind) in shapes.items() if len(shape) == 3 and kind in "uif"]
    if len(stacks) == 1:
        notes.append(
            f"the file does not contain an array 'frames'; using {stacks[0]!r}, the only "
            "three-dimensional array"
        )
        return stacks[0]
    described = [f"{name} {shape}" for name, (shape, _) in [*shapes.items()][:_LISTED_COUNT_MAX]]
    described += ["…"] * (len(names) > _LISTED_COUNT_MAX)
    raise ValueError(
        f"found {', '.join(described) or 'no arrays'}, expected an array 'frames' of shape [n, "
        "rows, cols]; rename the array that contains the frames"
    )


def _part(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo:
    part = archive.getinfo(f"{name}.npy")
    # NumPy stores the parts of an archive uncompressed or compresses them with deflate. With other
    # compression methods, the unpacked data may exceed the stated size.
    if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name}: found an unsupported compression method, expected deflate")
    return part


def _shape(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], str]:
    """Return the shape and dtype kind of an array without reading its data."""
    with archive.open(_part(archive, name)) as unpacked:
        shape, _, kind = _read_header(unpacked)
    return shape, kind.kind


def _array(path: Path) -> NDArray[Any]:
    with open_regular(path) as file:
        return _read_array(file, min(path.stat().st_size, unpacked_size_max(file)))


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    lib = np.lib.format
    header = {(1, 0): lib.read_array_header_1_0, (2, 0): lib.read_array_header_2_0}
    version = lib.read_magic(file)
    if version not in header:
        raise ValueError(f"found .npy format version {version}, expected 1.0 or 2.0")
    try:
        found = header[version](file)
    except Exception as error:  # NumPy raises errors of many types for text that is no header.
        raise ValueError(f"the .npy header is damaged: {error}") from None
    if not all(type(size) is int and 0 <= size < 2**31 for size in found[0]):
        raise ValueError(f"the .npy header is damaged: found shape {found[0]}")
    return found


def _read_array(file: IO[bytes], size: int) -> NDArray[Any]:
    """Read the array in an .npy file.

    Raises ValueError if the header declares an array of more than ``size`` bytes.
    """
    shape, _, kind = _read_header(file)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(
            f"the header declares an array of shape {shape} and type {kind}, but the file contains "
            "less data"
        )
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _export(path: Path, settings: TactileSettings, notes: list[str]) -> FrameRecording:
    export = tekscan.parse(tekscan.decode(read_file(path)), 1.0 / settings.rate)
    found = _checked({"frames": export.values}, settings, notes, export.raw)
    full_count = None
    if math.isfinite(export.full):
        scale = 1.0 if export.raw else settings.pascal_per_count
        full_count = max(min(int(export.full / scale), _COUNT_MAX), 1)
    return replace(found, t=export.t, pitch=export.pitch, full_count=full_count)


def _checked(
    arrays: dict[str, NDArray[Any]],
    settings: TactileSettings,
    notes: list[str],
    raw: bool = False,
) -> FrameRecording:
    """Check the arrays and convert the frames to counts; ``raw`` floats are counts, not Pa."""
    frames = arrays["frames"]
    if frames.ndim != 3 or frames.size == 0:
        raise ValueError(f"frames: found shape {frames.shape}, expected [n, rows, cols]")
    if frames.dtype.kind not in "uif":
        raise ValueError(f"frames: found elements of type {frames.dtype}, expected numbers")
    live = np.ones(frames.shape[1:], np.bool_)
    if "live" in arrays:
        live = arrays["live"].astype(np.bool_)
        if live.shape != frames.shape[1:]:
            raise ValueError(f"live: found shape {live.shape}, expected {frames.shape[1:]}")
        if not live.any():
            raise ValueError("live: found only False, expected True for each cell of the sensor")
    whole = raw or frames.dtype.kind != "f"
    scale = 1.0 if whole else settings.pascal_per_count
    frames, live = _without_dead(frames, live, _COUNT_MAX * scale)
    _check_below(frames, live, settings.noise * scale / settings.pascal_per_count, notes)
    largest = float(frames[:, live].max())
    if largest > _COUNT_MAX * scale:
        expected = f"at most {_COUNT_MAX} counts"
        if not whole and math.isfinite(largest):
            expected += f", set tactile.pascal_per_count to {largest / _COUNT_MAX:.3g} or more"
        raise _out_of_range(frames, frames.argmax(), expected)
    count = len(frames)
    t = np.arange(count) / settings.rate
    if "t" in arrays:
        t = _seconds(_row(arrays, "t", count), settings.rate, notes)
    truths = {name: _row(arrays, name, count).astype(np.float64) for name in TRUTHS & arrays.keys()}
    if frames.dtype.kind == "f":
        frames = np.round(frames / scale)
    counts = np.maximum(frames, 0).astype(np.uint16)
    return FrameRecording(counts, t, live, truths, largest, whole)


def _without_dead(
    frames: NDArray[Any], live: NDArray[np.bool_], most: float
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Mark cells as dead if they are NaN in all frames; clear dead cells' out-of-range readings."""
    if frames.dtype.kind == "f":
        unknown = np.isnan(frames)
        live = live & ~unknown.all(axis=0)
        if not live.any():
            raise ValueError(f"{_RANGE_ERROR}: every cell is NaN in all frames")
        wrong = (unknown | np.isinf(frames)) & live
        if wrong.any():
            raise _out_of_range(frames, wrong.argmax(), "a number, or NaN in all frames")
    if not live.all():
        usable = live | ((frames >= 0) & (frames <= most))
        frames = np.where(usable, frames, np.zeros((), frames.dtype))
    return frames, live


def _check_below(
    frames: NDArray[Any], live: NDArray[np.bool_], noise: float, notes: list[str]
) -> None:
    """Add a note about negative readings caused by noise.

    Raises ValueError for negative readings that noise cannot explain.
    """
    lowest = float(frames.min())
    if lowest >= 0.0:
        return
    sample = frames[:: max(len(frames) // _SAMPLE_COUNT_MAX, 1)][:, live].astype(np.float64)
    middle = float(np.median(sample))
    noise = max(noise, 1.4826 * float(np.median(np.abs(sample - middle))))
    expected = ""
    if middle < -noise:
        expected = (
            f"0 or noise around 0; half of the readings are {middle:.3g} or less: tare the frames"
        )
    elif lowest < -_NOISE_SIGMA_MAX * noise:
        expected = f"at least {-_NOISE_SIGMA_MAX * noise:.3g}, the lower limit for noise around 0"
    if expected:
        raise _out_of_range(frames, frames.argmin(), expected)
    share = np.count_nonzero(frames < 0) / (len(frames) * np.count_nonzero(live))
    notes.append(
        f"{share:.0%} of the readings are below 0, down to {lowest:.4g}: they are treated as "
        "noise after a tare and set to 0"
    )


def _out_of_range(frames: NDArray[Any], place: np.intp, expected: str) -> ValueError:
    """Return the error for the reading at index ``place`` of the flattened frames."""
    k, i, j = np.unravel_index(place, frames.shape)
    return ValueError(
        f"{_RANGE_ERROR}: frame {k + 1} of {len(frames)}, row {i + 1}, cell {j + 1} "
        f"(frames[{k}, {i}, {j}]) is {frames[k, i, j]:.10g}, expected {expected}"
    )


def _row(arrays: dict[str, NDArray[Any]], name: str, count: int) -> NDArray[Any]:
    array = arrays[name]
    if name == "t" and array.dtype.kind in "mM":
        array = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64)
    if array.shape != (count,) or array.dtype.kind not in "uif":
        kind = f"{array.dtype} of shape {array.shape}"
        raise ValueError(f"{name}: found {kind}, expected {count} numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: found a number that is not finite")
    return array


def _seconds(t: NDArray[Any], rate: float, notes: list[str]) -> FloatArray:
    """Convert times to seconds since the first frame.

    Raises ValueError if the times do not increase.
    """
    if t.dtype.kind in "ui":
        t = t.astype(np.int64)  # The differences of unsigned or short integers would wrap around.
    first = t[0].item()
    since: FloatArray = (t - t[0]).astype(np.float64)
    steps = np.diff(since)
    if (steps <= 0.0).any():
        k = int(np.argmax(steps <= 0.0))
        raise ValueError(
            f"t: expected increasing times, found t[{k}] = {t[k]}, t[{k + 1}] = {t[k + 1]}"
        )
    if not steps.size:
        return since
    step = float(np.median(steps))
    # A board clock that is interpreted as a date has an interval ratio of 10⁶.
    longest = _INTERVAL_RATIO_MAX**2 / rate if t.dtype.kind == "i" else math.inf
    for factor in (1.0, *_UNITS):
        # The times are dates, unless they are integers that would be too far apart.
        if _DATE_RANGE[0] <= first * factor < _DATE_RANGE[1] and step * factor <= longest:
            break
    else:
        factor = _factor(t, step, rate)
    if factor in _UNITS or not 1.0 / _INTERVAL_RATIO_NOTED < step * rate < _INTERVAL_RATIO_NOTED:
        notes.append(
            f"t: interpreted as {_UNITS.get(factor, 'seconds')}, which gives {step * factor:.4g} s "
            f"between frames, but tactile.rate corresponds to {1.0 / rate:.4g} s"
        )
    return np.multiply(since, factor)


def _factor(t: NDArray[Any], step: float, rate: float) -> float:
    """Infer the unit [s] of non-Unix times from the intervals between them. Raises ValueError."""
    whole = t.dtype.kind in "ui"
    if len(t) > 2 and (t % 1 == 0).all() and (np.diff(t) == 1).all():
        if 1.0 / _INTERVAL_RATIO_NOTED < rate < _INTERVAL_RATIO_NOTED:  # The rate is about 1 Hz.
            return 1.0
        raise ValueError(
            "t: found frame numbers that increase by 1, expected times in s; remove t if the "
            "times are unknown"
        )
    if not whole and step * rate <= _INTERVAL_RATIO_MAX:
        return 1.0
    return min((1.0, *_UNITS)[whole:], key=lambda factor: abs(math.log(step * factor * rate)))


def _clipped(found: FrameRecording, settings: TactileSettings) -> str:
    """Return a warning if several cells share the maximum reading, which indicates saturation."""
    counts = np.where(found.live, found.counts, 0)
    top = int(counts.max())
    at_top = counts == top
    cells = np.count_nonzero(at_top.any(axis=0))
    if top == 0 or top >= settings.full_count or cells < _CLIPPED_COUNT_MIN:
        return ""
    # Rounding alone makes the next lower reading about as frequent as the maximum reading.
    below = int(counts[~at_top].max(initial=0))
    if below and np.count_nonzero(at_top) <= 2 * np.count_nonzero(counts == below):
        return ""
    unit = "counts" if found.whole else f"counts of {settings.pascal_per_count:g} Pa"
    return (
        f"{cells} cells have the same maximum reading, {top} {unit}: if these cells are "
        f"saturated, set tactile.full_count = {top}, because d would be overestimated otherwise"
    )
