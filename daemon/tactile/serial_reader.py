"""The thread that reads a tactile board's serial port and hands over its newest complete frame.

Shared by every framing that comes over a serial port. A framing is a :class:`Decoder`, a pure
incremental class; this module owns what a decoder must not know: the port, the thread, the time.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import serial
from numpy.typing import NDArray

from softfinger.daemon.errors import TactileError
from softfinger.daemon.loop.clock import Clock
from softfinger.daemon.types import Frame

_CHUNK = 65536  # bytes taken at once: all that a Linux tty can hold
BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_SHORTEST_WAIT = 3e-4  # s; below this a timed wait costs more than the wake-ups it saves
_LONGEST_WAIT = 2e-3  # s; bounds what a wrong guess of the missing bytes can delay


@dataclass(slots=True)
class Decoded:
    """A frame out of a decoder: fresh counts [rows, cols] and the time of its last byte [s]."""

    data: NDArray[np.uint16]
    t: float
    steps: int = 1  # frames since the last one by the board's own number
    t_sensor: float | None = None  # the board's clock at the middle of the scan [s]
    behind: int = 0  # bytes that came behind its last one in the same read


class Decoder(Protocol):
    """A framing: bytes in, frames out. Pure: no port, no clock, no thread.

    ``frame_bytes`` is a frame's length on the wire; the last one's where lengths vary.
    """

    frame_bytes: int

    def feed(self, data: bytes, t: float) -> Decoded | None:
        """Take the next bytes, read at time ``t`` [s]; the newest frame they completed, if any."""

    def settle(self) -> Decoded | None:
        """The line has been quiet since the last byte: a frame that only waited for more bytes."""

    @property
    def pending(self) -> bool:
        """A whole frame is held back and ``settle`` may free it."""

    @property
    def missing(self) -> int:
        """Bytes until the frame in hand is whole; 0 when that is unknown."""

    @property
    def lost(self) -> bool:
        """Frames came once, and now for many frames' worth of bytes none could be found."""

    def counters(self) -> dict[str, int]:
        """What was decoded and what went wrong, since the decoder was made."""

    def diagnosis(self) -> str:
        """What is wrong with a stream that gives no frames, in one line."""


class SensorClock:
    """From a board's clock to ours: frames are late by varying times, never early.

    So the least delay of late tells the offset, and t_sample doesn't jitter with the port. The
    offset may rise by 200 ppm, more than two quartzes differ; a board that started anew is seen by
    a jump of more than a second.
    """

    _DRIFT = 2e-4
    _JUMP = 1.0  # s

    def __init__(self) -> None:
        self._offset = 0.0
        self._t = -math.inf

    def arrival(self, t_sensor: float, t: float) -> float:
        """When the frame of ``t_sensor`` [s], read at ``t`` [s], would have come undelayed [s]."""
        offset = t - t_sensor
        risen = self._offset + self._DRIFT * (t - self._t)
        self._offset = offset if abs(offset - risen) > self._JUMP else min(offset, risen)
        self._t = t
        return t_sensor + self._offset


