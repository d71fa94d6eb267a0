"""The sources of messages, live or recorded: taken in time, with pictures of them at a rate."""

from __future__ import annotations

import argparse
import contextlib
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Any

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.client.stream import read
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.tools.arguments import PATIENCE, no_stream, waiting
from softfinger.tools.ending import Ending
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.feed import number, printable
from softfinger.tools.viewing.pictures import SECONDS, TOPICS, Pictures

_SILENCE = 2.0  # s without a message after which a line says so
_REST = 1.0  # s between two pictures at most, where drawing is slow
_MARKS = 2_000  # of a recording, at most
_SPEEDS = 0.1, 10.0
_QUEUE = 5_000  # messages that wait meanwhile: 2 s of state and truth at 1 kHz with their frames


class ViewError(SoftfingerError):
    """Nothing can be shown. The message says why, and what to do."""


def follow(
    arguments: argparse.Namespace,
    keys: ClientKeys | None,
    pictures: Pictures,
    ending: Ending,
    say: Callable[[str], None],
) -> None:
    """Show the stream that ``arguments`` name until the end. Raises ViewError."""
    context: zmq.Context[Any] = zmq.Context()
    try:
        if keys is not None:
            keys.guard(context)
        socket = subscribe(context, arguments.address, *TOPICS, queue=_QUEUE)
        begun = last = time.monotonic()
        silent, rest = False, 1.0 / arguments.rate
        while not ending.wait(rest):
            began, worked = time.monotonic(), time.thread_time()
            for message in drain(socket, _QUEUE):
                last = began
                try:
                    pictures.take(*unpack(message))
                except ValueError:
                    pictures.unreadable += 1
            if arguments.no_wait and last == begun and began - begun > PATIENCE:
                raise ViewError(no_stream(arguments.address, arguments.keys))
            if silent != (began - last > _SILENCE):
                silent = not silent
                where = waiting(arguments.address, arguments.keys)
                say(where if silent else "the stream has begun")
            pictures.draw()
            # Never works for more than half of its time, however slow the machine is.
            worked = time.thread_time() - worked
            rest = max(1.0 / arguments.rate - (time.monotonic() - began), min(worked, _REST))
    except zmq.ZMQError as error:
        raise ViewError(f"{arguments.address}: {error}") from None
    finally:
        context.destroy(linger=0)


def marks_of(recording: Recording) -> list[tuple[float, str, str, str]]:
    """Return time [s], level, kind and text of the changes of mode, the warnings and the errors."""
    marks = []
    for _, message in recording.messages([schema.EVENT]):
        event = read(schema.Event, message)
        if event.again:
            continue
        if event.kind == "mode" or event.level != "info":
            at = event.timestamp - recording.start
            level, kind, text = map(printable, (event.level, event.kind, event.text))
            marks.append((round(at, 3), level, kind, text))
        if len(marks) == _MARKS:
            break
    return marks


class Playback:
    """A recording's place, and that it is ``playing``. ``run`` is for its own thread."""

    def __init__(self, recording: Recording, pictures: Pictures, period: float) -> None:
        self._recording = recording
        self._pictures = pictures
        self._period = period  # s between two pictures
        self._target: float | None = 0.0  # where to go, from another thread
        self.playing = True
        self.speed = 1.0
        self.position = 0.0  # s from the first message on

    def ask(self, wish: str) -> None:
        """Carry out a page's wish: ``play``, ``pause``, ``speed N`` or a position [s]."""
        name, _, value = wish.partition(" ")
        with contextlib.suppress(ValueError):
            if name == "speed":
                if _SPEEDS[0] <= (speed := float(value)) <= _SPEEDS[1]:
                    self.speed = speed
            elif wish in ("play", "pause"):
                self.playing = wish == "play"
                if self.playing and self.position == self._recording.duration:
                    self._target = 0.0
            elif math.isfinite(place := float(wish)):
                self._target = min(max(place, 0.0), self._recording.duration)

    def run(self, ending: Ending) -> None:
        """Play until the end is asked for."""
        recording, pictures = self._recording, self._pictures
        # A reader of its own: a long recording takes seconds, and the first picture comes before.
        finder = ThreadPoolExecutor(1)
        marks: Future[list[Any]] | None = finder.submit(lambda: marks_of(Recording(recording.path)))
        finder.shutdown(wait=False)
        for message in islice(recording.messages([schema.SETTINGS]), 1):  # they may come only once
            pictures.take(*message)
        while not ending.over:
            begun = time.monotonic()
            if (target := self._target) is not None:
                self._target, self.position = None, target
                pictures.clear()
                messages = recording.messages(TOPICS, target - SECONDS)  # the plots' past
                ahead = next(messages, None)
            while ahead is not None and (self._is_past(ahead[1]) or not pictures.states):
                pictures.take(*ahead)
                ahead = next(messages, None)
            self.playing &= ahead is not None
            if marks is not None and marks.done():
                pictures.mark(marks.result())
                marks = None
            pictures.draw(
                {
                    "position": self.position,
                    "start": recording.start,
                    "duration": recording.duration,
                    "playing": self.playing,
                    "speed": self.speed,
                }
            )
            ending.wait(self._period)
            if self.playing:
                elapsed = self.speed * (time.monotonic() - begun)
                self.position = min(self.position + elapsed, recording.duration)

    def _is_past(self, message: dict[str, Any]) -> bool:
        at = number(message, "timestamp") - self._recording.start
        return not min(at, self._recording.duration) > self.position
