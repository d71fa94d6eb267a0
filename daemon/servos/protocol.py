"""Implement the client side of Protocol 2.0: port, packets, group exchanges and single servos.

This module overrides the following behaviour of the SDK (3.7.31 to 4.1.0). All other SDK functions
are used unchanged.

- ``txPacket`` discards the stuffed packet, so the sequence FF FF FD in a goal is sent without
  stuffing and is misinterpreted.
- ``removeStuffing`` drops a byte of the sequence FF FF FD 12 FF FD FD. In tests, 3 to 8 % of group
  reads failed.
- ``rxPacket`` polls with non-blocking reads, which keeps a processor busy during transmission.
- ``txPacket`` leaves ``is_using`` set if the port raises, so all later calls return −1000.
- ``readTxRx`` accepts replies with a wrong length, so the CRC of a late reply is returned as data.
- ``GroupSyncRead`` discards the servos' error bytes and returns 0 after a failure. As a result,
  alerts are lost, and the joint appears to be at position 0.
- ``broadcastPing`` always waits for 253 servos, which takes 0.8 s at 1 Mbaud.
- ``PortHandler`` measures deadlines with the wall clock and adds 34 ms. A missing servo therefore
  causes a delay of 35 ms. Adjusting the system clock changes the deadline. ``PortHandler`` also
  opens ports that are in use by another process.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import struct
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from dynamixel_sdk import robotis_def as sdk
from dynamixel_sdk.port_handler import PortHandler
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler

from softfinger.daemon.errors import ServoError
from softfinger.daemon.port_access import open_port
from softfinger.daemon.servos.control_table import crc16

with contextlib.suppress(ModuleNotFoundError):  # On Windows, only simulated servos are supported.
    import termios

BITS_PER_BYTE = 10
# Reply timeout for setup and calibration, which run outside the loop [s]. A new servo has the
# factory return delay, and the adapter or the machine may be slow.
UNPACED_TIMEOUT = 0.5
TRY_COUNT = 3  # number of attempts per exchange outside the tick
_READ_SIZE = 4096
_HEADER = b"\xff\xff\xfd"
_PREFIX = _HEADER + b"\x00"
_STUFFED = _HEADER + b"\xfd"
_MAX_PACKET = 1024
_STATUS_SIZE = 11  # length of a status packet without data [bytes]
_FAST_SYNC_READ = 0x8A  # dynamixel-sdk 3 does not define this instruction
_OLD_HEADER = b"\xff\xff"  # Protocol 1.0: header, ID, length, instruction or error, checksum
_OLD_STATUS = 6  # length of a ping reply in Protocol 1.0 [bytes]
_OLD_TIMEOUT = 0.5  # timeout [s]; on a busy machine, an emulated servo may take longer than 0.1 s
_ERROR_MASK = 0x7F  # mask of the error code in the error byte; the highest bit is the alert bit


# --- port -----------------------------------------------------------------------------------------


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


# --- packets --------------------------------------------------------------------------------------


def packed(packet_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a complete packet with byte stuffing and CRC."""
    body = bytes((instruction,)) + parameters
    if _HEADER in body:
        body = body.replace(_HEADER, _STUFFED)
    packet = _PREFIX + struct.pack("<BH", packet_id, len(body) + 2) + body
    return packet + crc16(packet).to_bytes(2, "little")


class PacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's packet handler with corrections and error counters."""

    def __init__(self) -> None:
        # Missing replies, replies with a wrong CRC, incomplete replies, bytes outside any reply,
        # replies to an earlier request, and reads to which a servo replied with an error.
        names = ("timeouts", "crc", "torn", "skipped_bytes", "late", "refused")
        self.counters = dict.fromkeys(names, 0)

    @property
    def damaged(self) -> int:
        """Sum of the counters for corrupted replies, incomplete replies and unexpected bytes."""
        return sum(self.counters[name] for name in ("crc", "torn", "skipped_bytes"))

    def txPacket(self, port: SerialPort, txpacket: list[int]) -> int:
        """Add byte stuffing and CRC to the packet ``txpacket`` and send it."""
        packet = packed(txpacket[4], txpacket[7], bytes(txpacket[8:-2]))
        return int(sdk.COMM_SUCCESS if port.send(packet, _STATUS_SIZE) else sdk.COMM_TX_FAIL)

    def readTxRx(
        self, port: SerialPort, dxl_id: int, address: int, length: int
    ) -> tuple[list[int], int, int]:
        """Read a register span; return (data, result code, error byte).

        If the servo replies with an error, the data are 0. A reply of the wrong length belongs to
        an earlier action instruction and is skipped. The SDK does not wait for replies to action
        instructions.
        """
        request = packed(dxl_id, sdk.INST_READ, struct.pack("<HH", address, length))
        if not port.send(request, _STATUS_SIZE + length):
            return [], int(sdk.COMM_TX_FAIL), 0
        while True:
            packet, result = self.rxPacket(port, False)
            if result != sdk.COMM_SUCCESS:
                return [], result, 0
            if packet[4] != dxl_id:
                continue
            if len(packet) == _STATUS_SIZE + length:
                return list(packet[9:-2]), result, packet[8]
            if packet[8] & _ERROR_MASK:
                return [0] * length, result, packet[8]

    def rxPacket(self, port: SerialPort, fast_option: bool = False) -> tuple[Any, int]:
        """Return the next status packet without byte stuffing, and the result code.

        The reply to a fast read has no byte stuffing and comes from the broadcast ID. If a packet
        is corrupted, the wait ends immediately, because the servo does not send the packet again.
        """
        buffer = port.received
        while True:
            start = buffer.find(_PREFIX)
            skipped = start if start >= 0 else max(len(buffer) - 3, 0)
            if skipped:
                self.counters["skipped_bytes"] += skipped
                del buffer[:skipped]
            if start >= 0 and len(buffer) >= 8:
                sender, length = buffer[4], buffer[5] | buffer[6] << 8
                known = sender == sdk.BROADCAST_ID if fast_option else sender <= sdk.MAX_ID
                if not known or not 4 <= length <= _MAX_PACKET - 7 or buffer[7] != sdk.INST_STATUS:
                    self.counters["skipped_bytes"] += 1
                    del buffer[0]  # Skip an echo of the request, or line noise.
                    continue
                end = 7 + length
                if len(buffer) >= end:
                    break
            if not port.fill():
                if buffer:
                    self.counters["torn"] += 1
                    return b"", int(sdk.COMM_RX_CORRUPT)
                self.counters["timeouts"] += 1
                return b"", int(sdk.COMM_RX_TIMEOUT)
        packet = bytes(buffer[:end])
        del buffer[:end]
        if crc16(packet[:-2]) != packet[-2] | packet[-1] << 8:
            self.counters["crc"] += 1
            return packet, int(sdk.COMM_RX_CORRUPT)
        if not fast_option and _STUFFED in packet[7:-2]:
            body = packet[7:-2].replace(_STUFFED, _HEADER)
            packet = packet[:5] + struct.pack("<H", len(body) + 2) + body + packet[-2:]
        return packet, int(sdk.COMM_SUCCESS)


# --- the tick's exchanges ------------------------------------------------------------------------


class GroupRead:
    """Sync read of one register span from several servos.

    After a successful :meth:`exchange`, ``data[id]`` contains the register bytes of a servo, and
    ``errors[id]`` contains the error byte of the servo. After a failure, ``data`` and ``errors``
    are undefined.
    """

    instruction = sdk.INST_SYNC_READ

    def __init__(self, line: ServoLine, address: int, length: int, ids: Sequence[int]) -> None:
        self.start = address
        self.data = dict.fromkeys(ids, b"")
        self.errors = dict.fromkeys(ids, 0)
        self.port = line.port
        self._handler = line.handler
        self._length = length
        span = struct.pack("<HH", address, length)
        self._request = packed(sdk.BROADCAST_ID, self.instruction, span + bytes(ids))
        self._reply = (_STATUS_SIZE + length) * len(ids)

    def exchange(self, until: float = math.inf) -> int:
        """Perform the read before ``until`` [s, time.monotonic()]; return an SDK result code."""
        if not self.port.send(self._request, self._reply, until):
            return int(sdk.COMM_TX_FAIL)
        handler = self._handler
        for servo_id in self.data:  # The servos reply in the order of `data`.
            while True:
                packet, result = handler.rxPacket(self.port, False)
                if result != sdk.COMM_SUCCESS:
                    return result
                if packet[8] & _ERROR_MASK:  # The data of an error reply are invalid.
                    handler.counters["refused"] += 1
                    return int(sdk.COMM_RX_CORRUPT)
                if len(packet) != _STATUS_SIZE + self._length:
                    handler.counters["late"] += 1
                elif packet[4] == servo_id:
                    break
            self.errors[servo_id] = packet[8]
            self.data[servo_id] = packet[9:-2]
        return int(sdk.COMM_SUCCESS)


class FastGroupRead(GroupRead):
    """Fast sync read with one reply from all servos. The last CRC covers the complete reply."""

    instruction = _FAST_SYNC_READ

    def exchange(self, until: float = math.inf) -> int:
        """Perform the read before ``until`` [s, time.monotonic()]; return an SDK result code."""
        if not self.port.send(self._request, self._reply, until):
            return int(sdk.COMM_TX_FAIL)
        handler, length = self._handler, self._length
        while True:
            packet, result = handler.rxPacket(self.port, True)
            if result != sdk.COMM_SUCCESS:
                return result
            if len(packet) == 8 + len(self.data) * (length + 4):
                break
            handler.counters["late"] += 1
        at = 8
        for servo_id in self.data:
            if packet[at + 1] != servo_id:
                return int(sdk.COMM_RX_CORRUPT)
            if packet[at] & _ERROR_MASK:  # The data of an error reply are invalid.
                handler.counters["refused"] += 1
                return int(sdk.COMM_RX_CORRUPT)
            self.errors[servo_id] = packet[at]
            self.data[servo_id] = packet[at + 2 : at + 2 + length]
            at += length + 4
        return int(sdk.COMM_SUCCESS)


