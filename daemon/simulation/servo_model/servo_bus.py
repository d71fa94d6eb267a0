"""Emulate a bus of Dynamixel servos.

Input and output are bytes with time stamps, so tests and fuzzers need no port.
:mod:`simulation.emulator.pty_bus` adds the pseudo-terminal. In a group read, each servo waits for
the reply of the previous servo in the list. Servos after a missing servo therefore do not reply.
Backups of the control table are not supported, so backup instructions return an error. Servos that
are set to Protocol 1.0 reply only to a Protocol 1.0 ping.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, reduce
from itertools import zip_longest
from operator import and_
from typing import Any, NamedTuple

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import JointPlant
from softfinger.daemon.servos.control_table import by_name, crc16
from softfinger.daemon.servos.joint import JointScale
from softfinger.daemon.simulation.faults import LINE_FAULTS, SERVO_FAULTS, FaultSource
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, Packet, PacketParser
from softfinger.daemon.simulation.servo_model.servo import BusRecorder, EmulatedServo, prepared
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat

_SYNC_READS = frozenset((framing.SYNC_READ, framing.FAST_SYNC_READ))
_GROUP_READS = _SYNC_READS | {framing.BULK_READ, framing.FAST_BULK_READ}
_FAST_READS = frozenset((framing.FAST_SYNC_READ, framing.FAST_BULK_READ))
_READS = _GROUP_READS | {framing.PING, framing.READ}
_FACTORY_RESET_GUARD = 42  # first firmware that ignores a full factory reset by broadcast
_SPAN = struct.Struct("<HH")  # address, length
_ITEM = struct.Struct("<BHH")  # ID, address, length


class TimedReply(NamedTuple):
    """Reply that is sent ``delay`` [s] after the wire becomes free.

    ``late`` [s] delays this reply further, but does not delay later replies.
    """

    delay: float
    data: bytes
    late: float = 0.0


class ServoBus:
    """Servos that share one wire and one plant. Corrupted packets are ignored."""

    def __init__(
        self,
        servos: Sequence[EmulatedServo],
        plant: JointPlant,
        *,
        seed: int = 1,
    ) -> None:
        self.servos = list(servos)
        self.plant = plant
        self.faults = FaultSource(seed)
        self.parser = PacketParser()
        self.lag = 0.0  # maximum age of a reading at the time of the reply [s]
        self.packets = 0  # number of packets received
        self.now = -math.inf  # time to which the bus has been advanced [s]
        self.due = -math.inf  # lower bound on the time of the next servo event [s]

    @classmethod
    def from_settings(
        cls,
        settings: Settings,
        plant: JointPlant,
        *,
        ids: Sequence[int] | None = None,
        baud: int = 0,
        factory: bool = False,
        t: float = 0.0,
    ) -> ServoBus:
        """Create the configured servos, one per joint, starting with the left finger.

        ``ids`` replaces the IDs in the settings, and a ``baud`` above 0 replaces the baud rate. If
        ``factory`` is True, all other registers have their factory defaults. Raises SettingsError
        if the model does not support the baud rate.
        """
        servos = settings.servos
        model = by_name(servos.model)
        rate = baud or servos.baud
        if rate not in model.baud_rates:
            raise SettingsError(
                f"{model.name} does not support {rate} baud, only "
                f"{', '.join(map(str, model.baud_rates))}"
            )
        eeprom = {reg.BAUD_RATE: model.baud_rates.index(rate)}
        if not factory:
            eeprom |= prepared(model, reg.MODE_NUMBERS[servos.mode])
        made = []
        for joint, servo_id in enumerate(servos.ids if ids is None else ids):
            scale = JointScale.of(servos, joint, model)
            eeprom[reg.ID] = servo_id
            heat = ServoHeat.of(settings)
            made.append(EmulatedServo(model, plant, joint, scale, eeprom, heat=heat, t=t))
        return cls(made, plant, seed=settings.simulation.seed)

    # --- time ------------------------------------------------------------------------------

    def advance(self, t: float) -> None:
        """Advance the plant and servos to time t [s], and handle each servo event at its time."""
        if t <= self.now:
            return
        if t >= self.due:
            servos, plant = self.servos, self.plant
            while (due := min(servo.next_event() for servo in servos)) <= t:
                plant.advance(due)
                for servo in servos:
                    servo.act(due)
            self.due = due
        self.plant.advance(t)
        self.now = t

    # --- bytes -----------------------------------------------------------------------------

    def feed(self, data: bytes, t: float, baud: int = 0) -> bytes:
        """Return the bytes of all replies to ``data``, which arrives at time t."""
        return b"".join(reply.data for reply in self.exchange(data, t, baud))

    def exchange(self, data: bytes, t: float, baud: int = 0) -> list[TimedReply]:
        """Return the replies to ``data`` with their delays. A ``baud`` of 0 matches all servos."""
        if t >= self.due or t > self.now + self.lag:
            self.advance(t)
        replies: list[TimedReply] = []
        for asked in framing.old_pings(data):
            replies += [
                TimedReply(servo.return_delay, framing.old_status(servo.id))
                for servo in self._listening(t, baud, old_protocol=True)
                if asked in (servo.id, BROADCAST)
            ]
        for packet in self.parser.feed(data, t):
            self.packets += 1
            reads = packet.instruction in _READS
            if self.faults.loses(reads) or not packet.valid:
                continue
            if not reads:
                self.advance(t)
            listening = self._listening(t, baud)
            for servo in listening:
                servo.heard(t)
            replies += self._answers(packet, listening, t)
            if not reads:
                self.due = min([servo.next_event() for servo in self.servos])
        return [
            TimedReply(reply.delay, spoilt, late)
            for reply in replies
            for late, spoilt in self.faults.spoil(reply.data)
        ]

    def _listening(self, t: float, baud: int, old_protocol: bool = False) -> list[EmulatedServo]:
        """Return the servos that receive packets of a protocol at a baud rate."""
        return [
            servo
            for servo in self.servos
            if servo.old_protocol == old_protocol and servo.awake(t) and baud in (0, servo.baud)
        ]

    def fault(self, kind: str, value: float, t: float) -> None:
        """Start a fault; ``value`` is a probability for LINE_FAULTS and an ID for SERVO_FAULTS."""
        self.due = -math.inf
        if kind in LINE_FAULTS:
            self.faults.rates[kind] = value
        for servo in self.servos:
            if kind in SERVO_FAULTS and servo.id == value:
                servo.fault(kind, t)

    def recover(self, t: float) -> None:
        """End all faults. Hardware errors stay latched until a reboot."""
        self.faults.rates = dict.fromkeys(LINE_FAULTS, 0.0)
        for servo in self.servos:
            for kind in ("answer", "recover"):
                self.fault(kind, servo.id, t)

    def report(self, t: float) -> list[dict[str, Any]]:
        """Return each servo's state and bus record."""
        self.advance(t)
        return [servo.report(t) for servo in self.servos]

    def forget(self, t: float) -> None:
        """Clear the records of all servos."""
        for servo in self.servos:
            servo.recorder = BusRecorder(t)

    # --- instructions ----------------------------------------------------------------------------

    def _answers(self, packet: Packet, servos: list[EmulatedServo], t: float) -> list[TimedReply]:
        instruction = packet.instruction
        if packet.id == BROADCAST:
            return self._broadcast(packet, servos, t)
        if instruction == framing.STATUS:
            return []  # The packet is a reply from another servo, or an echo.
        # At status return level 0, a servo replies only to pings. Level 1 adds reads, and level 2
        # adds all other instructions.
        needed = {framing.PING: 0, framing.READ: 1}.get(instruction, 2)
        replies = []
        for servo in servos:
            if servo.id == packet.id:
                # The return level from before the instruction applies.
                level = servo.table.get(reg.STATUS_RETURN_LEVEL)
                reply = _reply(servo, instruction, packet.parameters, t)
                if level >= needed:
                    replies.append(reply)
            elif servo.shadow == packet.id:
                _execute(servo, instruction, packet.parameters, t)
        return _at_once(replies)

    def _broadcast(self, packet: Packet, servos: list[EmulatedServo], t: float) -> list[TimedReply]:
        instruction, data = packet.instruction, packet.parameters
        if instruction == framing.PING:
            replies = []
            for servo_id in sorted({servo.id for servo in servos}):
                same = [servo for servo in servos if servo.id == servo_id]
                replies += _at_once([_reply(servo, instruction, data, t) for servo in same])
            return replies
        if instruction in _GROUP_READS:
            return self._group_read(instruction, data, servos, t)
        if instruction == framing.SYNC_WRITE:
            _write_each(_sync_items(data), servos, t)
        elif instruction == framing.BULK_WRITE:
            _write_each(_bulk_items(data), servos, t)
        else:  # Other broadcast instructions are executed without a reply.
            for servo in servos:
                guarded = servo.firmware >= _FACTORY_RESET_GUARD and data == b"\xff"
                if instruction != framing.FACTORY_RESET or not guarded:
                    _execute(servo, instruction, data, t)
        return []

    def _group_read(
        self, instruction: int, data: bytes, servos: list[EmulatedServo], t: float
    ) -> list[TimedReply]:
        requested, piece = _requested(instruction, data)
        fast = instruction in _FAST_READS
        replies: list[TimedReply] = []
        block = b""
        crc, delay = 0, 0.0
        for servo_id, address, length in requested:
            same = [servo for servo in servos if servo.answers_reads(servo_id, fast)]
            if not same or (fast and len(same) > 1):
                break
            if not fast:
                span = _SPAN.pack(address, length)
                replies += _at_once([_reply(servo, framing.READ, span, t) for servo in same])
                continue
            # Each CRC covers all preceding bytes, including earlier CRCs.
            (servo,) = same
            values = servo.read(address, length, t)
            error = framing.ACCESS if values is None else framing.OK
            piece += bytes((error | servo.alert, servo_id)) + (values or bytes(length))
            crc = crc16(piece, crc)
            block += piece
            piece = crc.to_bytes(2, "little")
            delay += servo.return_delay
        if not block:
            return replies
        # The blocks form one packet, so their return delays add up.
        return [TimedReply(delay, block + piece)]


