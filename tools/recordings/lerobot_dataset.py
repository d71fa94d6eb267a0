"""A recording as a LeRobot dataset, version 3.0: one episode, rows at one rate, grids as images.

A row has the newest state and the newest frame of each sensor that had come by its time, under
LeRobot's names: the same as of a live hand (`observation`, `image`). Joints' goals are its action.
"""

from __future__ import annotations

import itertools
import json
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import write_bytes, write_text
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import HandState, TactileFrame
from softfinger.tools.extras import require
from softfinger.tools.recordings.reader import Recording

_PLAIN = {"pos": "q", "vel": "dq", "current": "current", "contact": "contact"}
_FELT = ("d", "theta", "force")  # 0 while nothing touches the tip
_OBJECT = ("angle", "width")  # 0 while the object's pose is not known
STATE = tuple(
    [f"{name}.{each}" for name in FINGERS for each in (*_PLAIN, *_FELT, "touch_age")]
    + [f"object.{each}" for each in _OBJECT]
)
JOINTS = tuple(f"{name}.pos" for name in FINGERS)
IMAGES = {name: f"{name}_touch" for name in FINGERS}
FULL_SCALE = 127.5e3  # Pa, 500 Pa a step of an 8-bit image
_BLOCK = 500  # rows
_FILE = "chunk-000/file-000.parquet"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_WHOLE = ("frame_index", "episode_index", "index", "task_index")
_LEVELS = np.arange(256) / 255.0

Sample = tuple[HandState, dict[str, TactileFrame]]


def observation(state: HandState, frames: Mapping[str, TactileFrame]) -> dict[str, float]:
    """Return the numbers of `STATE`, in SI units; ``frames`` are the newest by finger.

    ``touch_age`` [s] is how long before the state its finger's frame was sampled.
    """
    values: list[float] = []
    for name in FINGERS:
        finger = getattr(state, name)
        values += [getattr(finger, field) for field in _PLAIN.values()]
        values += [getattr(finger, field) if finger.contact else 0.0 for field in _FELT]
        values.append((state.mono_ns - frames[name].mono_ns) * 1e-9)
    values += [getattr(state.object, field) if state.object.valid else 0.0 for field in _OBJECT]
    finite = (float(value) if math.isfinite(value) else 0.0 for value in values)
    return dict(zip(STATE, finite, strict=True))


def image(frame: TactileFrame, full_scale: float = FULL_SCALE) -> NDArray[np.uint8]:
    """Return a frame's pressure as an image [rows, cols, 3], white from ``full_scale`` [Pa] on."""
    grey = np.clip(np.rint(frame.pressure() * (255.0 / full_scale)), 0.0, 255.0)
    return np.repeat(grey.astype(np.uint8)[:, :, np.newaxis], 3, axis=2)


def touch_rate(recording: Recording, start: float = -math.inf, end: float = math.inf) -> int:
    """Return one sensor's frames a second by its clock, from the first few hundred; at least 1."""
    some = itertools.islice(recording.messages([schema.TACTILE], start, end), 400)
    times = [message["mono_ns"] for _, message in some if message["finger"] == FINGERS[0]]
    between = np.median(np.diff(times)) if len(times) > 1 else 1e9
    return max(round(1e9 / max(between, 1e6)), 1)


def samples(
    recording: Recording,
    fps: int,
    start: float = -math.inf,
    end: float = math.inf,
    progress: Any = None,
) -> Iterator[Sample]:
    """Yield the newest state and frames at each 1/fps [s], from the first state with frames on.

    Raises RecordingError when the daemon was restarted on the way.
    """
    newest: dict[str, TactileFrame] = {}
    last: Sample | None = None
    begin = count = 0
    topics = [schema.STATE, schema.TACTILE]
    for topic, message in recording.messages(topics, start, end, progress):
        if topic == schema.TACTILE:
            frame = read(TactileFrame, message)
            newest = {**newest, frame.finger: frame}
        elif len(newest) == len(FINGERS):
            state = read(HandState, message)
            if last is not None and state.seq < last[0].seq:
                raise RecordingError(
                    f"{recording.path}: the daemon was started anew in it; give the part of one "
                    "start by --from and --to"
                )
            if last is None:
                begin = state.mono_ns
            while last is not None and begin + count * 1_000_000_000 // fps < state.mono_ns:
                yield last
                count += 1
            last = state, newest
    if last is not None:
        yield last


