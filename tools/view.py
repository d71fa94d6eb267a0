"""``softfinger view``: the stream, or a recording, in Rerun's viewer.

Holds the command's arguments and its loop. A process of its own on the public wire, in the
background of the machine: the daemon's loop does not wait for it, and what comes faster than it can
be shown is passed over.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from softfinger.daemon.client.connection import PATIENCE
from softfinger.tools.arguments import (
    add_keys,
    client_keys,
    megabytes,
    moment,
    nothing,
    seconds,
    stream_address,
    waiting,
)
from softfinger.tools.viewing.errors import NoRerun, ViewError

if TYPE_CHECKING:
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.viewing.viewer import Viewer

_EPILOG = """\
Opens Rerun's window, or with --web a page on this machine; with --save alone, neither.
Ends with Ctrl-C, when the window is closed, or after --duration.
From another machine: ssh -L 9090:127.0.0.1:9090 -L PORT:127.0.0.1:PORT, with the two ports told.
Exit status: 0, or 1 with the reason when nothing could be shown."""

_PORT = 9090  # of the page, when it is free
_SILENCE = 2.0  # s without a message until the waiting is told
_SLOW_LOOK = 1.0  # s between two looks at this process's memory
_BREATH = 50.0  # MB that it may grow by itself
_AHEAD = 200  # pictures of a recording that are sent before the viewer is waited for
_PATIENCE = 60.0  # s for that
_REST = 1.0  # s between two pictures at most, where drawing is slow
_LOOK = 0.2  # s between two looks at the viewer
_NICE = 5  # the viewer stands back behind everything that is in a hurry


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``view``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument(
        "file", type=Path, nargs="?", metavar="FILE.mcap", help="a recording, instead of the stream"
    )
    parser.add_argument("--address", type=stream_address, default="", help="the stream's socket")
    add_keys(parser)
    parser.add_argument("--web", action="store_true", help="in the browser, instead of a window")
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")
    parser.add_argument(
        "--port", type=_port, metavar="N", help=f"the page's; {_PORT} or a free one"
    )
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="must not be there yet")
    parser.add_argument(
        "--memory", type=megabytes, default=500.0, metavar="MB", help="kept, the newest of it; 500"
    )
    parser.add_argument(
        "--rate", type=_rate, default=20.0, metavar="HZ", help="pictures a second at most; 20"
    )
    parser.add_argument("--duration", type=seconds, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--from", type=moment, default=0.0, metavar="S", dest="start", help="of a recording"
    )
    parser.add_argument("--to", type=seconds, metavar="S", dest="end", help="of a recording")
    parser.add_argument(
        "--no-wait", action="store_true", help="end with an error when nothing comes within 2 s"
    )


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"expected a port, found {text!r}")
    return int(text)


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 100.0:
        raise argparse.ArgumentTypeError(f"expected 0.1 to 100 Hz, found {text!r}")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Show until told to end; 1 with one line when something went wrong."""
    from softfinger.daemon.errors import KeyFileError, RecordingError

    try:
        with _Ending(arguments.duration) as ending:
            return _View(arguments, ending).show()
    except (ViewError, RecordingError, KeyFileError) as error:
        print(f"view: {error}", file=sys.stderr)
        return 1