class GroupWrite:
    """Sync write of one register span to several servos."""

    def __init__(self, port: SerialPort, address: int, length: int, ids: Sequence[int]) -> None:
        self._port = port
        self._span = struct.pack("<HH", address, length)
        self.ids = [bytes((servo_id,)) for servo_id in ids]

    def send(self, values: Sequence[bytes]) -> None:
        """Write one value per servo, in the order of the IDs. Servos do not reply."""
        body = b"".join(name + value for name, value in zip(self.ids, values, strict=True))
        self._port.send(packed(sdk.BROADCAST_ID, sdk.INST_SYNC_WRITE, self._span + body))


# --- single servos, outside the tick -------------------------------------------------------------


class ServoLine:
    """Exchanges with single servos on an open port, with up to `TRY_COUNT` attempts each."""

    def __init__(self, port: SerialPort, handler: PacketHandler | None = None) -> None:
        self.port = port
        self.handler = handler or PacketHandler()

    def ping(self, servo_id: int, tries: int = TRY_COUNT) -> int | None:
        """Return the servo's model number, or None if it does not reply."""
        for _ in range(tries):
            number, result, _ = self.handler.ping(self.port, servo_id)
            if result == sdk.COMM_SUCCESS:
                return int(number)
        return None

    def wait_for(self, ids: Iterable[int], seconds: float) -> list[int]:
        """Ping servos for up to ``seconds``; return the IDs of servos that have not replied.

        An adapter that restarts when its port is opened is silent for a few seconds.
        """
        end, missing = time.monotonic() + seconds, list(ids)
        while missing:
            missing = [servo_id for servo_id in missing if self.ping(servo_id, tries=1) is None]
            if time.monotonic() > end:
                break
        return missing

    def ping_old(self, servo_id: int) -> bool:
        """Return True if a servo replies to a Protocol 1.0 ping."""
        port = self.port
        body = bytes((servo_id, 2, sdk.INST_PING))
        request = _OLD_HEADER + body + bytes((~sum(body) & 0xFF,))
        port.send(request, _OLD_STATUS, time.monotonic() + _OLD_TIMEOUT)
        while True:
            came = bytes(port.received).replace(request, b"")  # Some adapters echo the request.
            reply = came[max(came.find(_OLD_HEADER), 0) :][:_OLD_STATUS]
            if len(reply) == _OLD_STATUS:
                sound = ~sum(reply[2:-1]) & 0xFF == reply[-1]
                return sound and reply[:2] == _OLD_HEADER and reply[2] != sdk.BROADCAST_ID
            if not port.fill():
                return False

    def ping_all(self, wait: float) -> dict[int, tuple[int, int]]:
        """Return (model number, firmware) of each servo that replies to a ping within ``wait`` [s].

        Servos reply one after the other in the order of their IDs. The replies of 253 servos take
        0.8 s.
        """
        found: dict[int, tuple[int, int]] = {}
        port = self.port
        port.send(packed(sdk.BROADCAST_ID, sdk.INST_PING), _STATUS_SIZE)
        port.deadline = time.monotonic() + wait
        while time.monotonic() < port.deadline:
            packet, result = self.handler.rxPacket(port, False)
            if result == sdk.COMM_SUCCESS and len(packet) == _STATUS_SIZE + 3:
                found[packet[4]] = (packet[9] | packet[10] << 8, packet[11])
        return found

    def read(self, servo_id: int, address: int, length: int) -> bytes | None:
        """Read a register span; return None if there is no valid reply."""
        for _ in range(TRY_COUNT):
            data, result, error = self.handler.readTxRx(self.port, servo_id, address, length)
            if result == sdk.COMM_SUCCESS:
                return None if error & _ERROR_MASK else bytes(data)
        return None

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write values of equal length to the servos, without replies or verification.

        The method uses a sync write, which works at every status return level.
        """
        length = len(next(iter(values.values())))
        GroupWrite(self.port, address, length, list(values)).send(list(values.values()))

    def store(self, address: int, values: Mapping[int, bytes]) -> list[int]:
        """Write each servo's bytes and read them back.

        Return the IDs of servos for which the write failed.
        """
        waiting = dict(values)
        for _ in range(TRY_COUNT):
            self.write(address, waiting)
            for servo_id, data in list(waiting.items()):
                if self.read(servo_id, address, len(data)) == data:
                    del waiting[servo_id]
            if not waiting:
                break
        return list(waiting)


@contextlib.contextmanager
def open_line(path: str, baud: int, low_latency: bool = False) -> Iterator[ServoLine]:
    """Open a port, yield a `ServoLine` for the port, and close the port afterwards.

    The adapter stays in low-latency mode if ``low_latency`` is True, and is unchanged otherwise.
    Raises ServoError if the port can't be opened.
    """
    port = SerialPort(path, baud, UNPACED_TIMEOUT, low_latency)
    port.openPort()
    try:
        yield ServoLine(port)
    finally:
        port.closePort()
