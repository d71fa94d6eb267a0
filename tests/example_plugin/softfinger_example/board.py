"""Tactile board whose cells all report the same alternating count."""

import numpy as np
from pydantic import Field

from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.fields import Section
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.types import Frame


class PulseSettings(Section):
    """Settings in the ``[plugins.pulsing]`` section."""

    height: int = Field(default=3, ge=0, le=1000)  # counts


class PulsingBoard:
    """Board that generates frames on demand, one every 1/rate seconds."""

    Settings = PulseSettings

    def __init__(
        self, tactile: TactileSettings, clock: Clock, finger: int, own: PulseSettings
    ) -> None:
        self._shape = tactile.rows, tactile.cols
        self._period = 1.0 / tactile.rate
        self._height = own.height
        self._clock = clock
        self._frame: Frame | None = None

    def open(self) -> None:
        """Start with an all-zero frame."""
        self._start = self._clock.now()
        self._frame = Frame(1, self._start, self._start, True, np.zeros(self._shape, np.uint16))

    def latest(self) -> Frame | None:
        """Return the most recent frame that is due."""
        frame = self._frame
        if frame is not None:
            number = 1 + int((self._clock.now() - self._start) / self._period)
            if number > frame.seq:
                t = self._start + (number - 1) * self._period
                data = np.full(self._shape, self._height * (number % 2), np.uint16)
                self._frame = Frame(number, t, t, True, data)
        return self._frame

    def counters(self) -> dict[str, int]:
        """Return the number of frames generated so far."""
        return {"frames": 0 if self._frame is None else self._frame.seq}

    def close(self) -> None:
        """Stop delivering frames."""
        self._frame = None
