"""The SDK's Protocol 2.0 packet handler and group read, with their traps closed.

The SDK stuffs a packet and throws the result away, so that FF FF FD within goals reaches the
servo unstuffed and is misread; it drops a byte of FF FF FD 12 FF FD FD when it unstuffs; a group
read loses the servos' error bytes. Everything else of the SDK is used as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dynamixel_sdk.group_sync_read import GroupSyncRead
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from dynamixel_sdk.robotis_def import (
    BROADCAST_ID,
    COMM_NOT_AVAILABLE,
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    COMM_TX_ERROR,
    COMM_TX_FAIL,
    INST_READ,
    INST_STATUS,
    INST_SYNC_WRITE,
    MAX_ID,
)

from daemon.servos.port import SerialPort

_PREFIX = b"\xff\xff\xfd\x00"
_HEADER = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"
_MAX_PACKET = 1024
_SYNC_WRITE = bytes((INST_SYNC_WRITE,))
_SMALLEST = 11  # bytes of a status packet without data


def _make_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = value << 1 ^ (0x8005 if value & 0x8000 else 0)
        table.append(value & 0xFFFF)
    return tuple(table)


_TABLE = _make_table()


def crc16(data: Sequence[int], crc: int = 0) -> int:
    """CRC-16 (polynomial 0x8005, initial 0) that ends every packet."""
    for byte in data:
        crc = (crc & 0xFF) << 8 ^ _TABLE[crc >> 8 ^ byte]
    return crc


class PacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """Stuffs and unstuffs right, waits without spinning, counts what went wrong."""

    def __init__(self) -> None:
        self.timeouts = 0  # replies that did not come at all
        self.crc_errors = 0  # replies that came damaged
        self.torn = 0  # replies of which only a part came
        self.skipped_bytes = 0  # bytes that belonged to no reply
        self._requests: dict[tuple[int, int, tuple[int, ...], bool], bytes] = {}

    def updateCRC(self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int) -> int:
        """The SDK's name for :func:`crc16`; its own builds its table anew at every call."""
        return crc16(data_blk_ptr[:data_blk_size], crc_accum)

    def txPacket(self, port: SerialPort, txpacket: list[int]) -> int:
        """Stuff, close with the CRC and send the packet that ``txpacket`` holds unstuffed."""
        body = bytes(txpacket[7:-2])
        return self._send(port, _packet(txpacket[4], body))

    def _send(self, port: SerialPort, packet: bytes) -> int:
        if len(packet) > _MAX_PACKET:
            return int(COMM_TX_ERROR)
        port.clearPort()
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
        result = self._send(port, _packet(dxl_id, bytes((INST_READ,)) + span))
        port.setPacketTimeout(_SMALLEST + length)
        while result == COMM_SUCCESS:
            packet, result = self.rxPacket(port, False)
            if result != COMM_SUCCESS or packet[4] != dxl_id:
                continue
            if len(packet) == _SMALLEST + length:
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
        """Ask for a group read; the request is the same every tick and is built once."""
        key = (start_address, data_length, tuple(param), fast_option)
        packet = self._requests.get(key)
        if packet is None:
            head = bytes((0x8A if fast_option else 0x82,))
            span = start_address.to_bytes(2, "little") + data_length.to_bytes(2, "little")
            packet = _packet(BROADCAST_ID, head + span + bytes(param))
            self._requests[key] = packet
        result = self._send(port, packet)
        if result == COMM_SUCCESS:
            port.setPacketTimeout((_SMALLEST + data_length) * param_length)
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
        packet = _packet(BROADCAST_ID, _SYNC_WRITE + span + bytes(param))
        return self._send(port, packet)

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


def _packet(packet_id: int, body: bytes) -> bytes:
    if _HEADER in body:
        body = body.replace(_HEADER, _STUFFED)
    length = len(body) + 2
    packet = _PREFIX + bytes((packet_id, length & 0xFF, length >> 8)) + body
    return packet + crc16(packet).to_bytes(2, "little")


class GroupRead(GroupSyncRead):  # type: ignore[misc]
    """A sync read of one span of several servos that keeps their error bytes.

    After :meth:`exchange` returned success, ``data_dict[id]`` has the span's bytes and
    ``errors[id]`` the servo's error byte; after a failure neither is to be used.
    """

    def __init__(
        self,
        port: SerialPort,
        handler: PacketHandler,
        address: int,
        length: int,
        ids: Sequence[int],
    ) -> None:
        super().__init__(port, handler, address, length)
        self.errors = dict.fromkeys(ids, 0)
        for servo_id in ids:
            self.addParam(servo_id)

    def exchange(self, fast: bool) -> int:
        """Ask and wait; a result code of the SDK."""
        return int(self.fastSyncRead() if fast else self.txRxPacket())

    def rxPacket(self) -> int:
        """Take one reply a servo, in their order."""
        self.last_result = False
        handler, length = self.ph, self.data_length
        for servo_id in self.data_dict:
            while True:
                packet, result = handler.rxPacket(self.port, False)
                if result != COMM_SUCCESS:
                    return int(result)
                if packet[4] == servo_id:
                    break
            if len(packet) != _SMALLEST + length:
                return int(COMM_RX_CORRUPT)  # an error and no data
            self.errors[servo_id] = packet[8]
            self.data_dict[servo_id] = packet[9:-2]
        self.last_result = True
        return int(COMM_SUCCESS)

    def fastSyncReadRxPacket(self) -> int:
        """Take the one reply of a fast sync read apart; its last CRC covers every byte of it."""
        self.last_result = False
        length = self.data_length
        packet, result = self.ph.rxPacket(self.port, True)
        if result != COMM_SUCCESS:
            return int(result)
        if len(packet) != 8 + len(self.data_dict) * (length + 4):
            return int(COMM_RX_CORRUPT)
        at = 8
        for servo_id in self.data_dict:
            if packet[at + 1] != servo_id:
                return int(COMM_RX_CORRUPT)
            self.errors[servo_id] = packet[at]
            self.data_dict[servo_id] = packet[at + 2 : at + 2 + length]
            at += length + 4
        self.last_result = True
        return int(COMM_SUCCESS)
