"""Exchanges with single servos outside the tick: ping, read, and writes that are read back.

Each is tried a few times, since nothing hurries here; the tick's own exchanges are not made with
this. It knows no finger and no setting.
"""

from __future__ import annotations

from collections.abc import Mapping

from dynamixel_sdk.group_sync_write import GroupSyncWrite
from dynamixel_sdk.robotis_def import BROADCAST_ID, COMM_SUCCESS

from softfinger.daemon.servos.packets import PacketHandler
from softfinger.daemon.servos.port import SerialPort

TRIES = 3


class ServoLine:
    """Servos on one open port, by their IDs."""

    def __init__(self, port: SerialPort, handler: PacketHandler) -> None:
        self.port = port
        self.handler = handler

    def ping(self, servo_id: int, tries: int = TRIES) -> int | None:
        """The servo's model number, None when it does not answer."""
        for _ in range(tries):
            number, result, _ = self.handler.ping(self.port, servo_id)
            if result == COMM_SUCCESS:
                return int(number)
        return None

    def ping_all(self, wait: float) -> dict[int, tuple[int, int]]:
        """(model number, firmware) of every servo that answers a broadcast ping within ``wait`` s.

        Servos answer one after the other in the order of their IDs; 253 of them need 0.8 s.
        """
        found: dict[int, tuple[int, int]] = {}
        self.handler.txPacket(self.port, [0, 0, 0, 0, BROADCAST_ID, 3, 0, 1, 0, 0])
        self.port.setPacketTimeoutMillis(wait * 1000.0)
        while not self.port.isPacketTimeout():
            packet, result = self.handler.rxPacket(self.port, False)
            if result == COMM_SUCCESS and len(packet) == 14:
                found[packet[4]] = (packet[9] | packet[10] << 8, packet[11])
        return found

    def read(self, servo_id: int, address: int, length: int) -> bytes | None:
        """A span of registers, None when no sound answer came."""
        for _ in range(TRIES):
            data, result, error = self.handler.readTxRx(self.port, servo_id, address, length)
            if result == COMM_SUCCESS:
                return None if error & 0x7F else bytes(data)
        return None

    def tell(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write each servo's bytes, unanswered and unverified: for registers that change who it is.

        All have the same length.
        """
        length = len(next(iter(values.values())))
        group = GroupSyncWrite(self.port, self.handler, address, length)
        for servo_id, data in values.items():
            group.addParam(servo_id, data)
        group.txPacket()

    def store(self, address: int, values: Mapping[int, bytes]) -> list[int]:
        """Write each servo's bytes and read them back; the IDs where that did not succeed.

        Written as a sync write, so that it works at any status return level.
        """
        waiting = dict(values)
        for _ in range(TRIES):
            length = len(next(iter(waiting.values())))
            self.tell(address, waiting)
            for servo_id, data in list(waiting.items()):
                if self.read(servo_id, address, length) == data:
                    del waiting[servo_id]
            if not waiting:
                return []
        return list(waiting)
