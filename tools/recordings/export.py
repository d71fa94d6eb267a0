"""Run ``softfinger export FILE.mcap``: export topics to CSV or Parquet, and frames to arrays."""

from __future__ import annotations

import argparse
import contextlib
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
from softfinger.daemon.wire.fields import KINDS
from softfinger.tools.arguments import add_range, range_text, to_stderr
from softfinger.tools.extras import require
from softfinger.tools.recordings.channels import flat
from softfinger.tools.recordings.reader import Recording

_EPILOG = """\
Writes one table for each topic, e.g. hand-state.csv, with the time t and a column for each field
(left.force). The frames of a sensor are also written to tactile-left.npz or tactile-right.npz, as
t [n] and frames [n, rows, cols], for `softfinger analyse` and numpy.load. Parquet tables also
contain the bytes of the frames. In all files, t is the time in s since the recording's first
message, on the daemon's clock; for a frame, t is the time of its scan."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: FILE.export)"
    )
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    parser.add_argument(
        "--topics", nargs="+", metavar="TOPIC", help="e.g. state or hand/state (default: all)"
    )
    add_range(parser)


def run(arguments: argparse.Namespace) -> int:
    """Export the topics; return 1 if there is nothing to export.

    Raises RecordingError, MissingExtra or OSError.
    """
    from softfinger.tools.sweep import Progress

    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".export")
    recording = Recording(path, to_stderr("export"))
    topics = _topics(arguments.topics, recording.topics)
    folder.mkdir(parents=True, exist_ok=True)
    with Progress("export", recording.size) as progress:
        span = arguments.start, arguments.end
        files = export(recording, folder, TABLES[arguments.format], topics, *span, progress)
    for each in files:
        print(each)
    if not files:
        where = range_text(arguments)
        print(f"export: {path}: the recording does not contain messages{where}", file=sys.stderr)
    return 0 if files else 1


def _topics(words: list[str] | None, recorded: list[bytes]) -> list[bytes]:
    if words is None:
        return recorded
    selected = [(word if word.startswith("hand/") else f"hand/{word}").encode() for word in words]
    for topic, word in zip(selected, words, strict=True):
        if topic not in recorded:
            known = ", ".join(each.decode() for each in recorded) or "none"
            raise RecordingError(
                f"found topic {word!r}, expected one of the recorded topics: {known}"
            )
    return selected


Row = dict[str, Any]
_BLOCK = 2000  # number of rows written at once


class CsvTable:
    """CSV file with full float precision and empty cells for NaN; byte fields are omitted."""

    suffix = ".csv"

    def __init__(self, path: Path, columns: dict[str, str]) -> None:
        names = [name for name, kind in columns.items() if kind != "bin"]
        self._file = write_text(path, newline="")
        self._writer = csv.DictWriter(self._file, names, extrasaction="ignore", lineterminator="\n")
        self._writer.writeheader()

    def add(self, row: Row) -> None:
        self._writer.writerow({name: _cell(value) for name, value in row.items()})

    def close(self) -> None:
        self._file.close()


class ParquetTable:
    """Parquet file whose columns have the schema's types.

    Raises RecordingError if a value has another type.
    """

    suffix = ".parquet"

    def __init__(self, path: Path, columns: dict[str, str]) -> None:
        """Open the file. Raises MissingExtra if pyarrow is not installed."""
        require("parquet")
        import pyarrow
        import pyarrow.parquet

        types = {
            "int": pyarrow.int64(),
            "float": pyarrow.float64(),
            "bool": pyarrow.bool_(),
            "str": pyarrow.string(),
            "bin": pyarrow.binary(),
        }
        known = [(name, types[kind]) for name, kind in columns.items() if kind]
        self._schema = pyarrow.schema(known)
        self._arrow, self._rows = pyarrow, list[Row]()
        self._file = write_bytes(path)
        self._writer = pyarrow.parquet.ParquetWriter(self._file, self._schema)

    def add(self, row: Row) -> None:
        self._rows.append(row)
        if len(self._rows) == _BLOCK:
            self._flush()

    def _flush(self) -> None:
        rows, self._rows = self._rows, []
        try:
            table = self._arrow.Table.from_pylist(rows, self._schema)
        except (ValueError, TypeError, OverflowError) as error:
            raise RecordingError(
                f"{self._file.name}: found a value of another type than the column's "
                f"({str(error)[:200]}); use --format csv, which accepts all types"
            ) from None
        self._writer.write_table(table)

    def close(self) -> None:
        try:
            self._flush()
        finally:
            self._writer.close()
            self._file.close()


Table = CsvTable | ParquetTable
TABLES: dict[str, type[Table]] = {"csv": CsvTable, "parquet": ParquetTable}


def export(
    recording: Recording,
    folder: Path,
    kind: type[Table],
    topics: list[bytes],
    start: float = -math.inf,
    end: float = math.inf,
    progress: Any = None,
) -> list[Path]:
    """Write one table per topic, and one ``.npz`` file of frames per sensor, into ``folder``.

    In all files, the first column ``t`` is the time [s] on the daemon's clock since the recording's
    first message. The other columns are the fields of the schema and any additional fields of the
    topic's first message. Returns the paths of the written files.

    Raises OSError and MissingExtra. Raises RecordingError if the sizes of a sensor's frames differ,
    or if a value does not have the type of its Parquet column.
    """
    tables: dict[str, Table] = {}
    grids: dict[str, tuple[list[float], list[Any]]] = {}  # scan times and frames of each finger
    files: list[Path] = []
    with contextlib.ExitStack() as opened:
        for topic, message in recording.messages(topics, start, end, progress):
            t = recording.time(message)
            row = {"t": t} | flat(message)
            name = _file_name(topic)
            if name not in tables:
                files.append(folder / f"{name}{kind.suffix}")
                tables[name] = kind(files[-1], _columns(topic, row))
                opened.callback(tables[name].close)
            if topic == schema.TACTILE:
                times, frames = grids.setdefault(message["finger"], ([], []))
                shape = message["rows"], message["cols"]
                if frames and shape != frames[0].shape:
                    raise RecordingError(
                        f"{recording.path}: found frames of {shape[0]} × {shape[1]} cells after "
                        f"frames of {frames[0].shape[0]} × {frames[0].shape[1]} cells, expected "
                        f"frames of equal size: export the data before and after t = {t:.3f} s "
                        "separately with --to and --from"
                    )
                times.append(t)
                frames.append(np.frombuffer(message["data"], "<u2").reshape(shape))
            tables[name].add(row)
    for finger, (times, frames) in sorted(grids.items()):
        files.append(folder / f"tactile-{finger}.npz")
        with write_bytes(files[-1]) as packed:
            np.savez_compressed(packed, t=np.array(times), frames=np.stack(frames))
    return files


def _file_name(topic: bytes) -> str:
    """Convert a topic to a file name that is neither hidden nor in another folder."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", topic.decode()).lstrip(".")[:100] or "topic"


def _columns(topic: bytes, first: Row) -> dict[str, str]:
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    known = {"t": "float"} | {field.name: field.kind for field in fields}
    more = {name: KINDS.get(type(value), "") for name, value in first.items() if name not in known}
    return known | more


def _cell(value: Any) -> Any:
    return "" if value != value else int(value) if isinstance(value, bool) else value
