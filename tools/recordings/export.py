"""``softfinger export FILE.mcap``: a recording's topics as CSV or Parquet, frames as arrays."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from softfinger.daemon.errors import RecordingError
from softfinger.tools.arguments import add_range, to_stderr

_EPILOG = """\
Writes one table a topic, hand-state.csv and so on, with a column for each field (left.force). A
sensor's frames also go into tactile-left.npz or -right.npz: frames [n, rows, cols] and t [n],
which `softfinger analyse` and numpy.load read. Parquet keeps the frames' bytes in the table too."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``export``."""
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: FILE.export)"
    )
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    parser.add_argument(
        "--topics", nargs="+", metavar="TOPIC", help="as state or hand/state (default: all)"
    )
    add_range(parser)


def run(arguments: argparse.Namespace) -> int:
    """Export; 1 when there is nothing to export. Raises RecordingError, MissingExtra, OSError."""
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.recordings.tables import CsvTable, ParquetTable, export
    from softfinger.tools.terminal.progress import Progress

    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".export")
    kind = CsvTable if arguments.format == "csv" else ParquetTable
    recording = Recording(path, to_stderr("export"))
    topics = _topics(arguments.topics, recording.topics)
    folder.mkdir(parents=True, exist_ok=True)
    with Progress("export", recording.size) as progress:
        files = export(recording, folder, kind, topics, arguments.start, arguments.end, progress)
    for each in files:
        print(each)
    if not files:
        print(f"export: {path}: no messages in it", file=sys.stderr)
    return 0 if files else 1


def _topics(words: list[str] | None, recorded: list[bytes]) -> list[bytes]:
    if words is None:
        return recorded
    wanted = [(word if word.startswith("hand/") else f"hand/{word}").encode() for word in words]
    for topic, word in zip(wanted, words, strict=True):
        if topic not in recorded:
            known = ", ".join(each.decode() for each in recorded) or "none"
            raise RecordingError(f"found topic {word!r}, the recording has {known}")
    return wanted
