"""``softfinger export FILE.mcap``: a recording's topics as CSV or Parquet, frames as arrays."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from softfinger.daemon.errors import RecordingError
from softfinger.tools.arguments import moment, seconds, teller

_EPILOG = """\
Writes one table a topic, hand-state.csv and so on, with a column for each field (left.force). A
sensor's frames also go into tactile-left.npz or -right.npz: frames [n, rows, cols] and t [n],
which `softfinger analyse` and numpy.load read. Parquet keeps the frames' bytes in the table too."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``export``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where to, made if missing (default: FILE.export)"
    )
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    parser.add_argument(
        "--topics",
        nargs="+",
        metavar="TOPIC",
        help="as state or hand/state; all if none is named",
    )
    parser.add_argument("--from", type=moment, metavar="S", dest="start", help="from S seconds on")
    parser.add_argument("--to", type=seconds, metavar="S", dest="end", help="up to S seconds")


def run(arguments: argparse.Namespace) -> int:
    """Export; 1 with one line when the recording, the folder or an extra is no good."""
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.recordings.tables import CsvTable, ParquetTable, export
    from softfinger.tools.terminal.progress import Progress

    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".export")
    kind = CsvTable if arguments.format == "csv" else ParquetTable
    start = -math.inf if arguments.start is None else arguments.start
    end = math.inf if arguments.end is None else arguments.end
    try:
        recording = Recording(path, teller("export"))
        topics = _topics(arguments.topics, recording.topics)
        folder.mkdir(parents=True, exist_ok=True)
        with Progress("export", recording.size) as progress:
            files = export(recording, folder, kind, topics, start, end, progress)
    except (RecordingError, ValueError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"export: {error.filename or folder}: {error.strerror}", file=sys.stderr)
        return 1
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
            raise ValueError(f"found topic {word!r}, the recording has {known}")
    return wanted
