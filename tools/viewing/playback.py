"""A recording played at its own pace: from any place, on and on, or standing still."""

from __future__ import annotations

import contextlib
import math
import time

from softfinger.daemon.wire import schema
from softfinger.tools.ending import Ending
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.feed import number
from softfinger.tools.viewing.live_stream import TOPICS
from softfinger.tools.viewing.pictures import SECONDS, Pictures


class Playback:
    """A recording's place, and that it is ``playing``. ``run`` is for a thread of its own."""

    def __init__(self, recording: Recording, pictures: Pictures, period: float) -> None:
        self._recording = recording
        self._pictures = pictures
        self._period = period  # s between two pictures
        self._target: float | None = None  # where to go, from another thread
        self.playing = True
        self.position = 0.0  # s from the first message on
        self.duration = recording.duration

    def seek(self, position: float) -> None:
        """Go to ``position`` [s], from any thread."""
        self._target = min(max(position, 0.0), self.duration)

    def ask(self, wish: str) -> None:
        """Carry out a page's wish: ``play``, ``pause`` or a position; others are ignored."""
        with contextlib.suppress(ValueError):
            if wish in ("play", "pause"):
                self.playing = wish == "play"
            elif math.isfinite(place := float(wish)):
                self.seek(place)

    def run(self, ending: Ending) -> None:
        """Play until the end is asked for."""
        if self._recording.count(schema.SETTINGS):  # which may come once, at the beginning
            self._pictures.take(*next(self._recording.messages([schema.SETTINGS])))
        while not ending.over:
            if self._target is None and not self.playing:
                self._stand(ending)
            else:  # without a place, again from the beginning
                target, self._target = self._target or 0.0, None
                self._play_from(target, ending)

    def _play_from(self, target: float, ending: Ending) -> None:
        """Take the seconds before ``target`` at once, for the plots, then go on in time."""
        self._pictures.clear()
        self.position = target
        for topic, message in self._recording.messages(TOPICS, target - SECONDS):
            at = min(number(message, "timestamp") - self._recording.start, self.duration)
            while at > self.position and self._pictures.newest.get(schema.STATE):
                self._stand(ending)
                if self._target is not None or ending.over:
                    return
            self._pictures.take(topic, message)
        self.position = max(self.position, target)
        self.playing = False

    def _stand(self, ending: Ending) -> None:
        """Show this place for one picture; the next is later where it plays."""
        begun = time.monotonic()
        self._pictures.draw((self.position, self.duration, self.playing))
        ending.wait(self._period)
        if self.playing:
            self.position = min(self.position + time.monotonic() - begun, self.duration)
