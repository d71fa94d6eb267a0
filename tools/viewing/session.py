"""One call of ``softfinger view``: viewer, bridge, and the source of the messages.

It runs in the background of the machine: the daemon's loop never waits for it, and what comes
faster than it can be shown is skipped.
"""

from __future__ import annotations

import argparse
import math
import os
import time
import webbrowser
from collections.abc import Callable
from typing import Any

import rerun as rr

from softfinger.daemon.loop.warm_up import LANDSCAPE
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.ending import Ending
from softfinger.tools.processes.kernel_build import build_kernels
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.progress import Progress
from softfinger.tools.viewing.bridge import Bridge
from softfinger.tools.viewing.known import warm_up
from softfinger.tools.viewing.live_stream import NICE, TOPICS, ViewError, follow
from softfinger.tools.viewing.viewer import Viewer, resident

_MEMORY_STEP = 1.0  # s between two looks at this process's memory
_MEMORY_SLACK = 50.0  # MB that it may grow by itself
_AHEAD = 200  # pictures of a recording that are sent before waiting for the viewer
_FLUSH_TIME = 60.0  # s for that
_LATE = 1.0  # MB of the stream, some 3 s, that a page opened late reads before it is up to date


class Session:
    """Shows the stream or a recording. Raises SoftfingerError."""

    def __init__(self, arguments: argparse.Namespace, ending: Ending) -> None:
        self._arguments = arguments
        self._keys = client_keys(arguments.keys)
        self._ending = ending
        self._say: Callable[[str], None] = to_stderr("view")
        self._viewer: Viewer | None = None
        self._saves = False
        self._looked = -math.inf
        self._resident = math.inf  # MB, the least since something is shown
        self._recording = rr.RecordingStream("softfinger")
        if hasattr(self._recording, "set_log_tick_enabled"):  # since Rerun 0.34
            self._recording.set_log_tick_enabled(False)
            self._recording.set_log_time_enabled(False)
        self._bridge = Bridge(self._recording, self._say)

    def show(self) -> None:
        """From the first message to the end."""
        arguments, bridge = self._arguments, self._bridge
        recording = None if arguments.file is None else Recording(arguments.file, self._say)
        os.nice(NICE)
        try:
            if arguments.web or arguments.save is None:
                self._open()
            self._connect()
            build_kernels(Settings(), lambda _level, _kind, text: self._say(text), LANDSCAPE)
            warm_up()
            self._ending.begin()
            if recording is None:
                follow(arguments, self._keys, bridge, self._ending, self._say, self._is_open)
            else:
                self._show_recording(recording)
        finally:
            if self._viewer is not None:  # first: one that hangs would delay what follows
                self._viewer.close()
            self._recording.disconnect()
            if self._saves and bridge.shown == 0:
                arguments.save.unlink(missing_ok=True)  # it would be in the next call's way
                self._saves = False
        self._say(bridge.summary())
        if self._saves:
            self._say(f"{arguments.save}: {arguments.save.stat().st_size / 1e6:.2f} MB")
        if bridge.shown == 0:
            where = arguments.address if recording is None else arguments.file
            raise ViewError(f"{where}: nothing came that can be shown")

    def _open(self) -> None:
        arguments = self._arguments
        memory = arguments.memory
        if arguments.web and arguments.file is None:
            memory = min(memory, _LATE)
        viewer = self._viewer = Viewer(not arguments.web, memory, arguments.port)
        if viewer.address:
            print(f"view: {viewer.address} with data from port {viewer.receiver}", flush=True)
            if not arguments.no_browser:
                webbrowser.open(viewer.address)

    def _connect(self) -> None:
        sinks: list[Any] = []
        if self._viewer is not None:
            sinks.append(rr.GrpcSink(self._viewer.url))
        save = self._arguments.save
        if save is not None:
            try:
                save.touch(exist_ok=False)
            except FileExistsError:
                raise ViewError(f"{save}: exists already") from None
            self._saves = True
            # A footer makes large files open faster; of a stream it would grow without end.
            sinks.append(rr.FileSink(save, write_footer=self._arguments.file is not None))
        self._recording.set_sinks(*sinks)

    def _show_recording(self, recording: Recording) -> None:
        arguments, bridge = self._arguments, self._bridge
        drawn, pictures = math.nan, 0
        with Progress("view", recording.size) as progress:
            for topic, message in recording.messages(
                TOPICS, arguments.start, arguments.end, progress
            ):
                bridge.take(topic, message)
                if not abs(bridge.time - drawn) < 1.0 / arguments.rate:
                    bridge.draw()
                    drawn = bridge.time
                    pictures += 1
                    if pictures % _AHEAD == 0:
                        self._flush()
                    if self._ending.over or not self._is_open():
                        return
        bridge.draw(last=True)
        self._flush()
        if self._viewer is not None:
            self._say("all is shown; Ctrl-C ends")
            while not self._ending.wait(0.2) and self._is_open():
                pass

    def _is_open(self) -> bool:
        """False once the window was closed. Raises ViewError when the viewer has died or hangs."""
        if self._viewer is None or self._viewer.running():
            self._watch_memory()
            return True
        failure = self._viewer.failure()
        if failure:
            raise ViewError(failure)
        return False

    def _flush(self) -> None:
        """Wait until the viewer has everything so far. Raises ViewError when it doesn't take it."""
        try:
            self._recording.flush(timeout_sec=_FLUSH_TIME)
        except Exception as error:  # of any of Rerun's kinds
            raise ViewError(f"the viewer takes no more data: {error}") from None

    def _watch_memory(self) -> None:
        """Raise ViewError when the data that the viewer didn't take yet exceeds ``--memory``."""
        now = time.monotonic()
        if self._bridge.shown == 0 or now - self._looked < _MEMORY_STEP:
            return
        self._looked = now
        memory = resident()
        self._resident = min(self._resident, memory)
        behind = memory - self._resident
        if behind > self._arguments.memory + _MEMORY_SLACK:
            raise ViewError(f"the viewer is {behind:.0f} MB behind: see --memory")
