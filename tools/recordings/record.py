"""Run ``softfinger record FILE.mcap``: record the running daemon's stream to an MCAP file."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.tools.arguments import (
    ALL,
    WAIT_MAX,
    add_split,
    add_stream,
    client_keys,
    no_stream,
    to_stderr,
    topic,
    waiting,
)
from softfinger.tools.extras import require
from softfinger.tools.recordings.channels import (
    ENCODING,
    PROFILE,
    SCHEMA_ENCODING,
    channel_name,
    schema_of,
    to_json,
)
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.stop_condition import StopCondition

_EPILOG = """\
Recording ends on Ctrl-C or after --duration; the numbers of written and lost messages are then
printed.
With --split-size or --split-time, recording continues in FILE-2.mcap, FILE-3.mcap and so on. Each
file contains the settings.
`replay --recompute` requires --topics all; `run --record` records all topics from the first tick.
Exit status: 0 all messages were written; 1 messages were not written (the reason is printed)."""

_SILENCE_TIME = 2.0  # time without messages after which a notice is printed [s]
# Time between socket reads [s]. Waking up for each message would take longer than processing the
# message.
_POLL_INTERVAL = 0.1
_BACKLOG_TIMEOUT = 10.0  # time limit for processing the messages still queued at the end [s]
_TRANSIT_TIME = 0.5  # time allowed at the end for messages that are still in transit [s]
_PROGRESS_INTERVAL = 0.5  # time between two progress lines, and between two flushes [s]
_BATCH_SIZE = 1000  # maximum number of messages read before the time is checked


# If the recorder is killed, only the incomplete chunk is lost. The incomplete chunk contains the
# messages since the last flush.
CHUNK_SIZE = 256 * 1024  # chunk size before compression [bytes], enough for about 0.2 s at 1 kHz


class RecordingWriter:
    """Writer for one file; ``messages`` and ``size`` [bytes] count complete chunks only.

    Raises RecordingError if the file cannot be opened or already exists. If a write fails, the file
    is closed, and the data that were written earlier remain readable.
    """

    def __init__(self, path: Path) -> None:
        require("record")
        import orjson
        from mcap.writer import Writer

        self.path = path
        self.messages = 0
        self.size = 0
        self._dumps = orjson.dumps
        self._added = 0  # number of messages, including those in the incomplete chunk
        self._filled = 0  # number of bytes in the incomplete chunk
        self._channels: dict[str, int] = {}  # maps channel names to channel numbers
        self._ended = False
        self._newest = math.nan  # time of the newest message [s]
        # Repeated messages that arrived before the first new message.
        self._early: list[tuple[bytes, dict[str, Any]]] = []
        try:
            # The buffer holds a whole chunk, so that one call writes the chunk.
            self._file = path.open("xb", buffering=4 * CHUNK_SIZE)
        except FileExistsError:
            raise RecordingError(f"{path}: already exists; choose another file") from None
        except FileNotFoundError:
            raise RecordingError(
                f"{path}: the folder does not exist; create the folder first"
            ) from None
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        try:
            # The MCAP writer's own limit is twice the size at which `_write` ends a chunk.
            self._mcap = Writer(self._file, 2 * CHUNK_SIZE)
            self._mcap.start(PROFILE, PROFILE)
            self._wrote()
        except OSError as error:
            raise self._failed(error) from None

    def add(self, topic: bytes, message: dict[str, Any]) -> None:
        """Write one message; this method may modify ``message``. Raises RecordingError.

        A repeated message (``again``) contains its original time, which precedes the recording. To
        keep all log times within the recording, the repeated message gets the previous message's
        log time.
        """
        assert not self._ended
        stamp = message.get("timestamp")
        when = stamp if isinstance(stamp, float) and 0.0 <= stamp < 1e10 else time.time()
        if message.get("again") is not True:
            self._newest = when
            if self._early:
                self._write_early(when)
        elif math.isnan(self._newest):
            self._early.append((topic, message))
            return
        else:
            when = self._newest
        self._write(topic, message, when)

    def flush(self) -> None:
        """End the chunk and write it, so that the data survive if this process is killed."""
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._wrote()
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Write the last chunk and the summary. Raises RecordingError."""
        if self._ended:
            return
        if self._early:
            self._write_early(time.time())
        self._ended = True
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._wrote()
            self._file.close()
            del self._mcap  # The chunk index occupies most of the writer's memory.
        except OSError as error:
            raise self._failed(error) from None

    def _write_early(self, when: float) -> None:
        early, self._early = self._early, []
        for each, message in early:
            self._write(each, message, when)

    def _write(self, topic: bytes, message: dict[str, Any], when: float) -> None:
        name = channel_name(topic, message)
        sequence = message.get("seq")
        sequence = sequence & 0xFFFFFFFF if isinstance(sequence, int) else 0
        try:
            if name not in self._channels:
                title, fields = schema_of(topic)
                text = json.dumps(fields, ensure_ascii=False).encode()
                number = self._mcap.register_schema(title, SCHEMA_ENCODING, text)
                self._channels[name] = self._mcap.register_channel(name, ENCODING, number)
            try:
                data = self._dumps(to_json(topic, message))
            except TypeError:  # orjson raises TypeError for values that JSON cannot represent.
                return
            stamp = int(when * 1e9)
            self._mcap.add_message(self._channels[name], stamp, data, stamp, sequence)
        except OSError as error:
            raise self._failed(error) from None
        self._added += 1
        self._filled += len(data)
        if self._filled > CHUNK_SIZE:
            self.flush()

    def _wrote(self) -> None:
        self._file.flush()
        self.size, self.messages, self._filled = self._file.tell(), self._added, 0

    def _failed(self, error: OSError) -> RecordingError:
        self._ended = True
        # The rest of the buffer cannot be written either, so discard it.
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            os.truncate(self.path, self.size)  # Only complete records remain.
        return RecordingError(
            f"{self.path}: {error.strerror}; the messages written so far can be read; run "
            f"`softfinger record --recover {self.path}` to repair the file"
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument(
        "file", type=Path, metavar="FILE.mcap", help="output file, which must not exist yet"
    )
    add_stream(parser)
    parser.add_argument(
        "--topics",
        nargs="+",
        type=topic,
        metavar="TOPIC",
        help="e.g. state or hand/state, or all (default: all except input, the inputs of each "
        "tick)",
    )
    add_split(parser)
    parser.add_argument(
        "--recover", action="store_true", help="repair a truncated FILE instead of recording"
    )


def run(arguments: argparse.Namespace) -> int:
    """Record until a stop condition is met. Raises SoftfingerError.

    Returns 1 if the recording is incomplete.
    """
    if arguments.recover:
        messages, damage = recover(arguments.file)
        state = f"was corrupted ({damage}); only the intact part was kept" if damage else "intact"
        print(f"{arguments.file}: {messages} messages; {state}")
        return 0
    with StopCondition(arguments.duration, arguments.lifeline) as ending:
        return _Recorder(arguments, ending).record()


class _Recorder:
    """Files and counters for one ``record`` call."""

    def __init__(self, arguments: argparse.Namespace, ending: StopCondition) -> None:
        self._arguments = arguments
        self._address = arguments.address[0]
        self._ending = ending
        self._keys = client_keys(arguments.keys)  # Report unusable keys before creating a file.
        self._gaps: dict[bytes, Gaps] = {}
        # The last writer in this list is the active writer.
        self._writers = [RecordingWriter(arguments.file)]
        self._opened = time.monotonic()
        # Number of messages that are to be written, including the repeated settings.
        self._messages = 0
        self._settings: dict[str, Any] | None = None  # newest settings, marked as repeated
        self._unreadable = 0
        self._waiting = False  # True once the notice about the missing stream has been printed

    def record(self) -> int:
        """Record messages until a stop condition is met, and return the exit status."""
        arguments, failure = self._arguments, ""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            if self._keys is not None:
                self._keys.guard(context)
            socket = subscribe(context, self._address, *_topics(arguments.topics))
            failure = self._take_all(socket)
            self._writers[-1].close()
        except zmq.ZMQError as error:
            failure = f"{self._address}: {error}"
        except RecordingError as error:
            failure = str(error)
        finally:
            context.destroy(linger=0)
            if sys.stderr.isatty():
                print(f"\r{'':<79}\r", end="", file=sys.stderr, flush=True)
        return self._summary(failure)

    def _take_all(self, socket: zmq.Socket[bytes]) -> str:
        """Read messages until a stop condition is met; return the reason for a failure, or ""."""
        arguments, ending = self._arguments, self._ending
        began = shown = last = time.monotonic()
        ending.begin()
        failure = ""
        while not ending.is_met:
            taken = self._take_batch(socket)
            if taken < _BATCH_SIZE:
                ending.wait(_POLL_INTERVAL)
            now = time.monotonic()
            if taken:
                last = now
            elif not self._messages and now - began > _SILENCE_TIME:
                if arguments.no_wait and now - began > WAIT_MAX:
                    failure = no_stream(self._address, arguments.keys)
                    break
                if not self._waiting:
                    self._waiting = True
                    to_stderr("record")(waiting(self._address, arguments.keys))
            if now - shown >= _PROGRESS_INTERVAL:
                self._writers[-1].flush()
                self._show(now - began, now - last)
                shown = now
        # Messages sent before the signal, such as the daemon's last messages, may still arrive.
        self._read_remaining(
            socket, _TRANSIT_TIME if ending.is_requested or not ending.is_met else 0.0
        )
        return failure

    def _take_batch(self, socket: zmq.Socket[bytes]) -> int:
        """Process up to ``_BATCH_SIZE`` queued messages and return their number."""
        count = 0
        for message in drain(socket, _BATCH_SIZE):
            self._take(message)
            count += 1
        return count

    def _read_remaining(self, socket: zmq.Socket[bytes], quiet: float) -> None:
        """Process the queued messages, then wait up to ``quiet`` [s] for further messages."""
        end = time.monotonic() + _BACKLOG_TIMEOUT
        while time.monotonic() < end:
            if self._take_batch(socket) < _BATCH_SIZE:
                if quiet <= 0.0:
                    return
                began = time.monotonic()
                socket.poll(int(_POLL_INTERVAL * 1e3))
                # If the process stalls, count the stall as one poll interval.
                quiet -= min(time.monotonic() - began, _POLL_INTERVAL)

    def _take(self, frames: list[bytes]) -> None:
        try:
            topic, message = unpack(frames)
        except ValueError:
            self._unreadable += 1
            return
        if self._gaps.setdefault(topic, Gaps()).take(message):
            if topic == schema.SETTINGS:
                self._settings = message | {"again": True}
            self._split_if_due()
            self._writers[-1].add(topic, message)
            self._messages += 1

    def _split_if_due(self) -> None:
        arguments, writer = self._arguments, self._writers[-1]
        full = arguments.split_size is not None and writer.size >= arguments.split_size * 1e6
        age = time.monotonic() - self._opened
        if not full and (arguments.split_time is None or age < arguments.split_time):
            return
        path = arguments.file
        path = path.with_name(f"{path.stem}-{len(self._writers) + 1}{path.suffix}")
        # Open the new file before closing the old file, so that the old file remains usable if
        # opening fails.
        self._writers.append(RecordingWriter(path))
        self._opened = time.monotonic()
        writer.close()
        # Each file must contain the settings, so that it can be analysed without the first file.
        if self._settings is not None:
            self._writers[-1].add(schema.SETTINGS, dict(self._settings))
            self._messages += 1

    def _show(self, elapsed: float, silent: float) -> None:
        if not sys.stderr.isatty():
            return
        size = sum(writer.size for writer in self._writers) / 1e6
        lost = sum(gaps.lost for gaps in self._gaps.values())
        line = (
            f"{elapsed:8.1f} s  {self._messages} messages  {size:.1f} MB  "
            f"{size / max(elapsed, 1e-3):.2f} MB/s  {lost} lost"
        )
        if silent > _SILENCE_TIME:
            line += f"  no message for {silent:.0f} s"
        print(f"\r{line:<79.79}", end="", file=sys.stderr, flush=True)

    def _summary(self, failure: str) -> int:
        written = sum(writer.messages for writer in self._writers)
        for path in (writer.path for writer in self._writers):
            if written:
                print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
            else:
                # An empty file would prevent the next recording with this name.
                path.unlink(missing_ok=True)
        lost = ", ".join(
            f"{gaps.lost} of {topic.decode()}" for topic, gaps in self._gaps.items() if gaps.lost
        )
        received = f" of {self._messages}" if self._messages > written else ""
        print(f"{written} messages written{received}; lost: {lost or 'none'}")
        if self._unreadable:
            print(f"{self._unreadable} messages could not be read and were skipped")
        if failure:
            to_stderr("record")(failure)
        return 1 if failure else 0


def _topics(named: list[bytes] | None) -> list[bytes]:
    if named is None:
        return [each for each in schema.TOPICS if each != schema.INPUT]
    return list(schema.TOPICS) if ALL in named else named


def recover(path: Path) -> tuple[int, str]:
    """Repair a recording; return the number of messages and a description of the damage.

    A complete file is not changed. The repaired file replaces the original when the repair is
    complete. Raises RecordingError.
    """
    recording = Recording(path)
    if recording.check():
        return recording.total, ""
    if recording.others:
        raise RecordingError(
            f"{path}: contains channels from other programs, which would be lost; use `mcap "
            "recover`, which keeps these channels"
        )
    closed = path.with_name(path.name + ".recovered")
    closed.unlink(missing_ok=True)
    try:
        writer = RecordingWriter(closed)
        for topic, message in recording.messages():
            writer.add(topic, message)
        writer.close()
        closed.replace(path)
    except (OSError, RecordingError) as error:
        # The writer's message describes the copy, which is removed.
        cause = error.__context__ or error
        raise RecordingError(
            f"{path}: the repaired copy {closed.name} can't be written: "
            f"{getattr(cause, 'strerror', cause)}; the original file is unchanged"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            closed.unlink(missing_ok=True)
    return writer.messages, recording.damage
