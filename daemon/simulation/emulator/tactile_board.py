"""An emulated tactile board: the simulated sensor's frames, in a board's framing, on a pty.

Framings plug in as encoders (`ENCODERS`), pure functions from counts to bytes. The faults that a
board may have are applied here too.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import math
import os
import termios
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.emulator.pty_bus import open_pty
from softfinger.daemon.tactile import cobs
from softfinger.daemon.types import Frame

_TTY_ROOM = 2048  # bytes; a tty reports at most 4095 unread ones, so more is never asked for
_DRAIN = 4096
_RETRY = 5e-4  # s until a frame that is late is asked for again
_NOISE_LENGTH = 64  # bytes, longest burst of noise between frames


class FrameSource(Protocol):
    """Source of a board's frames: the simulated sensor."""

    def latest(self) -> Frame | None:
        """Return the newest frame that is due, or None before the first."""


class FrameWriter:
    """The board's end of a pty. Frames go out whole or not at all.

    A pty holds some tens of kilobytes. While nobody reads, frames are dropped early, so that the
    next client isn't fed old ones, as with a board whose port nobody has opened.
    """

    def __init__(self) -> None:
        self._master, self._slave, self.path = open_pty()
        self.dropped = 0  # frames
        self._remaining = b""  # of a frame that the pty took only a part of
        self._unread = array.array("i", [0])

    def fileno(self) -> int:
        """Return a descriptor, readable when the client has written; see :meth:`drain`."""
        return self._master

    def send(self, frame: bytes) -> bool:
        """Write one frame, or drop it when the client has not read those before it."""
        if not self.flush() or self._unread_bytes() > min(len(frame), _TTY_ROOM):
            self.dropped += 1
            return False
        self._remaining = frame
        self.flush()
        return True

    def flush(self) -> bool:
        """Write on with what is left of a frame; True when nothing is left."""
        if self._remaining:
            with contextlib.suppress(BlockingIOError):
                self._remaining = self._remaining[os.write(self._master, self._remaining) :]
        return not self._remaining

    def drain(self) -> bytes:
        """Return the bytes that the client has written."""
        try:
            return os.read(self._master, _DRAIN)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close both ends; a client then reads an error."""
        for end in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(end)

    def _unread_bytes(self) -> int:
        fcntl.ioctl(self._slave, termios.FIONREAD, self._unread)
        return self._unread[0]


class TactileBoard:
    """Sends each new frame of ``source`` on a pty, in one framing, with the faults asked for.

    A board that is asked for its frames sends the next one that comes after it was asked.
    ``faults`` are in force, by their kind, with their probability:

    - ``torn``: a frame lacks some of its bytes, anywhere.
    - ``noisy``: random bytes stand before a frame, and one byte of it is wrong.
    - ``silent``: it sends nothing more.
    - ``frozen``: it repeats its last frame.
    - ``wrong-size``: it sends a grid of half the rows and half the columns.
    - ``saturated``, ``zero``: all its cells read the greatest count, or none.

    The latter five are certain whatever their probability.
    """

    def __init__(
        self,
        source: FrameSource,
        encoder: Encoder,
        rate: float,
        delay: float,
        seed: int = 1,
    ) -> None:
        """Frames are due at k/rate + delay [Hz, s]; ``seed`` drives the faults' chance."""
        self._source = source
        self._encoder = encoder
        self._requested = not encoder.request
        self._rate = rate
        self._delay = delay
        self.faults: dict[str, float] = {}
        self._random = np.random.default_rng(seed)
        self.plug()
        self._seq = -1
        self._frozen: NDArray[np.uint16] | None = None  # the image that a frozen board repeats
        self._due = -math.inf
        self.sent = 0  # frames

    def plug(self) -> None:
        """Make the port (again), at a new ``path``."""
        self._writer = FrameWriter()
        self.path = self._writer.path
        self.plugged = True

    def unplug(self) -> None:
        """Take the port away; a client reads an error. The board goes on."""
        if self.plugged:
            self._writer.close()
        self.plugged = False

    @property
    def dropped(self) -> int:
        """Frames that nobody read in time."""
        return self._writer.dropped

    def fileno(self) -> int:
        """Return a descriptor, readable when :meth:`hear` has something to do."""
        return self._writer.fileno()

    def hear(self) -> None:
        """Take what the client wrote: requests, where the board waits for them."""
        written = self._writer.drain() if self.plugged else b""
        if self._encoder.request and self._encoder.request in written:
            self._requested = True

    def next_event(self) -> float:
        """Return when :meth:`service` next has something to do [s]."""
        return self._due

    def service(self, t: float) -> None:
        """Send the newest frame if a new one is due at time t [s]."""
        if self.plugged:
            self._writer.flush()
        # The instant of a due frame itself may be rounded either way.
        self._due = (math.floor((t - self._delay) * self._rate + 1e-6) + 1) / self._rate
        self._due += self._delay
        frame = self._source.latest()
        if frame is None or frame.seq == self._seq:
            self._due = min(self._due, t + _RETRY)
            return
        self._seq = frame.seq
        if not self._requested or not self.plugged:
            return
        data = self._spoil(frame)
        if data:
            self._requested = not self._encoder.request
            self.sent += self._writer.send(data)

    def close(self) -> None:
        self.unplug()

    def _spoil(self, frame: Frame) -> bytes:
        counts, faults = frame.data, self.faults
        if "silent" in faults:
            return b""
        if "frozen" in faults:
            counts = counts if self._frozen is None else self._frozen
        self._frozen = counts
        if "saturated" in faults:
            counts = np.full_like(counts, np.iinfo(counts.dtype).max)  # framings clip it
        elif "zero" in faults:
            counts = np.zeros_like(counts)
        if "wrong-size" in faults:
            counts = counts[: counts.shape[0] // 2, : counts.shape[1] // 2]
        data = self._encoder.encode(counts, frame.seq, frame.t_sample)
        for kind, chance in faults.items():
            if kind == "torn" and self._random.random() < chance:
                left, right = sorted(self._random.integers(0, len(data) + 1, 2).tolist())
                data = data[:left] + data[right:]
            elif kind == "noisy" and self._random.random() < chance:
                wrong = bytearray(data)
                wrong[self._random.integers(len(wrong))] = self._random.integers(256)
                burst = self._random.bytes(int(self._random.integers(1, _NOISE_LENGTH + 1)))
                data = burst + bytes(wrong)
        return data


# counts [rows, cols], the scan's number, the board's time [s] → bytes
Encode = Callable[[NDArray[np.uint16], int, float], bytes]


@dataclass(frozen=True, slots=True)
class Encoder:
    """A framing, and the byte that a board waits for before each frame; empty when it runs free."""

    encode: Encode
    request: bytes = b""


def encode_flexitac(counts: NDArray[np.uint16], _number: int = 0, _t: float = 0.0) -> bytes:
    """Encode ``AA 55``, then one byte a cell, row-major; counts above 255 saturate."""
    return b"\xaa\x55" + np.minimum(counts, 255).astype(np.uint8).tobytes()


def encode_glove(
    counts: NDArray[np.uint16], number: int = 0, _t: float = 0.0, values: int = 32
) -> bytes:
    """Encode number + 11, each count's high and low half + 11, newline; larger counts saturate.

    ``values`` of a half: 32 or, with a 12-bit converter, 64.
    """
    counts = np.minimum(counts, values * values - 1)
    halves = np.stack([counts // values + 11, counts % values + 11], axis=-1)
    return bytes((11 + number % 244,)) + halves.astype(np.uint8).tobytes() + b"\n"


def encoder_for(backend: str, full_count: int) -> Encoder:
    """Return the framing of a backend's board whose largest count is ``full_count``."""
    if backend == "glove" and 1023 < full_count <= 4095:
        return Encoder(partial(encode_glove, values=64), b"a")
    return ENCODERS[backend]


ENCODERS = {
    "flexitac": Encoder(encode_flexitac),
    "glove": Encoder(encode_glove, b"a"),
    "cobs": Encoder(cobs.encode),
}
