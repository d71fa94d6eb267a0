"""The SDK's Protocol 2.0 packet handler with its traps closed.

The SDK stuffs a packet and throws the result away, so that FF FF FD within goals reaches the
servo unstuffed and is misread; it drops a byte of FF FF FD 12 FF FD FD when it unstuffs.
Everything else of the SDK is used as it is; the group reads and writes of a tick stand in
:mod:`servos.groups`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from dynamixel_sdk.robotis_def import (
    BROADCAST_ID,
    COMM_NOT_AVAILABLE,
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    COMM_TX_ERROR,
    COMM_TX_FAIL,
    INST_FAST_SYNC_READ,
    INST_READ,
    INST_STATUS,
    INST_SYNC_READ,
    INST_SYNC_WRITE,
    MAX_ID,
)

from softfinger.daemon.servos.crc import crc16
from softfinger.daemon.servos.port import SerialPort

_PREFIX = b"\xff\xff\xfd\x00"
_HEADER = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"
_MAX_PACKET = 1024
_SYNC_WRITE = bytes((INST_SYNC_WRITE,))
SMALLEST = 11  # bytes of a status packet without data


class PacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """Stuffs and unstuffs right, waits without spinning, counts what went wrong."""

    def __init__(self) -> None:
        self.timeouts = 0  # replies that did not come at all
        self.crc_errors = 0  # replies that came damaged
        self.torn = 0  # replies of which only a part came
        self.late = 0  # replies to an earlier question
        self.refused = 0  # readings answered with an error
        self.skipped_bytes = 0  # bytes that belonged to no reply

    def updateCRC(self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int) -> int:
        """The SDK's name for :func:`crc16`; its own builds its table anew at every call."""
        return crc16(bytes(data_blk_ptr[:data_blk_size]), crc_accum)

    def txPacket(self, port: SerialPort, txpacket: list[int]) -> int:
        """Stuff, close with the CRC and send the packet that ``txpacket`` holds unstuffed."""
        body = bytes(txpacket[7:-2])
        return self.ask(port, packed(txpacket[4], body))

    def ask(self, port: SerialPort, packet: bytes) -> int:
        """Send a finished packet that is answered: what came before it is thrown away."""
        port.clearPort()
        return self.tell(port, packet)

    def tell(self, port: SerialPort, packet: bytes) -> int:
        """Send a finished packet that nobody answers."""
        if len(packet) > _MAX_PACKET:
            return int(COMM_TX_ERROR)
        if port.writePort(packet) != len(packet):
            return int(COMM_TX_FAIL)
        return int(COMM_SUCCESS)

    def readTxRx(
        self, port: SerialPort, dxl_id: int, address: int, length: int
    ) -> tuple[list[int], int, int]:
        """Read a span: (data, result code, error byte). With an error the data are zeros.

        A reply of another length is an old one (the SDK does not wait for an action's) and is
        passed over; the SDK would take its CRC for data.
        """
        if dxl_id >= BROADCAST_ID:
            return [], int(COMM_NOT_AVAILABLE), 0
        span = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        result = self.ask(port, packed(dxl_id, bytes((INST_READ,)) + span))
        port.setPacketTimeout(SMALLEST + length)
        while result == COMM_SUCCESS:
            packet, result = self.rxPacket(port, False)
            if result != COMM_SUCCESS or packet[4] != dxl_id:
                continue
            if len(packet) == SMALLEST + length:
                return list(packet[9:-2]), result, packet[8]
            if packet[8] & 0x7F:
                return [0] * length, result, packet[8]
        return [], result, 0

    def syncReadTx(
        self,
        port: SerialPort,
        start_address: int,
        data_length: int,
        param: list[int],
        param_length: int,
        fast_option: bool,
    ) -> int:
        """Ask for a group read."""
        request = group_request(start_address, data_length, param, fast_option)
        result = self.ask(port, request)
        if result == COMM_SUCCESS:
            port.setPacketTimeout((SMALLEST + data_length) * param_length)
        return result

    def syncWriteTxOnly(
        self,
        port: SerialPort,
        start_address: int,
        data_length: int,
        param: list[int],
        param_length: int,
    ) -> int:
        """Write a span of several servos; nothing is answered."""
        span = start_address.to_bytes(2, "little") + data_length.to_bytes(2, "little")
        packet = packed(BROADCAST_ID, _SYNC_WRITE + span + bytes(param))
        return self.tell(port, packet)

    def rxPacket(self, port: SerialPort, fast_option: bool) -> tuple[Any, int]:
        """The next status packet, unstuffed, and the result code.

        A fast reply is not stuffed and comes from the broadcast ID. A damaged packet ends the
        wait at once: what was lost does not come again.
        """
        buffer = port.received
        while True:
            found = self._take(buffer, fast_option)
            if found is not None:
                packet, intact = found
                if not intact:
                    self.crc_errors += 1
                    return packet, int(COMM_RX_CORRUPT)
                return packet, int(COMM_SUCCESS)
            if not port.fill():
                if buffer:
                    self.torn += 1
                    return b"", int(COMM_RX_CORRUPT)
                self.timeouts += 1
                return b"", int(COMM_RX_TIMEOUT)

    def _take(self, buffer: bytearray, fast: bool) -> tuple[bytes, bool] | None:
        """Cut the first status packet out of ``buffer``: (packet, whether its CRC is right)."""
        while True:
            start = buffer.find(_PREFIX)
            if start < 0:
                if len(buffer) > 3:
                    self.skipped_bytes += len(buffer) - 3
                    del buffer[:-3]
                return None
            if start:
                self.skipped_bytes += start
                del buffer[:start]
            if len(buffer) < 8:
                return None
            length = buffer[5] | buffer[6] << 8
            sender = buffer[4]
            known = sender == BROADCAST_ID if fast else sender <= MAX_ID
            if not known or not 4 <= length <= _MAX_PACKET - 7 or buffer[7] != INST_STATUS:
                self.skipped_bytes += 1
                del buffer[0]  # an echo of what we sent, or noise
                continue
            end = 7 + length
            if len(buffer) < end:
                return None
            packet = bytes(buffer[:end])
            del buffer[:end]
            intact = crc16(packet[:-2]) == packet[-2] | packet[-1] << 8
            if not fast and _STUFFED in packet[7:-2]:
                body = packet[7:-2].replace(_STUFFED, _HEADER)
                length = len(body) + 2
                head = packet[:5] + bytes((length & 0xFF, length >> 8))
                packet = head + body + packet[-2:]
            return packet, intact


def group_request(address: int, length: int, ids: Sequence[int], fast: bool) -> bytes:
    """The packet that asks several servos for a span of registers."""
    head = bytes((INST_FAST_SYNC_READ if fast else INST_SYNC_READ,))
    span = address.to_bytes(2, "little") + length.to_bytes(2, "little")
    return packed(BROADCAST_ID, head + span + bytes(ids))


def packed(packet_id: int, body: bytes) -> bytes:
    """A packet with the instruction and parameters ``body``, stuffed and closed with the CRC."""
    if _HEADER in body:
        body = body.replace(_HEADER, _STUFFED)
    length = len(body) + 2
    packet = _PREFIX + bytes((packet_id, length & 0xFF, length >> 8)) + body
    return packet + crc16(packet).to_bytes(2, "little")
