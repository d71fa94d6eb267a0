"""A sensor whose newest frame is set from outside, for frames that were recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import Frame


class GivenFrames:
    """Hands over ``frame``. ``live`` [rows, cols] tells the cells there are, None: all."""

    def __init__(self, live: NDArray[np.bool_] | None = None) -> None:
        self.frame: Frame | None = None
        self.live = live

    def open(self) -> None:
        """Nothing to open."""

    def latest(self) -> Frame | None:
        """The frame that was set last."""
        return self.frame

    def counters(self) -> dict[str, int]:
        """None: nothing can go wrong."""
        return {}

    def close(self) -> None:
        """Nothing to close."""