class _View:
    """One call of ``view``: viewer, bridge, and where the messages come from."""

    def __init__(self, arguments: argparse.Namespace, ending: _Ending) -> None:
        # What goes wrong there is told here, in one line.
        os.environ.setdefault("RUST_LOG", "off")
        try:
            import rerun
        except ImportError:
            raise NoRerun from None
        from softfinger.tools.viewing.bridge import Bridge

        self._arguments = arguments
        self._keys = client_keys(arguments.keys)
        self._ending = ending
        self._notes_told = 0
        self._saves = False
        self._looked = -math.inf
        self._resident = math.inf  # MB, the least since something is shown
        self._rerun = rerun
        self._recording: Any = rerun.RecordingStream("softfinger")
        self._recording.set_log_tick_enabled(False)
        self._recording.set_log_time_enabled(False)
        self._bridge = Bridge(self._recording)

    def show(self) -> int:
        """From the first message to the end."""
        from softfinger.daemon.loop.warm_up import LANDSCAPE
        from softfinger.daemon.profile.settings import Settings
        from softfinger.tools.processes.kernel_build import build_kernels
        from softfinger.tools.viewing.known import warm_up

        arguments, ending = self._arguments, self._ending
        recording = None
        if arguments.file is not None:
            from softfinger.tools.recordings.reader import Recording

            recording = Recording(arguments.file, self._say)
        os.nice(_NICE)
        viewer = None
        try:
            if arguments.web or arguments.save is None:
                viewer = self._open()
            self._connect(viewer)
            build_kernels(Settings(), lambda _level, _kind, text: self._say(text), LANDSCAPE)
            warm_up()
            ending.begin()
            if recording is None:
                self._show_stream(viewer)
            else:
                self._show_recording(recording, viewer)
        finally:
            if viewer is not None:  # first: one that hangs would hold up what follows
                viewer.close()
            self._recording.disconnect()
            if self._saves and self._bridge.shown == 0 and arguments.save is not None:
                arguments.save.unlink(missing_ok=True)  # it would be in the next one's way
                self._saves = False
        self._account()
        if self._bridge.shown == 0:
            where = arguments.address if recording is None else arguments.file
            raise ViewError(f"{where}: nothing came that can be shown")
        return 0

    def _open(self) -> Viewer:
        from softfinger.tools.viewing.viewer import Viewer, is_free

        arguments = self._arguments
        port = arguments.port or (_PORT if is_free(_PORT) else 0)
        viewer = Viewer(not arguments.web, arguments.memory, port)
        if viewer.address:
            print(f"view: {viewer.address} with data from port {viewer.receiver}", flush=True)
            if not arguments.no_browser:
                import webbrowser

                webbrowser.open(viewer.address)
        return viewer

    def _connect(self, viewer: Viewer | None) -> None:
        sinks: list[Any] = []
        if viewer is not None:
            sinks.append(self._rerun.GrpcSink(viewer.url))
        save = self._arguments.save
        if save is not None:
            try:
                save.touch(exist_ok=False)
                self._saves = True
            except FileExistsError:
                raise ViewError(f"{save}: is there already") from None
            except OSError as error:
                raise ViewError(f"{save}: {error.strerror}") from None
            # A footer makes large files open faster; it would pile up for as long as a stream goes.
            footer = self._arguments.file is not None
            sinks.append(self._rerun.FileSink(save, write_footer=footer))
        self._recording.set_sinks(*sinks)

    def _show_stream(self, viewer: Viewer | None) -> None:
        from softfinger.tools.viewing.live import LiveStream

        bridge, ending = self._bridge, self._ending
        heard = time.monotonic()
        silent = ever = False
        period = 1.0 / self._arguments.rate
        with LiveStream(self._arguments.address, self._keys) as stream:
            due = heard
            while not ending.over():
                count = stream.drain(bridge, due)
                now = time.monotonic()
                if count:
                    heard, ever = now, True
                if silent and count:
                    self._say("the stream is here")
                    silent = False
                elif self._arguments.no_wait and now - heard > PATIENCE:
                    raise ViewError(nothing(stream.address, PATIENCE, self._arguments.keys))
                elif not silent and now - heard > _SILENCE:
                    coming = waiting(stream.address, self._arguments.keys)
                    self._say(f"silent: {stream.address}" if ever else coming)
                    silent = True
                bridge.draw()
                self._tell_notes()
                after = time.monotonic()
                # Never busy for more than half of its time, however slow the machine is.
                due = after + max(period - (after - now), min(after - now, _REST))
                if not self._shows(viewer):
                    return
            stream.drain(bridge, 0.0)
            bridge.draw(last=True)

    def _show_recording(self, recording: Recording, viewer: Viewer | None) -> None:
        from softfinger.tools.terminal.progress import Progress
        from softfinger.tools.viewing.bridge import TOPICS

        arguments, bridge = self._arguments, self._bridge
        drawn, period, pictures = math.nan, 1.0 / arguments.rate, 0
        with Progress("view", recording.size) as progress:
            end = math.inf if arguments.end is None else arguments.end
            for topic, message in recording.messages(TOPICS, arguments.start, end, progress):
                bridge.take(topic, message)
                if not abs(bridge.time - drawn) < period:
                    bridge.draw()
                    drawn = bridge.time
                    pictures += 1
                    if pictures % _AHEAD == 0:
                        self._flush()
                    if self._ending.over() or not self._shows(viewer):
                        return
        bridge.draw(last=True)
        self._tell_notes()
        self._flush()
        if viewer is not None:
            self._say("all is shown; Ctrl-C ends")
            while not self._ending.wait(_LOOK) and self._shows(viewer):
                pass

    def _shows(self, viewer: Viewer | None) -> bool:
        """False once the window was closed. Raises ViewError when the viewer has died or hangs."""
        if viewer is None or viewer.running():
            self._watch_memory()
            return True
        failure = viewer.failure()
        if failure:
            raise ViewError(failure)
        return False

    def _flush(self) -> None:
        """Wait until the viewer has what it was sent. Raises ViewError when it does not take it."""
        try:
            self._recording.flush(timeout_sec=_PATIENCE)
        except Exception as error:  # of whatever kind Rerun's is
            raise ViewError(f"the viewer takes nothing more: {error}") from None

    def _watch_memory(self) -> None:
        """Raise ViewError when what a viewer doesn't take has piled up to the bound."""
        from softfinger.tools.viewing.viewer import resident

        now = time.monotonic()
        if self._bridge.shown == 0 or now - self._looked < _SLOW_LOOK:
            return
        self._looked = now
        memory = resident()
        self._resident = min(self._resident, memory)
        if memory - self._resident > self._arguments.memory + _BREATH:
            raise ViewError(
                f"the viewer falls behind by {memory - self._resident:.0f} MB: see --memory"
            )

    def _tell_notes(self) -> None:
        for note in self._bridge.notes[self._notes_told :]:
            self._say(note)
        self._notes_told = len(self._bridge.notes)

    def _account(self) -> None:
        bridge = self._bridge
        lost = ", ".join(f"{count} of {topic}" for topic, count in bridge.lost.items())
        parts = [f"{bridge.shown} states shown"]
        if bridge.frames:
            parts.append(f"{bridge.drawn} of {bridge.frames} frames drawn")
        if bridge.dropped:
            parts.append(f"{bridge.dropped} states passed over to keep up")
        if bridge.swamped:
            parts.append(f"{bridge.swamped} events passed over")
        parts.append(f"lost on the way: {lost or 'none'}")
        if bridge.unreadable:
            parts.append(f"{bridge.unreadable} messages could not be read")
        self._say(", ".join(parts))
        if self._saves:
            size = self._arguments.save.stat().st_size
            self._say(f"{self._arguments.save}: {size / 1e6:.2f} MB")

    @staticmethod
    def _say(line: str) -> None:
        print(f"view: {line}", file=sys.stderr, flush=True)


class _Ending:
    """Whether it is time to end: after a signal, or when the duration is over."""

    def __init__(self, duration: float | None) -> None:
        self._asked = threading.Event()
        self._duration = math.inf if duration is None else duration
        self._deadline = math.inf

    def begin(self) -> None:
        """The duration counts from now on: a slow start takes nothing of it."""
        self._deadline = time.monotonic() + self._duration

    def over(self) -> bool:
        """Time to end."""
        return self._asked.is_set() or time.monotonic() >= self._deadline

    def wait(self, patience: float) -> bool:
        """Wait for the end for so many seconds; True when it has come."""
        left = self._deadline - time.monotonic()
        return self._asked.wait(max(0.0, min(patience, left))) or self.over()

    def __enter__(self) -> _Ending:
        self._before = {
            number: signal.signal(number, lambda *_: self._asked.set())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
