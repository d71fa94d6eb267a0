"""Read a tactile board's serial port in a thread, and provide the newest complete frame.

This module handles the port, the thread and the timing for all serial framings. A :class:`Decoder`
handles only the bytes of one framing.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import threading

import serial

from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import TactileError
from softfinger.daemon.port_access import open_port
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile.decoder import Decoded, Decoder
from softfinger.daemon.types import Frame

__all__ = ["SerialReader"]

_READ_SIZE = 65536  # maximum number of bytes per read, equal to the buffer size of a Linux tty
BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_GAP_TIME = 5e-4  # time without a byte that counts as a gap between frames [s]
# A request is repeated after this time [s] plus the transmission time of a frame.
_REQUEST_TIMEOUT = 0.1
_WAIT_MIN = 3e-4  # minimum wait [s]; shorter waits cost more than the wake-ups they avoid
_WAIT_MAX = 2e-3  # maximum wait [s], which limits the delay if the number of missing bytes is wrong


class SensorClock:
    """Converter from a board's clock to the local clock, based on the minimum recent delay.

    Frames may arrive late but never early. Using the minimum delay therefore removes port jitter
    from ``t_sample``. The offset between the clocks may increase at up to 200 ppm, which is faster
    than two quartz clocks drift apart. A jump in the offset of more than one second is treated as a
    board restart.
    """

    _DRIFT = 2e-4
    _JUMP = 1.0  # s

    def __init__(self) -> None:
        self._offset = 0.0
        self._t = -math.inf

    def arrival(self, t_sensor: float, t: float) -> float:
        """Return a frame's arrival time [s] without jitter.

        ``t_sensor`` [s] is the frame's board time, and ``t`` [s] is the local time at which the
        frame was read.
        """
        offset = t - t_sensor
        risen = self._offset + self._DRIFT * (t - self._t)
        self._offset = offset if abs(offset - risen) > self._JUMP else min(offset, risen)
        self._t = t
        return t_sensor + self._offset


class SerialReader:
    """Backend for a board on a serial port; subclasses provide the framing.

    A frame's ``t_arrival`` is the time at which its last byte was read. ``t_sample`` estimates the
    mid-scan time. The reader subtracts the transmission time of the frame, and of later bytes in
    the same read, from ``t_arrival``. The reader also subtracts ``latency`` [s], the time from
    mid-scan to the frame's first byte. ``t_sample`` never decreases from frame to frame. If frames
    contain the board time, :class:`SensorClock` removes port jitter.

    The reader sends ``request`` to a polled board at the start and after each frame. If no frame
    arrives within its transmission time plus 0.1 s, the reader repeats the request.

    ``latest`` may be called from any thread. Each frame has its own array, which is never modified.
    If the port is lost or the stream becomes unreadable, the reader repeats the last data in a
    frame with ``valid`` False.
    """

    request = b""

    def __init__(self, settings: TactileSettings, clock: Clock, finger: int) -> None:
        """Create a reader without opening its port; ``finger`` selects the port (0 is left)."""
        self.settings = settings
        self._path = settings.port[finger]
        self._decoder = self.make_decoder()
        self._clock = clock
        self._byte_time = BITS_PER_BYTE / settings.baud
        self._sensor_clock = SensorClock()
        self._latest: Frame | None = None
        self._seq = 0
        self._bytes = 0
        self.error = ""  # reason why no frames arrive; empty while frames arrive
        self._port_lost = False
        self._event = threading.Event()  # set at the first frame or when the port is lost
        self._thread: threading.Thread | None = None
        self._port: serial.Serial | None = None
        self._stop: tuple[int, int] | None = None

    def make_decoder(self) -> Decoder:
        """Create a decoder for the board's framing.

        The reader calls this method each time it opens the port.
        """
        raise NotImplementedError

    def open(self) -> None:
        """Open the port, start reading, and wait for a valid frame. Raises TactileError."""
        if self._port is not None:
            raise TactileError(f"{self._path}: is already open")
        self._decoder = self.make_decoder()
        self._sensor_clock = SensorClock()
        self._latest, self._bytes = None, 0
        self._event.clear()
        self._port = open_port(self._path, self.settings.baud, "tactile.port", TactileError)
        self.error, self._port_lost = "", False
        self._stop = os.pipe()
        self._thread = threading.Thread(
            target=self._run,
            args=(self._port.fileno(), self._stop[0]),
            name=f"tactile {self._path}",
            daemon=True,
        )
        self._thread.start()
        self._event.wait(self.settings.open_timeout)
        if self._latest is None or not self._latest.valid:
            trouble = self._problem()
            self.close()
            self._port_lost = True
            raise TactileError(f"{self._path}: {trouble}")

    def latest(self) -> Frame | None:
        """Return the newest complete frame, or None before the first frame.

        The same object is returned until a newer frame arrives.
        """
        return self._latest

    def counters(self) -> dict[str, int]:
        """Return the decoder's counters, ``bytes`` (read so far) and ``port_lost`` (0 or 1)."""
        return {
            "bytes": self._bytes,
            "port_lost": int(self._port_lost),
            **self._decoder.counters(),
        }

    def close(self) -> None:
        """Stop the thread and close the port.

        ``close`` never raises an exception and may be called repeatedly.
        """
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

    def _problem(self) -> str:
        if self._port_lost:
            return self.error
        within = f"within tactile.open_timeout = {self.settings.open_timeout:g} s"
        if self._bytes == 0:
            return (
                f"no data {within}: check the board's power supply, tactile.port and tactile.baud "
                f"= {self.settings.baud}"
            )
        return f"no valid frame in {self._bytes} bytes {within}: {self._decoder.diagnosis()}"

    def _run(self, port: int, stop: int) -> None:
        """Read frames in the reader thread, which blocks in the kernel between reads."""
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
            try:
                data = os.read(port, _READ_SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                return self._end(f"the port is lost ({os.strerror(error.errno or errno.EIO)})")
            if not data:
                return self._end("the port is lost (it signals data, but a read returns nothing)")
            self._bytes += len(data)
            decoded = decoder.feed(data, self._clock.now())
            self._hand_over(decoded)
            if decoder.lost and not self.error:
                self._invalidate(decoder.diagnosis())
            if decoder.pending:
                timeout = _GAP_TIME
            else:
                timeout = self._request_timeout if decoded is None else self._ask(port)
            wait = decoder.missing * self._byte_time
            # The board is sending the remaining bytes, so wait for the end of the frame rather than
            # for the next byte.
            if wait > _WAIT_MIN and select.select((stop,), (), (), min(wait, _WAIT_MAX))[0]:
                return None

    @property
    def _request_timeout(self) -> float | None:
        """Maximum waiting time for a requested frame [s]; None for boards that are not polled."""
        if not self.request:
            return None
        return self._decoder.frame_bytes * self._byte_time + _REQUEST_TIMEOUT

    def _ask(self, port: int) -> float | None:
        """Request a frame from a polled board; return the maximum waiting time [s]."""
        if self.request:
            with contextlib.suppress(OSError):  # The next read will report a lost port.
                os.write(port, self.request)
        return self._request_timeout

    def _hand_over(self, decoded: Decoded | None) -> None:
        if decoded is None:
            return
        self._seq += decoded.steps
        whole = decoded.t - decoded.behind * self._byte_time
        if decoded.t_sensor is not None:
            whole = self._sensor_clock.arrival(decoded.t_sensor, whole)
        sampled = whole - self._decoder.frame_bytes * self._byte_time - self.settings.latency
        if self._latest is not None:
            sampled = max(sampled, self._latest.t_sample)
        self._latest = Frame(self._seq, sampled, decoded.t, True, decoded.data)
        self.error = ""
        self._event.set()

    def _invalidate(self, why: str) -> None:
        self.error = why
        old = self._latest
        if old is not None and old.valid:
            self._seq += 1
            self._latest = Frame(self._seq, old.t_sample, old.t_arrival, False, old.data)

    def _end(self, why: str) -> None:
        self._port_lost = True
        self._invalidate(why)
        self._event.set()
