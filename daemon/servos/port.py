"""The SDK's port over pyserial, exclusive, with a monotonic deadline for each exchange.

Why the SDK's own port is not used is listed in :mod:`servos.protocol`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import time
from pathlib import Path

import serial
from dynamixel_sdk.port_handler import PortHandler

from softfinger.daemon.errors import ServoError
from softfinger.daemon.port_access import bring_it, grant

with contextlib.suppress(ModuleNotFoundError):  # Windows: simulated servos alone
    import termios

BITS_PER_BYTE = 10
# s for a reply where nothing hurries (setting up, calibrating): a factory-new servo with its return
# delay, behind a slow adapter, on a busy machine.
UNHURRIED = 0.5
_READ_SIZE = 4096
_SYSFS = Path("/sys/class/tty")


def latency_file(path: str, sysfs: Path = _SYSFS) -> Path | None:
    """Return where the kernel keeps a USB adapter's latency timer [ms]; None where it has none."""
    place = sysfs / Path(os.path.realpath(path)).name / "device" / "latency_timer"
    return place if place.exists() else None


class PortGone(ServoError):
    """The port went away while it was open: adapter unplugged, or its power lost."""


class SerialPort(PortHandler):  # type: ignore[misc]
    """An exclusive serial port for one thread.

    A reply may take ``reply_timeout`` seconds, and more only where the bytes alone take longer on
    the wire. ``received`` holds bytes that came and are not taken as a packet yet, ``deadline``
    the time.monotonic() at which the exchange under way ends.
    """

    def __init__(
        self, path: str, baud: int, reply_timeout: float, low_latency: bool = True
    ) -> None:
        """``low_latency``: ask an adapter for its low-latency mode when the port is opened."""
        super().__init__(path)
        self._low_latency = low_latency
        self.baudrate = baud
        self.reply_timeout = reply_timeout
        self.received = bytearray()
        self.deadline = 0.0
        self._descriptor = -1
        self._sent = 0

    def openPort(self) -> bool:
        """Open the port exclusively. Raises ServoError with the reason and its fix."""
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
            pass  # a pseudo-terminal or an adapter without that mode; see latency_file()
        self.received.clear()
        self.ser.reset_input_buffer()
        return True

    def closePort(self) -> None:
        """Close the port; harmless when it is closed."""
        if self.ser is not None:
            self.ser.close()
        self.is_open = False
        self._descriptor = -1

    def send(self, packet: bytes, reply: int = 0, until: float = math.inf) -> bool:
        """Send a packet; whether all of it went out.

        With ``reply`` bytes to come, older input is dropped first, so that it isn't taken for the
        answer, and their deadline starts, not later than ``until`` [s, time.monotonic()].
        """
        remaining = packet
        try:
            if reply:
                self.received.clear()
                termios.tcflush(self._descriptor, termios.TCIFLUSH)
            while remaining:
                remaining = remaining[os.write(self._descriptor, remaining) :]
        except BlockingIOError:
            return False
        except (termios.error, OSError, ValueError) as error:
            raise self._gone(error) from None
        if reply:
            self._sent = len(packet)
            self.setPacketTimeout(reply)
            if self.deadline > until:
                self.deadline = until
        return True

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the deadline of a reply of so many bytes."""
        wire = (packet_length + self._sent) * BITS_PER_BYTE / self.baudrate
        # Where a slow rate alone eats the deadline: twice the wire's time and the return delays.
        self.deadline = time.monotonic() + max(self.reply_timeout, 2.0 * wire + 0.001)

    def fill(self) -> bool:
        """Wait for bytes into ``received``; False when the deadline came first."""
        try:
            remaining = max(0.0, self.deadline - time.monotonic())
            if not select.select((self._descriptor,), (), (), remaining)[0]:
                return False
            data = os.read(self._descriptor, _READ_SIZE)
        except (OSError, ValueError) as error:
            raise self._gone(error) from None
        if not data:
            raise self._gone(OSError(errno.EIO, "hung up"))
        self.received += data
        return True

    def _gone(self, error: object) -> PortGone:
        return PortGone(
            f"{self.port_name}: the port is gone ({error}): plug the adapter in and power the bus"
        )


def _why_not(path: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT or not Path(path).exists():
        return (
            f"{path}: no such port: {bring_it(path)}, or set servos.port; "
            "`softfinger doctor` lists the ports there are"
        )
    if code == errno.EACCES:
        return f"{path}: no permission: {grant(path)}"
    if code in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK) or "lock" in str(error).lower():
        return f"{path}: the port is in use by another process: end that one first"
    return f"{path}: can't be opened: {error}"
