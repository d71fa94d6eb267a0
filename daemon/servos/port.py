"""Provide an exclusive serial port for the SDK, with a monotonic deadline for each exchange.

:mod:`servos.protocol` lists the reasons why the SDK's own port is not used.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import time
from pathlib import Path

from dynamixel_sdk.port_handler import PortHandler

from softfinger.daemon.errors import ServoError
from softfinger.daemon.port_access import open_port

with contextlib.suppress(ModuleNotFoundError):  # On Windows, only simulated servos are supported.
    import termios

BITS_PER_BYTE = 10
# Reply timeout for setup and calibration, which run outside the loop [s]. A new servo has the
# factory return delay, and the adapter or the machine may be slow.
UNPACED_TIMEOUT = 0.5
_READ_SIZE = 4096
_SYSFS = Path("/sys/class/tty")


def latency_file(path: str, sysfs: Path = _SYSFS) -> Path | None:
    """Return the kernel file of an adapter's latency timer [ms], or None if it has no timer."""
    place = sysfs / Path(os.path.realpath(path)).name / "device" / "latency_timer"
    return place if place.exists() else None


class PortLost(ServoError):
    """The open port has disappeared because the adapter was unplugged or lost power."""


class SerialPort(PortHandler):  # type: ignore[misc]
    """An exclusive serial port for one thread.

    The reply timeout is ``reply_timeout`` seconds, or more if the transmission takes longer.
    ``received`` contains bytes that have not been decoded yet. ``deadline`` is the time at which
    the current exchange times out [s, time.monotonic()].
    """

    def __init__(
        self, path: str, baud: int, reply_timeout: float, low_latency: bool = True
    ) -> None:
        """Create a closed port. ``low_latency`` selects the low-latency mode of the adapter."""
        super().__init__(path)
        self._low_latency = low_latency
        self.baudrate = baud
        self.reply_timeout = reply_timeout
        self.received = bytearray()
        self.deadline = 0.0
        self._descriptor = -1
        self._sent = 0

    def openPort(self) -> bool:
        """Open the port exclusively. Raises ServoError with the reason and a fix."""
        self.ser = open_port(self.port_name, self.baudrate, "servos.port", ServoError)
        self._descriptor = self.ser.fileno()
        try:
            if self._low_latency:
                self.ser.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError, AttributeError):
            pass  # Pseudo-terminals and some adapters lack low-latency mode.
        self.received.clear()
        self.ser.reset_input_buffer()
        return True

    def closePort(self) -> None:
        """Close the port if it is open."""
        if self.ser is not None:
            self.ser.close()
        self._descriptor = -1

    def send(self, packet: bytes, reply: int = 0, until: float = math.inf) -> bool:
        """Send a packet; return True if it was completely sent.

        ``reply`` is the expected length of the reply. If a reply is expected, older input is
        discarded before sending. The reply deadline is ``until`` [s, time.monotonic()] or earlier.
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
        """Set the deadline for a reply of ``packet_length`` bytes."""
        wire = (packet_length + self._sent) * BITS_PER_BYTE / self.baudrate
        # At low baud rates, allow twice the transmission time plus the return delays.
        self.deadline = time.monotonic() + max(self.reply_timeout, 2.0 * wire + 0.001)

    def fill(self) -> bool:
        """Wait for bytes and append them to ``received``; return False if the deadline passes."""
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

    def _gone(self, error: object) -> PortLost:
        return PortLost(
            f"{self.port_name}: the port is lost ({error}): connect the adapter and switch on the "
            "servo supply"
        )
