"""``softfinger replay FILE.mcap``: a recording on the wire again, or through today's code."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Any

from softfinger.daemon.errors import RecordingError, SettingsError
from softfinger.daemon.own_files import write_text
from softfinger.daemon.profile.settings import Stream
from softfinger.tools.arguments import moment, seconds, teller

_EPILOG = """\
Without --recompute the messages go out on the stream's socket as they were, at their own pace or
--speed times that; the monitor, a recorder or a program of your own can't tell it from a daemon.

--recompute runs readings, frames and commands through today's estimator, tables, control and
limits, and compares every state with the recorded one. It needs `record --topics all`. Recorded
from the first tick on, with `run --record`, the same code and settings give the same bits.
Exit status: 0 the same, 1 can't be read, 3 states differ."""

_READERS = 10.0  # s that subscribers are waited for
_DIFFERENT = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``replay``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument("--address", default=Stream().address, help="where to publish")
    parser.add_argument(
        "--keys",
        type=Path,
        metavar="FOLDER",
        help="publish to its clients alone, as a daemon with access.keys does; made by "
        "`softfinger keys`",
    )
    parser.add_argument(
        "--speed", type=seconds, default=1.0, metavar="X", help="times as fast (default 1)"
    )
    parser.add_argument("--from", type=moment, default=0.0, metavar="S", dest="start")
    parser.add_argument("--to", type=seconds, metavar="S", dest="end")
    parser.add_argument(
        "--no-wait", action="store_true", help="begin at once, and not with the first subscriber"
    )
    parser.add_argument("--recompute", action="store_true", help="compare instead of publishing")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="with --recompute: these settings instead"
    )
    parser.add_argument(
        "--json", type=Path, metavar="OUT", help="with --recompute: write the comparison, too"
    )


def run(arguments: argparse.Namespace) -> int:
    """Publish, or recompute; 1 with one line when the recording is no good."""
    from softfinger.daemon.errors import TactileError
    from softfinger.tools.recordings.reader import Recording

    try:
        recording = Recording(arguments.file, teller("replay"))
        return (
            _recompute(arguments, recording)
            if arguments.recompute
            else _publish(arguments, recording)
        )
    except (RecordingError, SettingsError, TactileError) as error:
        print(f"replay: {error}", file=sys.stderr)
        return 1


def _publish(arguments: argparse.Namespace, recording: Any) -> int:
    from softfinger.tools.recordings.republish import Wire

    ended = False

    def end(*_: object) -> None:
        nonlocal ended
        ended = True

    old = {each: signal.signal(each, end) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        with Wire(arguments.address, arguments.keys) as wire:
            waited = time.monotonic() + (0.0 if arguments.no_wait else _READERS)
            if not arguments.no_wait:
                told = f"replay: waiting up to {_READERS:g} s for a subscriber at"
                print(f"{told} {arguments.address}", file=sys.stderr)
            while not ended and time.monotonic() < waited and not wire.subscribed(0.1):
                pass
            sent = 0
            began, first = time.monotonic(), None
            end_at = float("inf") if arguments.end is None else arguments.end
            for topic, message in recording.messages(start=arguments.start, end=end_at):
                stamp = message.get("timestamp", 0.0)
                again = message.get("again") is True  # its time is from before the recording
                if first is None and not again:
                    began, first = time.monotonic(), stamp
                due = began if again or first is None else began + (stamp - first) / arguments.speed
                while not ended and (left := due - time.monotonic()) > 0.0:
                    wire.subscribed(min(left, 0.1))
                if ended:
                    break
                wire.send(topic, message)
                sent += 1
        print(f"{sent} of {recording.total} messages published")
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
    return 0


def _recompute(arguments: argparse.Namespace, recording: Any) -> int:
    from softfinger.daemon.profile.load import load
    from softfinger.daemon.profile.settings import Settings
    from softfinger.tools.processes.kernel_build import build_kernels, print_event, table_cache
    from softfinger.tools.recordings.recomputed import recompute
    from softfinger.tools.terminal.progress import Progress

    settings = None if arguments.config is None else load(arguments.config)
    build_kernels(settings or Settings(), print_event)
    with Progress("recompute", recording.size) as progress:
        result = recompute(recording, settings, table_cache(), progress)
    print(
        f"{arguments.file}: {result.ticks} ticks, {result.states} states of {result.fields} fields "
        "compared"
    )
    if not result.from_start:
        print(
            "the recording begins after the first tick: what was remembered from before it is not "
            "there, so that the first states may differ"
        )
    for count, what in ((result.missing_ticks, "ticks"), (result.missing_frames, "frames")):
        if count:
            print(f"{count} {what} are missing in the recording")
    if arguments.json is not None:
        _write(arguments.json, result)
    if not result.differences:
        print("identical to the last bit")
        return 0
    print(f"{'field':24} {'differ':>8} {'first tick':>10}  recorded → recomputed; worst")
    for name, each in result.differences.items():
        line = f"{name:24} {each.count:8} {each.first_tick:10}  {each.recorded} → {each.recomputed}"
        print(line + (f"; {each.worst:.3g} at tick {each.worst_tick}" if each.worst else ""))
    return _DIFFERENT


def _write(path: Path, result: Any) -> None:
    import json
    from dataclasses import asdict

    try:
        with write_text(path) as file:
            file.write(json.dumps(asdict(result), indent=1) + "\n")
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
