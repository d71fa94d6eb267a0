"""``softfinger record FILE.mcap``: the running daemon's stream into a recording."""

from __future__ import annotations

import argparse
import select
import signal
import sys
import time
from pathlib import Path
from typing import Any

from softfinger.daemon.client.connection import PATIENCE
from softfinger.daemon.errors import RecordingError
from softfinger.tools.arguments import (
    ALL,
    add_keys,
    client_keys,
    megabytes,
    moment,
    nothing,
    seconds,
    stream_address,
    topic,
    waiting,
)

_EPILOG = """\
Ends with Ctrl-C, after --duration, or at --to; prints what it wrote and what was lost on the way.
With --split-size or --split-time it goes on in FILE-2.mcap, FILE-3.mcap and so on.
Exit status: 0 written, 1 not or not all, with the reason."""

_SILENCE = 2.0  # s without a message until the waiting is told
# s between two looks at the clock and the socket, where what came since then is waiting: waking for
# each message would cost more than all that is done with it.
_LOOK = 0.1
_BACKLOG = 10.0  # s for what waits when the end is asked for
_SHOW = 0.5  # s between two progress lines
_BATCH = 1000  # messages between two looks at the clock


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``record``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap", help="must not be there yet")
    parser.add_argument("--address", type=stream_address, default="", help="the stream's socket")
    add_keys(parser)
    parser.add_argument("--duration", type=seconds, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--from",
        type=moment,
        default=0.0,
        metavar="S",
        dest="start",
        help="leave out what comes before S seconds of the stream",
    )
    parser.add_argument(
        "--to", type=seconds, metavar="S", dest="end", help="and end S seconds after its start"
    )
    parser.add_argument(
        "--topics",
        nargs="+",
        type=topic,
        metavar="TOPIC",
        help="as state or hand/state, or all; all but input if none is named (`replay --recompute` "
        "needs input, which is what every tick took in)",
    )
    parser.add_argument("--split-size", type=megabytes, metavar="MB", help="a new file after MB")
    parser.add_argument(
        "--split-time", type=seconds, metavar="S", help="a new file after S seconds"
    )
    parser.add_argument(
        "--no-wait",
        action="store_true",
        help=f"end with an error when nothing comes within {PATIENCE:g} s",
    )
    parser.add_argument("--lifeline", type=int, help=argparse.SUPPRESS)  # a pipe of the daemon's
    parser.add_argument(
        "--recover", action="store_true", help="close a FILE that was cut short, and record nothing"
    )


def run(arguments: argparse.Namespace) -> int:
    """Record until told to end; 1 with one line when something went wrong."""
    from softfinger.daemon.errors import KeyFileError

    try:
        if arguments.recover:
            return _recover(arguments.file)
        with _Ending() as ending:
            return _Recorder(arguments, ending).record()
    except (RecordingError, KeyFileError) as error:
        print(f"record: {error}", file=sys.stderr)
        return 1


def _recover(path: Path) -> int:
    from softfinger.tools.recordings.recover import recover

    messages, damage = recover(path)
    print(
        f"{path}: {messages} messages; "
        + (f"was not whole ({damage}), what was sound is closed" if damage else "sound")
    )
    return 0