@lru_cache(maxsize=32)
def _requested(instruction: int, data: bytes) -> tuple[list[tuple[int, int, int]], bytes]:
    """Return the items (ID, address, length) of a group read, and the first bytes of a fast reply.

    The result is empty if the packet is incomplete or contains an ID twice.
    """
    requested: list[tuple[int, int, int]] = []
    if instruction not in _SYNC_READS:
        if len(data) % _ITEM.size == 0:
            requested = list(_ITEM.iter_unpack(data))
    elif len(data) >= 5:
        address, length = _SPAN.unpack_from(data)
        requested = [(servo_id, address, length) for servo_id in data[4:]]
    if len({servo_id for servo_id, _, _ in requested}) < len(requested):
        return [], b""
    return requested, framing.fast_head(1 + sum(length + 4 for _, _, length in requested))


def _write_each(
    items: Iterable[tuple[int, int, bytes]], servos: list[EmulatedServo], t: float
) -> None:
    """Write each item (ID, address, data) of a group write."""
    for servo_id, address, data in items:
        for servo in servos:
            if servo_id in (servo.id, servo.shadow):
                servo.write(address, data, t)


def _sync_items(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    if len(data) < _SPAN.size:
        return
    address, length = _SPAN.unpack_from(data)
    size = length + 1
    if length and (len(data) - _SPAN.size) % size == 0:
        for i in range(_SPAN.size, len(data), size):
            yield data[i], address, data[i + 1 : i + size]


def _bulk_items(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    i = 0
    while i + _ITEM.size <= len(data):
        servo_id, address, length = _ITEM.unpack_from(data, i)
        i += _ITEM.size + length
        if i <= len(data):
            yield servo_id, address, data[i - length : i]


def _reply(servo: EmulatedServo, instruction: int, data: bytes, t: float) -> TimedReply:
    """Execute an instruction on a servo; return the reply.

    The reply uses the return delay and the ID from before the instruction, and the alert bit from
    after the instruction.
    """
    delay, servo_id = servo.return_delay, servo.id
    error, values = _execute(servo, instruction, data, t)
    return TimedReply(delay, framing.status(servo_id, error | servo.alert, values))


def _execute(servo: EmulatedServo, instruction: int, data: bytes, t: float) -> tuple[int, bytes]:
    """Execute an instruction on a servo; return the reply's error number and data."""
    match instruction:
        case framing.PING:
            return framing.OK, struct.pack("<HB", servo.model.number, servo.firmware)
        case framing.READ:
            if len(data) != _SPAN.size:
                return framing.DATA_LENGTH, b""
            address, length = _SPAN.unpack(data)
            values = servo.read(address, length, t)
            return (framing.ACCESS, b"") if values is None else (framing.OK, values)
        case framing.WRITE | framing.REG_WRITE:
            if len(data) < 3:
                return framing.DATA_LENGTH, b""
            address, values = data[0] | data[1] << 8, data[2:]
            if instruction == framing.REG_WRITE:
                return servo.register(address, values), b""
            return servo.write(address, values, t), b""
        case framing.ACTION:
            return servo.action(t), b""
        case framing.FACTORY_RESET:
            return servo.factory_reset(data, t), b""
        case framing.REBOOT:
            servo.reboot(t)
            return framing.OK, b""
        case framing.CLEAR:
            return servo.clear(data, t), b""
    return framing.INSTRUCTION_ERROR, b""


def _at_once(replies: list[TimedReply]) -> list[TimedReply]:
    """Merge the replies of servos with the same ID into one corrupted reply.

    On the wire, 0 bits dominate. Servos never start to reply at exactly the same time, so even
    identical replies collide. In the emulation, each reply begins one byte after the previous
    reply.
    """
    if len(replies) < 2:
        return replies
    begun = (b"\xff" * k + reply.data for k, reply in enumerate(replies))
    data = bytes(reduce(and_, column) for column in zip_longest(*begun, fillvalue=0xFF))
    return [TimedReply(min(reply.delay for reply in replies), data)]
