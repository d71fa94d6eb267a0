"""The tick's two exchanges: one read and one write of the same span of several servos.

The SDK's group read and group sync write, with packets that are built once, the servos' error
bytes kept, and replies told apart from old ones.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from dynamixel_sdk.group_sync_read import GroupSyncRead
from dynamixel_sdk.group_sync_write import GroupSyncWrite
from dynamixel_sdk.robotis_def import BROADCAST_ID, COMM_RX_CORRUPT, COMM_SUCCESS, INST_SYNC_WRITE

from softfinger.daemon.servos.crc import crc16
from softfinger.daemon.servos.packets import SMALLEST, PacketHandler, group_request
from softfinger.daemon.servos.port import SerialPort

_HEADER = b"\xff\xff\xfd"
_CRC = struct.Struct("<H")
_ERROR = 0x7F  # of a servo's error byte; the bit above is the alert


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
        self._plain = group_request(address, length, ids, False)
        self._fast = group_request(address, length, ids, True)
        self._reply = (SMALLEST + length) * len(ids)

    def exchange(self, fast: bool) -> int:
        """Ask and wait; a result code of the SDK."""
        result = self.fastSyncReadTxPacket() if fast else self.txPacket()
        if result != COMM_SUCCESS:
            return result
        return self.fastSyncReadRxPacket() if fast else self.rxPacket()

    def txPacket(self) -> int:
        """Ask for one reply a servo."""
        return self._ask(self._plain)

    def fastSyncReadTxPacket(self) -> int:
        """Ask for one reply of all."""
        return self._ask(self._fast)

    def _ask(self, request: bytes) -> int:
        result: int = self.ph.ask(self.port, request)
        if result == COMM_SUCCESS:
            self.port.setPacketTimeout(self._reply)
        return result

    def rxPacket(self) -> int:
        """Take one reply a servo, in their order."""
        self.last_result = False
        handler, length = self.ph, self.data_length
        for servo_id in self.data_dict:
            while True:
                packet, result = handler.rxPacket(self.port, False)
                if result != COMM_SUCCESS:
                    return int(result)
                if packet[8] & _ERROR:
                    handler.refused += 1
                    return int(COMM_RX_CORRUPT)
                if len(packet) != SMALLEST + length:
                    handler.late += 1
                elif packet[4] == servo_id:
                    break
            self.errors[servo_id] = packet[8]
            self.data_dict[servo_id] = packet[9:-2]
        self.last_result = True
        return int(COMM_SUCCESS)

    def fastSyncReadRxPacket(self) -> int:
        """Take the one reply of a fast sync read apart; its last CRC covers every byte of it."""
        self.last_result = False
        length = self.data_length
        while True:
            packet, result = self.ph.rxPacket(self.port, True)
            if result != COMM_SUCCESS:
                return int(result)
            if len(packet) == 8 + len(self.data_dict) * (length + 4):
                break
            self.ph.late += 1
        at = 8
        for servo_id in self.data_dict:
            if packet[at + 1] != servo_id:
                return int(COMM_RX_CORRUPT)
            if packet[at] & _ERROR:  # its data are no reading
                self.ph.refused += 1
                return int(COMM_RX_CORRUPT)
            self.errors[servo_id] = packet[at]
            self.data_dict[servo_id] = packet[at + 2 : at + 2 + length]
            at += length + 4
        self.last_result = True
        return int(COMM_SUCCESS)


class GroupWrite(GroupSyncWrite):  # type: ignore[misc]
    """A sync write of one span of several servos, whose packet's beginning is built once."""

    def __init__(
        self,
        port: SerialPort,
        handler: PacketHandler,
        address: int,
        length: int,
        ids: Sequence[int],
    ) -> None:
        super().__init__(port, handler, address, length)
        for servo_id in ids:
            self.addParam(servo_id, bytes(length))
        size = 7 + len(ids) * (1 + length)  # instruction, span, values, CRC
        self._head = _HEADER + struct.pack(
            "<BBHBHH", 0, BROADCAST_ID, size, INST_SYNC_WRITE, address, length
        )
        self._crc = crc16(self._head)
        self._names = [bytes((servo_id,)) for servo_id in ids]

    def send(self, values: Iterable[bytes]) -> int:
        """Write each servo's bytes, in the order of their IDs; a result code of the SDK."""
        body = b"".join([part for pair in zip(self._names, values, strict=True) for part in pair])
        if _HEADER in body:  # to be stuffed, which changes the length
            for name, value in zip(self._names, values, strict=True):
                self.changeParam(name[0], value)
            return int(self.txPacket())
        packet = self._head + body + _CRC.pack(crc16(body, self._crc))
        result: int = self.ph.tell(self.port, packet)
        return result