class _Recorder:
    """One call of ``record``: the socket, the files one after the other, and the account."""

    def __init__(self, arguments: argparse.Namespace, ending: _Ending) -> None:
        from softfinger.daemon.client.stream import Gaps
        from softfinger.tools.recordings.writer import RecordingWriter

        self._arguments = arguments
        self._keys = client_keys(arguments.keys)  # before there is a file
        self._ending = ending
        self._gaps: dict[bytes, Gaps] = {}
        self._new_gaps = Gaps
        self._new_writer = RecordingWriter
        self._writer = RecordingWriter(arguments.file)
        self._files = [arguments.file]
        self._first: float | None = None  # the stream's first timestamp
        self._opened = time.monotonic()
        self._messages = 0  # that came and were to be written
        self._bytes = 0  # in the files before this one
        self._written = 0  # messages in them
        self._unreadable = 0
        self._told_waiting = False
        self._complete = False  # all until --to has come

    def record(self) -> int:
        """Take messages until the end."""
        import zmq

        from softfinger.daemon.client.connection import subscribe

        arguments = self._arguments
        context: zmq.Context[Any] = zmq.Context()
        try:
            if self._keys is not None:
                self._keys.guard(context)
            socket = subscribe(context, arguments.address, *_topics(arguments.topics))
            failure = self._take_all(socket)
            self._writer.close()
        except zmq.ZMQError as error:
            failure = f"{arguments.address}: {error}"
        except RecordingError as error:
            failure = str(error)
        finally:
            context.destroy(linger=0)
            self._clear_line()
        return self._account(failure)

    def _take_all(self, socket: Any) -> str:
        """Take messages until the end; why it had to end, else an empty text."""
        arguments = self._arguments
        began = shown = heard = time.monotonic()
        failure = ""
        until_quiet = _LOOK
        while not self._ending.asked and not self._complete:
            taken = self._take_batch(socket)
            if taken < _BATCH:
                time.sleep(self._pause(time.monotonic() - began))
            now = time.monotonic()
            if taken:
                heard = now
            elif self._first is None and now - began > _SILENCE:
                if arguments.no_wait and now - began > PATIENCE:
                    failure = nothing(arguments.address, PATIENCE, arguments.keys)
                    break
                self._tell_waiting()
            if arguments.lifeline is not None and _hung_up(arguments.lifeline):
                break
            if arguments.duration is not None and now - began >= arguments.duration:
                until_quiet = 0.0
                break
            if now - shown >= _SHOW:
                self._writer.flush()
                self._show(now - began, now - heard)
                shown = now
        self._take_rest(socket, until_quiet)
        return failure

    def _pause(self, elapsed: float) -> float:
        duration = self._arguments.duration
        return _LOOK if duration is None else min(_LOOK, max(0.0, duration - elapsed))

    def _take_batch(self, socket: Any) -> int:
        """Take what waits; how many messages, ``_BATCH`` at most."""
        import zmq

        receive = socket.recv_multipart
        for count in range(_BATCH):
            try:
                frames = receive(zmq.NOBLOCK)
            except zmq.Again:
                return count
            self._take(frames)
            if self._complete:
                return count + 1
        return _BATCH

    def _take_rest(self, socket: Any, until_quiet: float) -> None:
        """Take what waits, and for ``until_quiet`` s at most what is still on its way.

        That is what was sent before the end was asked for: a daemon's last words among it.
        """
        began = time.monotonic()
        while not self._complete:
            behind = self._take_batch(socket) == _BATCH
            age = time.monotonic() - began
            if behind and age < _BACKLOG:
                continue
            if age >= until_quiet or not socket.poll(int((until_quiet - age) * 1e3)):
                return

    def _take(self, frames: list[bytes]) -> None:
        import msgpack

        try:
            topic, payload = frames
            message = msgpack.unpackb(payload)
            if not isinstance(message, dict):
                raise ValueError("not a map")
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
            self._unreadable += 1
            return
        arguments = self._arguments
        stamp = message.get("timestamp")
        when = stamp if isinstance(stamp, float) else time.time()
        if message.get("again") is not True:  # what is told again is from before the first one
            if self._first is None:
                self._first = when
            if arguments.start and when - self._first < arguments.start:
                return
            if arguments.end is not None and when - self._first > arguments.end:
                self._complete = True
                return
        gaps = self._gaps.get(topic)
        if gaps is None:
            gaps = self._gaps[topic] = self._new_gaps()
        if not gaps.take(message):
            return  # told again for somebody else
        self._split_if_due()
        self._writer.add(topic, message)
        self._messages += 1

    def _split_if_due(self) -> None:
        arguments, writer = self._arguments, self._writer
        if arguments.split_size is None and arguments.split_time is None:
            return
        full = arguments.split_size is not None and writer.size >= arguments.split_size * 1e6
        age = time.monotonic() - self._opened
        if not full and (arguments.split_time is None or age < arguments.split_time):
            return
        path = arguments.file
        path = path.with_name(f"{path.stem}-{len(self._files) + 1}{path.suffix}")
        following = self._new_writer(path)  # before the old one ends: should it fail, that stands
        self._bytes += writer.size
        self._writer = following
        self._files.append(path)
        try:
            writer.close()
        finally:
            self._written += writer.messages
        self._opened = time.monotonic()

    # What is said of it

    def _tell_waiting(self) -> None:
        if not self._told_waiting:
            self._told_waiting = True
            arguments = self._arguments
            print(f"record: {waiting(arguments.address, arguments.keys)}", file=sys.stderr)

    def _show(self, elapsed: float, silent: float) -> None:
        if not sys.stderr.isatty():
            return
        size = (self._bytes + self._writer.size) / 1e6
        line = (
            f"{elapsed:8.1f} s  {self._messages} messages  {size:.1f} MB  "
            f"{size / max(elapsed, 1e-3):.2f} MB/s  {self._lost()} lost"
        )
        if silent > _SILENCE:
            line += f"  silent for {silent:.0f} s"
        print(f"\r{line:<79.79}", end="", file=sys.stderr, flush=True)

    def _clear_line(self) -> None:
        if sys.stderr.isatty():
            print(f"\r{'':<79}\r", end="", file=sys.stderr, flush=True)

    def _lost(self) -> int:
        return sum(gaps.lost for gaps in self._gaps.values())

    def _account(self, failure: str) -> int:
        written = self._written + self._writer.messages
        if not written:  # no file, which would be in the next one's way
            for path in self._files:
                path.unlink(missing_ok=True)
        for path in self._files:
            if path.exists():
                print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        lost = ", ".join(
            f"{gaps.lost} of {topic.decode()}" for topic, gaps in self._gaps.items() if gaps.lost
        )
        missing = self._messages - written
        unwritten = f" of {self._messages} that came" if missing else ""
        print(f"{written} messages written{unwritten}; lost on the way: {lost or 'none'}")
        if self._unreadable:
            print(f"{self._unreadable} messages could not be read and were left out")
        if failure:
            print(f"record: {failure}", file=sys.stderr)
        return 1 if failure else 0


def _topics(named: list[bytes] | None) -> list[bytes]:
    from softfinger.daemon.wire import schema

    if named is None:
        return [each for each in schema.TOPICS if each != schema.INPUT]
    return list(schema.TOPICS) if ALL in named else named


def _hung_up(lifeline: int) -> bool:
    """The other end of the pipe is closed: the daemon that started this is gone."""
    return bool(select.select([lifeline], [], [], 0.0)[0])


class _Ending:
    """Whether it is time to end; SIGINT and SIGTERM ask for it meanwhile."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> _Ending:
        self._old = {
            number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def _ask(self, *_: object) -> None:
        self.asked = True

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)
