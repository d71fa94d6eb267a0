"""Emulate a tactile board that sends the simulated sensor's frames over a pty.

The functions in `ENCODERS` convert counts to the wire format of a board.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import termios
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.emulator.pty_bus import PtyPort
from softfinger.daemon.simulation.faults import BOARD_FAULTS, WELL
from softfinger.daemon.simulation.simulated_tactile import SimulatedTactile
from softfinger.daemon.tactile import cobs
from softfinger.daemon.tactile.glove import bits_of
from softfinger.daemon.types import Frame

# Maximum number of unread bytes. A tty reports at most 4095 unread bytes, so this limit must be
# lower.
_TTY_SIZE_MAX = 2048
_DRAIN = 4096
_NOISE_LENGTH = 64  # maximum length of a noise burst between frames [bytes]


class FrameWriter(PtyPort):
    """The board's end of a pty. Frames are sent completely or not at all.

    A pty buffers tens of kilobytes. If no client reads, frames are dropped long before this buffer
    is full. The next client therefore receives no old frames.
    """

    def __init__(self) -> None:
        super().__init__()
        self.dropped = 0  # frames
        self._unread = array.array("i", [0])

    def plug(self) -> None:
        """Create or recreate the terminal at a new ``path``."""
        super().plug()
        self._remaining = b""  # unsent part of the last frame

    def send(self, frame: bytes) -> bool:
        """Write one frame, or drop it if the client has not read earlier frames."""
        if not self.flush() or self._unread_bytes() > min(len(frame), _TTY_SIZE_MAX):
            self.dropped += 1
            return False
        self._remaining = frame
        self.flush()
        return True

    def flush(self) -> bool:
        """Write the unsent part of the last frame, and return True if no bytes remain."""
        if self._remaining:
            with contextlib.suppress(BlockingIOError):
                self._remaining = self._remaining[os.write(self._master, self._remaining) :]
        return not self._remaining

    def _unread_bytes(self) -> int:
        fcntl.ioctl(self._slave, termios.FIONREAD, self._unread)
        return self._unread[0]


class TactileBoard(FrameWriter):
    """Emulated board that sends each new frame from ``source`` over a pty.

    A board that waits for requests sends one frame per request. ``faults`` maps each active fault
    to its probability:

    - ``torn``: a sequence of bytes is missing from a frame.
    - ``noisy``: random bytes precede a frame, and one byte of the frame is wrong.
    - ``silent``: the board sends no frames.
    - ``frozen``: the board repeats its last frame.
    - ``wrong-size``: the grid has half as many rows and columns.
    - ``saturated``: all cells read the maximum count.
    - ``zero``: all cells read 0.

    Only ``torn`` and ``noisy`` use the probability. The other faults affect every frame.
    """

    def __init__(
        self,
        source: SimulatedTactile,
        encoder: Encoder,
        seed: int = 1,
    ) -> None:
        """Create a board that sends the frames of ``source``. ``seed`` determines the faults."""
        super().__init__()
        self.source = source
        self._encoder = encoder
        self._requested = not encoder.request
        self.faults: dict[str, float] = {}
        self._random = np.random.default_rng(seed)
        self._seq = -1  # number of the last frame
        self._frozen: NDArray[np.uint16] | None = None  # image that a frozen board repeats
        self.sent = 0  # frames

    def apply_fault(self, kind: str, value: float, t: float) -> None:
        """Begin a fault of the port or the board; the kinds ``plug`` and ``well`` end faults."""
        super().apply_fault(kind, value, t)
        if kind == WELL:
            self.faults.clear()
        elif kind in BOARD_FAULTS:
            self.faults[kind] = value

    def hear(self) -> None:
        """Read the bytes from the client, which may request a frame."""
        with contextlib.suppress(OSError):  # No bytes are available, or the port is unplugged.
            written = os.read(self._master, _DRAIN)
            if self._encoder.request and self._encoder.request in written:
                self._requested = True

    def next_event(self) -> float:
        """Return the time [s] at which :meth:`service` must be called next."""
        return self.source.next_arrival

    def service(self) -> None:
        """Send the newest frame if it has not been sent yet."""
        if self.plugged:
            self.flush()
        frame = self.source.latest()
        if frame is None or frame.seq == self._seq:
            return
        self._seq = frame.seq
        if not self._requested or not self.plugged:
            return
        data = self._spoil(frame)
        if data:
            self._requested = not self._encoder.request
            self.sent += self.send(data)

    def _spoil(self, frame: Frame) -> bytes:
        counts, faults = frame.data, self.faults
        if "silent" in faults:
            return b""
        if "frozen" in faults:
            counts = counts if self._frozen is None else self._frozen
        self._frozen = counts
        if "saturated" in faults:
            counts = np.full_like(counts, np.iinfo(counts.dtype).max)  # The encoder clips them.
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


class Encoder(NamedTuple):
    """Encoder of a board's frames, and the byte that requests a frame, if any."""

    # Arguments: counts [rows, cols], scan number and board time [s].
    encode: Callable[[NDArray[np.uint16], int, float], bytes]
    request: bytes = b""


def encode_flexitac(counts: NDArray[np.uint16], _number: int = 0, _t: float = 0.0) -> bytes:
    """Encode a frame as ``AA 55`` and one byte per cell, row by row. Counts above 255 saturate."""
    return b"\xaa\x55" + np.minimum(counts, 255).astype(np.uint8).tobytes()


def encode_glove(
    counts: NDArray[np.uint16], number: int = 0, _t: float = 0.0, values: int = 32
) -> bytes:
    """Encode a frame of a glove-style board as a scan number, the counts and a newline.

    Each count is split into a high half and a low half. A half ranges from 0 to ``values`` − 1.
    ``values`` is 64 for boards with a 12-bit converter and 32 for other boards. The scan number and
    the halves are offset by 11. Counts that are too large saturate.
    """
    counts = np.minimum(counts, values * values - 1)
    halves = np.stack([counts // values + 11, counts % values + 11], axis=-1)
    return bytes((11 + number % 244,)) + halves.astype(np.uint8).tobytes() + b"\n"


def encoder_for(backend: str, full_count: int) -> Encoder:
    """Return the encoder for a backend's board; ``full_count`` is the board's maximum count."""
    if backend == "glove":
        return Encoder(partial(encode_glove, values=1 << bits_of(full_count)), b"a")
    return ENCODERS[backend]


ENCODERS = {
    "flexitac": Encoder(encode_flexitac),
    "glove": Encoder(encode_glove, b"a"),
    "cobs": Encoder(cobs.encode),
}
