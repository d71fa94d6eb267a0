"""``softfinger export FILE.mcap``: topics as CSV, frames as arrays."""

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
from softfinger.tools.arguments import add_range, to_stderr
from softfinger.tools.recordings.reader import Recording

_EPILOG = """\
Writes one table a topic, hand-state.csv and so on, with a column for each field (left.force). A
sensor's frames also go into tactile-left.npz or -right.npz: frames [n, rows, cols] and t [n],
which `softfinger analyse` and numpy.load read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: FILE.export)"
    )
    parser.add_argument(
        "--topics", nargs="+", metavar="TOPIC", help="as state or hand/state (default: all)"
    )
    add_range(parser)


def run(arguments: argparse.Namespace) -> int:
    """Export; 1 when there is nothing to export. Raises RecordingError or OSError."""
    from softfinger.tools.sweep import Progress

    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".export")
    recording = Recording(path, to_stderr("export"))
    topics = _topics(arguments.topics, recording.topics)
    folder.mkdir(parents=True, exist_ok=True)
    with Progress("export", recording.size) as progress:
        files = export(recording, folder, topics, arguments.start, arguments.end, progress)
    for each in files:
        print(each)
    if not files:
        print(f"export: {path}: no messages in it", file=sys.stderr)
    return 0 if files else 1


def _topics(words: list[str] | None, recorded: list[bytes]) -> list[bytes]:
    if words is None:
        return recorded
    selected = [(word if word.startswith("hand/") else f"hand/{word}").encode() for word in words]
    for topic, word in zip(selected, words, strict=True):
        if topic not in recorded:
            known = ", ".join(each.decode() for each in recorded) or "none"
            raise RecordingError(f"found topic {word!r}, the recording has {known}")
    return selected


Row = dict[str, Any]


def export(
    recording: Recording,
    folder: Path,
    topics: list[bytes],
    start: float = -math.inf,
    end: float = math.inf,
    progress: Any = None,
) -> list[Path]:
    """Write each topic's table into ``folder``, and frames into one ``.npz`` file a sensor.

    Floats have all their digits, NaN is an empty cell; columns are the schema's and what the first
    message has besides, without bytes. The column ``t`` counts in s from the recording's first
    message. Returns the files. Raises OSError.
    """
    tables: dict[bytes, csv.DictWriter[str]] = {}
    grids: dict[str, tuple[list[float], list[Any]]] = {}  # times and counts by finger
    files: list[Path] = []
    with contextlib.ExitStack() as opened:
        for topic, message in recording.messages(topics, start, end, progress):
            stamp = message.get("timestamp")
            since = stamp - recording.start if isinstance(stamp, int | float) else math.nan
            row = _flat(message) | {"t": since}
            if topic not in tables:
                name = _file_name(topic)
                if any(each.stem == name for each in files):
                    raise RecordingError(f"{recording.path}: two topics would be {name}")
                files.append(folder / f"{name}.csv")
                file = opened.enter_context(write_text(files[-1], newline=""))
                tables[topic] = csv.DictWriter(
                    file, _columns(topic, row), extrasaction="ignore", lineterminator="\n"
                )
                tables[topic].writeheader()
            if topic == schema.TACTILE:
                times, frames = grids.setdefault(message["finger"], ([], []))
                shape = message["rows"], message["cols"]
                times.append(message["timestamp"])
                frames.append(np.frombuffer(message["data"], "<u2").reshape(shape))
            tables[topic].writerow({name: _cell(value) for name, value in row.items()})
    for finger, (times, frames) in sorted(grids.items()):
        files.append(folder / f"tactile-{finger}.npz")
        with write_bytes(files[-1]) as packed:
            t = np.array(times)
            np.savez_compressed(packed, frames=np.stack(frames), t=t - t[0])
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


def _columns(topic: bytes, first: Row) -> list[str]:
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    known = [field.name for field in fields if field.kind != "bin"]
    return [*dict.fromkeys(known + [k for k, v in first.items() if not isinstance(v, bytes)])]


def _cell(value: Any) -> Any:
    return "" if value != value else int(value) if isinstance(value, bool) else value
