"""The SDK's port over pyserial, with its traps closed; nothing about packets' meaning.

The SDK's own port handler spins on non-blocking reads, measures its deadline on the wall clock,
adds 34 ms to it, and opens a port that another process already uses. Here a read blocks until
bytes come or a monotonic deadline of a few milliseconds is over, and the port is exclusive.
"""

from __future__ import annotations

import errno
import math
import os
import select
import termios
import time
from pathlib import Path
from typing import Any

import serial
from dynamixel_sdk.port_handler import PortHandler

from softfinger.daemon.errors import ServoError

BITS_PER_BYTE = 10
_READ_SIZE = 4096
_SYSFS = Path("/sys/class/tty")


class PortGone(ServoError):
    """The port went away while it was open: adapter unplugged, or its power lost."""


class SerialPort(PortHandler):  # type: ignore[misc]
    """An exclusive serial port with a deadline for each exchange.

    The deadline is ``reply_timeout`` seconds, and more only where the bytes alone take longer on
    the wire. One owner, one thread; the SDK's ``is_using`` flag stays False.
    """

    def __init__(
        self, path: str, baud: int, reply_timeout: float, low_latency: bool = True
    ) -> None:
        """``low_latency``: ask an adapter for its low-latency mode when the port is opened."""
        super().__init__(path)
        self._low_latency = low_latency
        self.baudrate = baud
        self.reply_timeout = reply_timeout
        self.received = bytearray()  # bytes that came and were not yet taken as a packet
        self._descriptor = -1
        self.deadline = 0.0  # of the exchange under way, time.monotonic()
        self.not_after = math.inf  # no deadline is set later than this
        self._sent = 0

    # --- opening -----------------------------------------------------------------------------

    def openPort(self) -> bool:
        """Open the port exclusively. Raises ServoError with the reason and what mends it."""
        return self.setupPort(self.baudrate)

    def setBaudRate(self, baudrate: int) -> bool:
        """Set the rate, any that the port takes, without closing an open port."""
        self.baudrate = baudrate
        if self.ser is not None and self.ser.is_open:
            self.ser.baudrate = baudrate
            return True
        return self.setupPort(baudrate)

    def setupPort(self, cflag_baud: int) -> bool:
        path = self.port_name
        try:
            self.ser = serial.Serial(path, self.baudrate, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            raise ServoError(_why_not(path, error)) from None
        self.is_open = True
        self._descriptor = self.ser.fileno()
        try:
            if self._low_latency:
                self.ser.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError, AttributeError):
            pass  # a pseudo-terminal or an adapter without that mode; latency_timer() tells
        self.received.clear()
        self.ser.reset_input_buffer()
        return True

    def closePort(self) -> None:
        """Close the port; harmless when it is closed."""
        if self.ser is not None:
            self.ser.close()
        self.is_open = False
        self._descriptor = -1

    def latency_timer(self) -> float:
        """The USB adapter's latency timer [s], 0 where there is none."""
        name = Path(os.path.realpath(self.port_name)).name
        try:
            return int((_SYSFS / name / "device" / "latency_timer").read_text()) / 1000.0
        except (OSError, ValueError):
            return 0.0

    # --- bytes -------------------------------------------------------------------------------

    def clearPort(self) -> None:
        """Throw away what came unasked, so that an old reply is not taken for a new one."""
        self.received.clear()
        try:
            termios.tcflush(self._descriptor, termios.TCIFLUSH)
        except (termios.error, OSError, ValueError) as error:
            raise self._gone(error) from None

    def writePort(self, packet: Any) -> int:
        """Send a packet; the number of its bytes."""
        data = bytes(packet)
        rest = data
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except BlockingIOError:
            return len(data) - len(rest)
        except OSError as error:
            raise self._gone(error) from None
        self._sent = len(data)
        return len(data)

    def readPort(self, length: int) -> bytes:
        """Up to ``length`` bytes, at once as many as there are; none once the deadline is over."""
        if not self.received:
            self.fill()
        taken = bytes(self.received[:length])
        del self.received[: len(taken)]
        return taken

    def fill(self) -> bool:
        """Wait for bytes into ``received``; False when the deadline came first."""
        try:
            rest = max(0.0, self.deadline - time.monotonic())
            if not select.select((self._descriptor,), (), (), rest)[0]:
                return False
            data = os.read(self._descriptor, _READ_SIZE)
        except (OSError, ValueError) as error:
            raise self._gone(error) from None
        if not data:
            raise self._gone(OSError(errno.EIO, "hung up"))
        self.received += data
        return True

    def getBytesAvailable(self) -> int:
        """How many bytes wait."""
        return len(self.received) + int(self.ser.in_waiting)

    # --- deadline ----------------------------------------------------------------------------

    def getCurrentTime(self) -> float:
        """Monotonic milliseconds, the SDK's unit."""
        return time.monotonic() * 1000.0

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the deadline of a reply of so many bytes."""
        wire = (packet_length + self._sent) * BITS_PER_BYTE / self.baudrate
        # Where a slow rate alone eats the deadline: twice the wire's time and the return delays.
        allowed = max(self.reply_timeout, 2.0 * wire + 0.001)
        self.deadline = min(time.monotonic() + allowed, self.not_after)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a deadline of so many milliseconds."""
        self.deadline = time.monotonic() + msec / 1000.0

    def isPacketTimeout(self) -> bool:
        """Whether the deadline is over."""
        return time.monotonic() >= self.deadline

    def _gone(self, error: object) -> PortGone:
        return PortGone(
            f"{self.port_name}: the port is gone ({error}): plug the adapter in and power the bus"
        )


def _why_not(path: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT or not Path(path).exists():
        return (
            f"{path}: no such port: plug the adapter in, or set servos.port; "
            "`softfinger doctor` lists the ports there are"
        )
    if code == errno.EACCES:
        return f"{path}: no permission: `sudo usermod -aG dialout $USER`, then log in again"
    if code in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK) or "lock" in str(error).lower():
        return f"{path}: the port is in use by another process: end that one first"
    return f"{path}: can't be opened: {error}"
