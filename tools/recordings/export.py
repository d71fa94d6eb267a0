"""``softfinger export FILE.mcap``: topics as CSV or Parquet, frames as arrays, or for LeRobot."""

from __future__ import annotations

import argparse
import csv
import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import write_bytes, write_text
from softfinger.daemon.wire import schema
from softfinger.tools.arguments import add_range, number, to_stderr
from softfinger.tools.extras import require
from softfinger.tools.recordings.lerobot_dataset import samples, touch_rate, write_dataset
from softfinger.tools.recordings.reader import Recording

_EPILOG = """\
Writes one table a topic, hand-state.csv and so on, with a column for each field (left.force). A
sensor's frames also go into tactile-left.npz or -right.npz: frames [n, rows, cols] and t [n],
which `softfinger analyse` and numpy.load read. Parquet keeps the frames' bytes in the table too.
--lerobot writes a LeRobot dataset (v3.0) instead, into FILE.lerobot: one episode, the joints' goals
as actions, the grids as images. Its rows come at the sensors' own rate, or at that of --fps."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="output folder (default: FILE.export, FILE.lerobot)",
    )
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--format", choices=("csv", "parquet"), default="csv")
    kind.add_argument("--lerobot", action="store_true", help="a LeRobot dataset")
    parser.add_argument("--fps", type=_rate, metavar="N", help="rows a second of --lerobot")
    parser.add_argument("--task", default="", help="what was done, in words, for --lerobot")
    parser.add_argument(
        "--topics", nargs="+", metavar="TOPIC", help="as state or hand/state (default: all)"
    )
    add_range(parser)


def run(arguments: argparse.Namespace) -> int:
    """Export; 1 when there is nothing to export. Raises RecordingError, MissingExtra, OSError."""
    from softfinger.tools.sweep import Progress

    path: Path = arguments.file
    lerobot: bool = arguments.lerobot
    suffix = ".lerobot" if lerobot else ".export"
    folder = arguments.out or path.with_name(path.name + suffix)
    kind = CsvTable if arguments.format == "csv" else ParquetTable
    recording = Recording(path, to_stderr("export"))
    topics = _topics(arguments.topics, recording.topics)
    if lerobot and arguments.topics:
        raise RecordingError("--lerobot takes states and frames: leave out --topics")
    if not lerobot and (arguments.fps or arguments.task):
        raise RecordingError("--fps and --task are of --lerobot")
    span = arguments.start, arguments.end
    folder.mkdir(parents=True, exist_ok=True)
    with Progress("export", recording.size) as progress:
        if lerobot:
            fps = arguments.fps or touch_rate(recording, *span)
            rows = samples(recording, fps, *span, progress)
            files = write_dataset(rows, folder, fps, arguments.task)
        else:
            files = export(recording, folder, kind, topics, *span, progress)
    for each in files:
        print(each)
    if not files:
        what = "no states with frames of both sensors" if lerobot else "no messages"
        print(f"export: {path}: {what} in it", file=sys.stderr)
    return 0 if files else 1


def _rate(text: str) -> int:
    value = number(text, "a whole number of rows a second", 0.0, 1000.0)
    if value != round(value):
        raise argparse.ArgumentTypeError(f"expected a whole number, found {text!r}")
    return round(value)


def _topics(words: list[str] | None, recorded: list[bytes]) -> list[bytes]:
    if words is None:
        return recorded
    selected = [(word if word.startswith("hand/") else f"hand/{word}").encode() for word in words]
    for topic, word in zip(selected, words, strict=True):
        if topic not in recorded:
            known = ", ".join(each.decode() for each in recorded) or "none"
            raise RecordingError(f"found topic {word!r}, the recording has {known}")
    return selected


BLOCK = 2000  # rows
Row = dict[str, Any]


class CsvTable:
    """A CSV file; floats with all their digits, NaN as an empty cell.

    Columns are the schema's and what the first message has besides; bytes are left out.
    """

    suffix = ".csv"

    def __init__(self, path: Path, topic: bytes, first: Row) -> None:
        self._names = [name for name, kind in _columns(topic, first) if kind != "bin"]
        self._file = write_text(path, newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self._names)

    def write(self, rows: list[Row]) -> None:
        for row in rows:
            self._writer.writerow([_cell(row.get(name)) for name in self._names])

    def close(self) -> None:
        self._file.close()


class ParquetTable:
    """A Parquet file with the schema's types; a grid's data is binary."""

    suffix = ".parquet"

    def __init__(self, path: Path, topic: bytes, first: Row) -> None:
        """Raises MissingExtra."""
        require("parquet")
        import pyarrow
        import pyarrow.parquet

        kinds = {
            "int": pyarrow.int64(),
            "float": pyarrow.float64(),
            "bool": pyarrow.bool_(),
            "str": pyarrow.string(),
            "bin": pyarrow.binary(),
        }
        fields = [(name, kinds[kind]) for name, kind in _columns(topic, first) if kind in kinds]
        self._arrow = pyarrow
        self._schema = pyarrow.schema(fields)
        self._file = write_bytes(path)
        self._writer = pyarrow.parquet.ParquetWriter(self._file, self._schema)

    def write(self, rows: list[Row]) -> None:
        self._writer.write_table(self._arrow.Table.from_pylist(rows, self._schema))

    def close(self) -> None:
        self._writer.close()
        self._file.close()


Table = CsvTable | ParquetTable


def export(
    recording: Recording,
    folder: Path,
    kind: type[Table],
    topics: list[bytes],
    start: float = -math.inf,
    end: float = math.inf,
    progress: Any = None,
) -> list[Path]:
    """Write each topic's table into ``folder``, and frames into one ``.npz`` file a sensor.

    The column ``t`` counts in s from the recording's first message. Returns the files. Raises
    OSError, and MissingExtra.
    """
    tables: dict[bytes, tuple[Table, list[Row]]] = {}  # with the rows that aren't written yet
    grids: dict[str, tuple[list[float], list[Any]]] = {}  # times and counts by finger
    files: list[Path] = []
    try:
        for topic, message in recording.messages(topics, start, end, progress):
            stamp = message.get("timestamp")
            since = stamp - recording.start if isinstance(stamp, int | float) else math.nan
            row = _flat(message) | {"t": since}
            if topic not in tables:
                name = _file_name(topic)
                if any(each.stem == name for each in files):
                    raise RecordingError(f"{recording.path}: two topics would be {name}")
                files.append(folder / f"{name}{kind.suffix}")
                tables[topic] = kind(files[-1], topic, row), []
            if topic == schema.TACTILE:
                times, frames = grids.setdefault(message["finger"], ([], []))
                shape = message["rows"], message["cols"]
                times.append(message["timestamp"])
                frames.append(np.frombuffer(message["data"], "<u2").reshape(shape))
            table, rows = tables[topic]
            rows.append(row)
            if len(rows) >= BLOCK:
                table.write(rows)
                rows.clear()
        for table, rows in tables.values():
            table.write(rows)
    finally:
        for table, _ in tables.values():
            table.close()
    for finger, (times, frames) in sorted(grids.items()):
        files.append(folder / f"tactile-{finger}.npz")
        with write_bytes(files[-1]) as file:
            t = np.array(times)
            np.savez_compressed(file, frames=np.stack(frames), t=t - t[0])
    return files


def _file_name(topic: bytes) -> str:
    """A topic's name as a file's, from any recording: neither hidden nor in another folder."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", topic.decode()).lstrip(".")[:100] or "topic"


def _flat(message: Row, outer: str = "") -> Row:
    """A map without maps in it: ``left.force`` for the force in ``left``."""
    row: Row = {}
    for key, value in message.items():
        if isinstance(value, dict):
            row |= _flat(value, f"{outer}{key}.")
        else:
            row[f"{outer}{key}"] = value
    return row


def _columns(topic: bytes, first: Row) -> list[tuple[str, str]]:
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    known = {field.name: field.kind for field in fields}
    kinds = {bool: "bool", int: "int", float: "float", str: "str", bytes: "bin"}
    more = {name: kinds.get(type(value), "") for name, value in first.items() if name not in known}
    return [*known.items(), *more.items()]


def _cell(value: Any) -> Any:
    return "" if value != value else int(value) if isinstance(value, bool) else value