class SerialReader:
    """Reads one port in a thread of its own. The whole of a backend but for its framing.

    Times: a frame's ``t_arrival`` is when its last byte was read. ``t_sample`` is the middle of the
    board's scan as well as it can be known: ``t_arrival`` less the time that the frame's bytes, and
    those behind it in the same read, take on the wire, less ``latency`` [s], from the middle of the
    scan to the frame's first byte; never before the last frame's. Where frames carry the board's
    time, the least delayed of late ones stands for ``t_arrival`` in it.

    A board that must be asked is asked with ``request`` at first, after each frame, and again when
    none came for ``patience`` [s] longer than its bytes take.

    ``latest`` may be called from any thread. Its frame's array is fresh for each frame and is never
    written again. When the port is gone, or the stream can't be read any more, one last frame with
    ``valid`` False and the old data is handed over.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        make_decoder: Callable[[], Decoder],
        clock: Clock,
        latency: float,
        open_timeout: float,
        settle: float = 5e-4,
        request: bytes = b"",
        patience: float = 0.1,
    ) -> None:
        """``settle`` [s]: how long the line must be quiet to be taken for a gap between frames."""
        self._path = port
        self._baud = baud
        self._make_decoder = make_decoder
        self._decoder = make_decoder()
        self._clock = clock
        self._settle = settle
        self._byte_time = BITS_PER_BYTE / baud
        self._latency = latency
        self._request = request
        self._patience = patience
        self._sensor_clock = SensorClock()
        self._open_timeout = open_timeout
        self._latest: Frame | None = None
        self._seq = 0
        self._bytes = 0
        self._error = ""
        self._gone = False
        self._event = threading.Event()  # a first frame, or the port's end
        self._thread: threading.Thread | None = None
        self._port: serial.Serial | None = None
        self._stop: tuple[int, int] | None = None

    def open(self) -> None:
        """Open the port, start reading, wait for a good frame; TactileError tells what is wrong."""
        if self._port is not None:
            raise TactileError(f"{self._path}: is open already")
        self._decoder = self._make_decoder()
        self._sensor_clock = SensorClock()
        self._latest, self._bytes = None, 0
        self._event.clear()
        self._port = open_port(self._path, self._baud)
        self._error, self._gone = "", False
        self._stop = os.pipe()
        self._thread = threading.Thread(
            target=self._run,
            args=(self._port.fileno(), self._stop[0]),
            name=f"tactile {self._path}",
            daemon=True,
        )
        self._thread.start()
        self._event.wait(self._open_timeout)
        if self._latest is None or not self._latest.valid:
            trouble = self._trouble()
            self.close()
            self._gone = True
            raise TactileError(f"{self._path}: {trouble}")

    def latest(self) -> Frame | None:
        """The newest complete frame, the same object until a newer came; None before the first."""
        return self._latest

    def counters(self) -> dict[str, int]:
        """``bytes`` read, the framing's own counters, and ``port_lost``.

        That is 1 from when the port was lost until it is open again and frames come.
        """
        return {
            "bytes": self._bytes,
            "port_lost": int(self._gone),
            **self._decoder.counters(),
        }

    @property
    def error(self) -> str:
        """Why no frames come any more (port gone, stream unreadable); empty while they do."""
        return self._error

    def close(self) -> None:
        """Stop the thread and close the port. Never raises; more than once is fine."""
        stop, thread, port = self._stop, self._thread, self._port
        self._stop = self._thread = self._port = None
        if stop is not None:
            with contextlib.suppress(OSError):
                os.write(stop[1], b"x")
        if thread is not None:
            thread.join()
        if port is not None:
            with contextlib.suppress(OSError, serial.SerialException):
                port.close()
        if stop is not None:
            for end in stop:
                with contextlib.suppress(OSError):
                    os.close(end)

    def _trouble(self) -> str:
        if self._gone:
            return self._error
        if self._bytes == 0:
            return (
                f"no byte came within {self._open_timeout:g} s; is the board powered, is it this "
                f"port, does it talk at {self._baud} baud?"
            )
        return f"{self._bytes} bytes within {self._open_timeout:g} s, {self._decoder.diagnosis()}"

    def _run(self, port: int, stop: int) -> None:
        """The thread: waits in the kernel, wakes once or twice a frame."""
        decoder = self._decoder
        timeout = self._ask(port)
        while True:
            ready, _, _ = select.select((port, stop), (), (), timeout)
            if stop in ready:
                return None
            if not ready:
                self._hand_over(decoder.settle())
                timeout = self._ask(port)
                continue
            timeout = None
            try:
                data = os.read(port, _CHUNK)
            except BlockingIOError:
                continue
            except OSError as error:
                return self._end(f"the port is gone ({os.strerror(error.errno or errno.EIO)})")
            if not data:
                return self._end("the port is gone (it reports data and has none)")
            self._bytes += len(data)
            decoded = decoder.feed(data, self._clock.now())
            self._hand_over(decoded)
            if self._request:
                timeout = self._wait if decoded is None else self._ask(port)
            if decoder.lost and not self._error:
                self._invalidate(decoder.diagnosis())
            if decoder.pending:
                timeout = self._settle
            wait = decoder.missing * self._byte_time
            # The rest of this frame is on its way: wait for its end instead of for its next byte.
            if (
                wait > _SHORTEST_WAIT
                and select.select((stop,), (), (), min(wait, _LONGEST_WAIT))[0]
            ):
                return None

    @property
    def _wait(self) -> float:
        return self._decoder.frame_bytes * self._byte_time + self._patience

    def _ask(self, port: int) -> float | None:
        """Ask for a frame where the board wants that; how long to wait for it [s]."""
        if not self._request:
            return None
        with contextlib.suppress(OSError):  # a port that is gone tells so when it is read
            os.write(port, self._request)
        return self._wait

    def _hand_over(self, decoded: Decoded | None) -> None:
        if decoded is None:
            return
        self._seq += decoded.steps
        whole = decoded.t - decoded.behind * self._byte_time
        if decoded.t_sensor is not None:
            whole = self._sensor_clock.arrival(decoded.t_sensor, whole)
        sampled = whole - self._decoder.frame_bytes * self._byte_time - self._latency
        if self._latest is not None:
            sampled = max(sampled, self._latest.t_sample)
        self._latest = Frame(self._seq, sampled, decoded.t, True, decoded.data)
        self._error = ""
        self._event.set()

    def _invalidate(self, why: str) -> None:
        self._error = why
        old = self._latest
        if old is not None and old.valid:
            self._seq += 1
            self._latest = Frame(self._seq, old.t_sample, old.t_arrival, False, old.data)

    def _end(self, why: str) -> None:
        self._gone = True
        self._invalidate(why)
        self._event.set()


def open_port(path: str, baud: int) -> serial.Serial:
    """Open ``path`` for this process alone, raw, eight data bits, no parity; else TactileError."""
    try:
        return serial.Serial(path, baud, timeout=0, exclusive=True)
    except serial.SerialException as error:
        number = error.errno
        if number == errno.ENOENT:
            why = "no such port; is the board plugged in?"
        elif number in (errno.EACCES, errno.EPERM):
            why = "no permission to open it; is this user in the group that owns the port?"
        elif number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
            why = "busy: another program uses this port"
        else:
            why = f"can't be opened as a serial port ({error})"
    except (OSError, ValueError) as error:
        why = f"can't be opened as a serial port ({error})"
    raise TactileError(f"{path}: {why}")
