"""Read messages from the stream or a recording, and draw pictures at a fixed rate."""

from __future__ import annotations

import argparse
import contextlib
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Any

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.client.stream import read
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.tools.arguments import WAIT_MAX, no_stream, waiting
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.stop_condition import StopCondition
from softfinger.tools.terminal.stream_state import number, printable
from softfinger.tools.viewing.pictures import SECONDS, TOPICS, Pictures

_SILENCE_TIME = 2.0  # time without messages before a notice is printed [s]
_DRAW_PAUSE_MAX = 1.0  # maximum time between pictures if drawing is slow [s]
_MARK_COUNT_MAX = 2_000  # maximum number of marks shown for a recording
_SPEED_RANGE = 0.1, 10.0
# Maximum number of messages queued between reads. The queue is long enough for 2 s of states, truth
# and frames at 1 kHz.
_QUEUE_LENGTH = 5_000


class ViewError(SoftfingerError):
    """Error raised if nothing can be shown. The error message gives the reason and a remedy."""


def follow(
    arguments: argparse.Namespace,
    keys: ClientKeys | None,
    pictures: Pictures,
    ending: StopCondition,
    say: Callable[[str], None],
) -> None:
    """Show the stream selected by ``arguments`` until ``ending.is_met``. Raises ViewError."""
    context: zmq.Context[Any] = zmq.Context()
    try:
        if keys is not None:
            keys.guard(context)
        socket = subscribe(context, arguments.address, *TOPICS, queue=_QUEUE_LENGTH)
        begun = last = time.monotonic()
        silent, rest = False, 1.0 / arguments.rate
        while not ending.wait(rest):
            began, worked = time.monotonic(), time.thread_time()
            for message in drain(socket, _QUEUE_LENGTH):
                last = began
                try:
                    pictures.take(*unpack(message))
                except ValueError:
                    pictures.unreadable += 1
            if arguments.no_wait and last == begun and began - begun > WAIT_MAX:
                raise ViewError(no_stream(arguments.address, arguments.keys))
            if silent != (began - last > _SILENCE_TIME):
                silent = not silent
                where = waiting(arguments.address, arguments.keys)
                say(where if silent else "the stream has started")
            pictures.draw()
            # Even on a slow machine, drawing uses at most half of the CPU time.
            worked = time.thread_time() - worked
            rest = max(
                1.0 / arguments.rate - (time.monotonic() - began), min(worked, _DRAW_PAUSE_MAX)
            )
    except zmq.ZMQError as error:
        raise ViewError(f"{arguments.address}: {error}") from None
    finally:
        context.destroy(linger=0)


def marks_of(recording: Recording) -> list[tuple[float, str, str, str]]:
    """Return the time [s], level, kind and text of each mode change, warning and error."""
    marks = []
    for _, message in recording.messages([schema.EVENT]):
        event = read(schema.Event, message)
        if event.again:
            continue
        if event.kind == "mode" or event.level != "info":
            at = event.timestamp - recording.start
            level, kind, text = map(printable, (event.level, event.kind, event.text))
            marks.append((round(at, 3), level, kind, text))
        if len(marks) == _MARK_COUNT_MAX:
            break
    return marks


class Playback:
    """Play a recording: `run` plays in real time, and `show` draws the current position."""

    def __init__(self, recording: Recording, pictures: Pictures, period: float) -> None:
        self._recording = recording
        self._pictures = pictures
        self._period = period  # time between two pictures [s]
        self._target: float | None = 0.0  # requested position, set by another thread [s]
        self.playing = True
        self.speed = 1.0
        self.position = 0.0  # time since the first message [s]
        self._messages: Iterator[tuple[bytes, dict[str, Any]]] = iter(())
        self._ahead: tuple[bytes, dict[str, Any]] | None = None  # next message to draw
        # Read the settings first, because a recording may contain them only once.
        for message in islice(recording.messages([schema.SETTINGS]), 1):
            pictures.take(*message)

    def ask(self, wish: str) -> None:
        """Handle a page's request: ``play``, ``pause``, ``speed N`` or a position [s]."""
        name, _, value = wish.partition(" ")
        with contextlib.suppress(ValueError):
            if name == "speed":
                if _SPEED_RANGE[0] <= (speed := float(value)) <= _SPEED_RANGE[1]:
                    self.speed = speed
            elif wish in ("play", "pause"):
                self.playing = wish == "play"
                if self.playing and self.position == self._recording.duration:
                    self._target = 0.0
            elif math.isfinite(place := float(wish)):
                self._target = min(max(place, 0.0), self._recording.duration)

    def run(self, ending: StopCondition) -> None:
        """Play until the stop condition ``ending`` is met."""
        recording, pictures = self._recording, self._pictures
        # Use a separate reader to search for marks. Searching a long recording takes several
        # seconds, and must not delay the first picture.
        finder = ThreadPoolExecutor(1)
        marks: Future[list[Any]] | None = finder.submit(lambda: marks_of(Recording(recording.path)))
        finder.shutdown(wait=False)
        while not ending.is_met:
            begun = time.monotonic()
            if marks is not None and marks.done():
                pictures.mark(marks.result())
                marks = None
            self.show()
            ending.wait(self._period)
            if self.playing:
                elapsed = self.speed * (time.monotonic() - begun)
                self.position = min(self.position + elapsed, recording.duration)

    def show(self) -> None:
        """Read the messages up to the current position, and draw a picture."""
        recording, pictures = self._recording, self._pictures
        if (target := self._target) is not None:
            self._target, self.position = None, target
            pictures.clear()
            # Start early enough to include the plots' history.
            self._messages = recording.messages(TOPICS, target - SECONDS)
            self._ahead = next(self._messages, None)
        while self._ahead is not None and (self._is_past(self._ahead[1]) or not pictures.states):
            pictures.take(*self._ahead)
            self._ahead = next(self._messages, None)
        self.playing &= self._ahead is not None
        pictures.draw(
            {
                "position": self.position,
                "start": recording.start,
                "duration": recording.duration,
                "playing": self.playing,
                "speed": self.speed,
            }
        )

    def _is_past(self, message: dict[str, Any]) -> bool:
        at = number(message, "timestamp") - self._recording.start
        return not min(at, self._recording.duration) > self.position