def write_dataset(rows: Iterator[Sample], folder: Path, fps: int, task: str) -> list[Path]:
    """Write the dataset's files into ``folder`` and return them; none without rows.

    Raises MissingExtra, OSError, and RecordingError when a grid changes its size.
    """
    require("parquet")
    import pyarrow as pa
    import pyarrow.parquet as parquet

    def vector(count: int) -> Any:
        return pa.list_(pa.float32(), count)

    picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    table = pa.schema(
        [("observation.state", vector(len(STATE))), ("action", vector(len(JOINTS)))]
        + [(f"observation.images.{name}", picture) for name in IMAGES.values()]
        + [("timestamp", pa.float32()), *((name, pa.int64()) for name in _WHOLE)]
    )
    first = next(rows, None)
    if first is None:
        return []
    shape = {name: (frame.rows, frame.cols, 3) for name, frame in first[1].items()}
    images = {name: _Images() for name in FINGERS}
    numbers: dict[str, list[Any]] = {name: [] for name in table.names if "images" not in name}
    block: list[dict[str, Any]] = []
    (folder / "meta/episodes/chunk-000").mkdir(parents=True, exist_ok=True)
    data = folder / "data" / _FILE
    data.parent.mkdir(parents=True, exist_ok=True)
    with write_bytes(data) as file, parquet.ParquetWriter(file, table) as writer:
        sample: Sample | None = first
        while sample is not None:
            state, frames = sample
            k = len(numbers["index"])
            row: dict[str, Any] = {
                "observation.state": list(observation(state, frames).values()),
                "action": np.nan_to_num([getattr(state, name).goal_q for name in FINGERS]).tolist(),
                "timestamp": k / fps,
                "frame_index": k,
                "episode_index": 0,
                "index": k,
                "task_index": 0,
            }
            for name, values in numbers.items():
                values.append(row[name])
            for name, frame in frames.items():
                if (frame.rows, frame.cols, 3) != shape[name]:
                    raise RecordingError(
                        f"{name}: found a frame of {frame.rows} × {frame.cols}, "
                        f"the first has {shape[name][0]} × {shape[name][1]}"
                    )
                row[f"observation.images.{IMAGES[name]}"] = images[name].png(frame)
            block.append(row)
            sample = next(rows, None)
            if len(block) == _BLOCK or sample is None:
                writer.write_table(pa.Table.from_pylist(block, table))
                block.clear()
    count = len(numbers["index"])
    stats = {name: _stats(np.array(values, float)) for name, values in numbers.items()}
    stats |= {f"observation.images.{IMAGES[name]}": images[name].stats(count) for name in FINGERS}
    return [data, *_write_meta(folder, _info(fps, count, shape), stats, task)]


def _info(fps: int, count: int, shape: dict[str, tuple[int, int, int]]) -> dict[str, Any]:
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [len(STATE)], "names": [*STATE]},
        "action": {"dtype": "float32", "shape": [len(JOINTS)], "names": [*JOINTS]},
    }
    for name in FINGERS:
        names = ["height", "width", "channels"]
        feature = {"dtype": "image", "shape": [*shape[name]], "names": names}
        features[f"observation.images.{IMAGES[name]}"] = feature
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in _WHOLE}
    return {
        "codebase_version": "v3.0",
        "robot_type": "softfinger",
        "total_episodes": 1,
        "total_frames": count,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }


def _write_meta(folder: Path, info: dict[str, Any], stats: Any, task: str) -> list[Path]:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    count = info["total_frames"]
    episode = {
        "episode_index": [0],
        "tasks": [[task]],
        "length": [count],
        "dataset_from_index": [0],
        "dataset_to_index": [count],
        "data/chunk_index": [0],
        "data/file_index": [0],
        "meta/episodes/chunk_index": [0],
        "meta/episodes/file_index": [0],
    }
    column: dict[str, Any] = {"name": "task", "field_name": "task", "pandas_type": "unicode"}
    column |= {"numpy_type": "object", "metadata": None}
    index = {"index_columns": ["task"], "columns": [column], "column_indexes": []}  # pandas' own
    tasks = pa.table({"task_index": [0], "task": [task]})
    meta = folder / "meta"
    tables = {
        meta / "episodes" / _FILE: pa.table(episode),
        meta / "tasks.parquet": tasks.replace_schema_metadata({"pandas": json.dumps(index)}),
    }
    for path, each in tables.items():
        with write_bytes(path) as file:
            parquet.write_table(each, file)
    texts = {meta / "info.json": info, meta / "stats.json": stats}
    for path, content in texts.items():
        with write_text(path) as text:
            json.dump(content, text, indent=4)
    return [*tables, *texts]


def _stats(values: NDArray[np.float64]) -> dict[str, list[Any]]:
    values = values.reshape(len(values), -1)
    found = {name: getattr(np, name)(values, axis=0) for name in ("min", "max", "mean", "std")}
    found |= {f"q{round(q * 100):02d}": np.quantile(values, q, axis=0) for q in _QUANTILES}
    return {name: each.tolist() for name, each in found.items()} | {"count": [len(values)]}


class _Images:
    """One sensor's frames as PNG, and how often each grey level is in them."""

    def __init__(self) -> None:
        self._counts = np.zeros(256, np.int64)
        self._last: tuple[TactileFrame, dict[str, Any], NDArray[np.int64]] | None = None

    def png(self, frame: TactileFrame) -> dict[str, Any]:
        if self._last is None or self._last[0] is not frame:  # the same one is packed once
            pixels = image(frame)
            levels = np.bincount(pixels[:, :, 0].ravel(), minlength=256)
            self._last = frame, {"bytes": _png(pixels), "path": None}, levels
        self._counts += self._last[2]
        return self._last[1]

    def stats(self, count: int) -> dict[str, Any]:
        """Return each channel's levels from 0 to 1; all three are the same."""
        n, seen = self._counts.sum(), np.flatnonzero(self._counts)
        mean = self._counts @ _LEVELS / n
        found = {"min": _LEVELS[seen[0]], "max": _LEVELS[seen[-1]], "mean": mean}
        found["std"] = math.sqrt(self._counts @ (_LEVELS - mean) ** 2 / n)
        below = np.cumsum(self._counts)
        found |= {
            f"q{round(q * 100):02d}": _LEVELS[np.searchsorted(below, q * n)] for q in _QUANTILES
        }
        return {name: [[[float(each)]]] * 3 for name, each in found.items()} | {"count": [count]}


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """An image [rows, cols, 3] as a PNG file."""
    rows, cols, _ = pixels.shape
    lines = np.hstack((np.zeros((rows, 1), np.uint8), pixels.reshape(rows, -1)))  # 0: no filter
    head = struct.pack(">IIBBBBB", cols, rows, 8, 2, 0, 0, 0)
    packed = zlib.compress(lines.tobytes(), 6)
    chunks = ((b"IHDR", head), (b"IDAT", packed), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
