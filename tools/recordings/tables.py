"""A recording's topics as tables: one row a message, one column a field, dots for nested maps.

Rows are gathered in blocks, so that an hour's recording needs no more memory than a minute's.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import write_bytes, write_text
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.reader import Recording

BLOCK = 2000  # rows
Row = dict[str, Any]


class NoArrow(RecordingError):
    """pyarrow is not installed. The message says what to install."""

    def __init__(self) -> None:
        super().__init__(
            "Parquet needs pyarrow, the extra 'parquet'; from the project's folder: "
            "pip install '.[parquet]'"
        )


def flat(message: Row, outer: str = "") -> Row:
    """A map without maps in it: ``left.force`` for the force in ``left``."""
    row: Row = {}
    for key, value in message.items():
        if isinstance(value, dict):
            row |= flat(value, f"{outer}{key}.")
        else:
            row[f"{outer}{key}"] = value
    return row


class CsvTable:
    """A CSV file; floats with all their digits, numbers that are none as empty cells.

    Columns are the contract's and what the first message has besides; bytes are left out.
    """

    suffix = ".csv"

    def __init__(self, path: Path, topic: bytes, first: Row) -> None:
        self._names = [name for name, value in _columns(topic, first) if value != "bin"]
        self._file = write_text(path, newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self._names)

    def write(self, rows: list[Row]) -> None:
        """Append rows."""
        for row in rows:
            self._writer.writerow([_cell(row.get(name)) for name in self._names])

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


class ParquetTable:
    """A Parquet file with the contract's types; a grid's data is binary."""

    suffix = ".parquet"

    def __init__(self, path: Path, topic: bytes, first: Row) -> None:
        """Raises NoArrow."""
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError:
            raise NoArrow from None
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
        """Append rows."""
        self._writer.write_table(self._arrow.Table.from_pylist(rows, self._schema))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
        self._file.close()


def _columns(topic: bytes, first: Row) -> list[tuple[str, str]]:
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    known = [(field.name, field.kind) for field in fields]
    names = {name for name, _ in known}
    kinds = {bool: "bool", int: "int", float: "float", str: "str", bytes: "bin"}
    return known + [
        (name, kinds.get(type(value), "")) for name, value in first.items() if name not in names
    ]


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return int(value) if isinstance(value, bool) else value


def export(
    recording: Recording,
    folder: Path,
    kind: type[CsvTable] | type[ParquetTable],
    topics: list[bytes],
    start: float = -math.inf,
    end: float = math.inf,
    progress: Any = None,
) -> list[Path]:
    """Write each topic's table into ``folder``, for frames also ``.npz`` files of the sensors.

    Returns the files. Raises OSError, and RecordingError for a missing extra.
    """
    tables: dict[bytes, CsvTable | ParquetTable] = {}
    blocks: dict[bytes, list[Row]] = {}
    grids: dict[str, tuple[list[float], list[Any]]] = {}
    files: list[Path] = []
    try:
        for topic, message in recording.messages(topics, start, end, progress):
            row = flat(message)
            if topic not in tables:
                path = folder / f"{topic.decode().replace('/', '-')}{kind.suffix}"
                tables[topic] = kind(path, topic, row)
                blocks[topic] = []
                files.append(path)
            if topic == schema.TACTILE:
                times, frames = grids.setdefault(message["finger"], ([], []))
                shape = message["rows"], message["cols"]
                times.append(message["timestamp"])
                frames.append(np.frombuffer(message["data"], "<u2").reshape(shape))
            block = blocks[topic]
            block.append(row)
            if len(block) >= BLOCK:
                tables[topic].write(block)
                block.clear()
        for topic, block in blocks.items():
            tables[topic].write(block)
    finally:
        for table in tables.values():
            table.close()
    return files + [_grids(folder, finger, *held) for finger, held in _sorted(grids)]


def _sorted(grids: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    return iter(sorted(grids.items()))


def _grids(folder: Path, finger: str, times: list[float], frames: list[Any]) -> Path:
    path = folder / f"tactile-{finger}.npz"
    t = np.array(times)
    with write_bytes(path) as file:
        np.savez_compressed(file, frames=np.stack(frames), t=t - t[0])
    return path
