"""A bus of emulated Dynamixel servos: instruction packets in, status packets out, byte for byte.

Pure: it is given bytes and the time and gives bytes, so that tests and fuzzers need no port; the
pseudo-terminal around it is :mod:`simulation.emulator.pty_bus`. In group reads a servo answers
after it has heard the one named before it; so where one is missing, those after it stay silent.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import JointPlant
from softfinger.daemon.servos.control_table import MODE_NUMBERS, JointScale, ServoModel, by_name
from softfinger.daemon.servos.crc import crc16
from softfinger.daemon.simulation.servo_model import protocol
from softfinger.daemon.simulation.servo_model.bus_faults import (
    LINE_FAULTS,
    FaultError,
    FaultSource,
    parse_fault,
)
from softfinger.daemon.simulation.servo_model.collision import collide
from softfinger.daemon.simulation.servo_model.protocol import BROADCAST, Packet, Parser
from softfinger.daemon.simulation.servo_model.servo import EmulatedServo

_READS = frozenset(
    (
        protocol.PING,
        protocol.READ,
        protocol.SYNC_READ,
        protocol.FAST_SYNC_READ,
        protocol.BULK_READ,
        protocol.FAST_BULK_READ,
    )
)
_FACTORY_RESET_GUARD = 42  # firmware that ignores a broadcast reset of everything


class Reply(NamedTuple):
    """Bytes to send ``delay`` seconds after the wire fell silent; ``late`` adds to that alone."""

    delay: float
    data: bytes
    late: float = 0.0


class ServoBus:
    """Servos sharing one wire and one plant.

    ``crc_reply`` makes a servo answer a damaged packet with error 3 instead of staying silent.
    """

    def __init__(
        self,
        servos: Sequence[EmulatedServo],
        plant: JointPlant,
        *,
        seed: int = 1,
        gap: float = 0.0015,
        crc_reply: bool = False,
    ) -> None:
        self.servos = list(servos)
        self.plant = plant
        self.faults = FaultSource(seed)
        self.parser = Parser(gap)
        self.packets = 0
        self._crc_reply = crc_reply
        self._jitter = random.Random(seed)
        self._now = -math.inf
        self._due = -math.inf  # no servo does anything by itself before then
        self._unicast: dict[int, Callable[[EmulatedServo, bytes, float], tuple[int, bytes]]] = {
            protocol.PING: self._ping,
            protocol.READ: self._read,
            protocol.WRITE: self._write,
            protocol.REG_WRITE: self._reg_write,
            protocol.ACTION: lambda servo, _, t: (servo.action(t), b""),
            protocol.FACTORY_RESET: self._factory_reset,
            protocol.REBOOT: self._reboot,
            protocol.CLEAR: lambda servo, data, t: (servo.clear(data, t), b""),
            protocol.BACKUP: lambda servo, data, t: (servo.backup(data, t), b""),
        }

    @classmethod
    def from_settings(
        cls,
        settings: Settings,
        plant: JointPlant,
        *,
        model: str | None = None,
        ids: Sequence[int] | None = None,
        baud: int = 0,
        prepared: bool = True,
        faults: Iterable[str] = (),
        t: float = 0.0,
    ) -> ServoBus:
        """The stand-in hand's servos: one a joint, left first, mapped as the settings say.

        ``baud`` > 0 sets the servos to that rate. Raises KeyError for an unknown model,
        ValueError for a rate the model has not, FaultError for an unknown fault.
        """
        chosen = by_name(settings.servos.model if model is None else model)
        rate = baud or settings.servos.baud
        if rate not in chosen.baud_rates:
            raise ValueError(
                f"{chosen.name} has no {rate} baud; it has {', '.join(map(str, chosen.baud_rates))}"
            )
        servos = [
            EmulatedServo(
                chosen,
                servo_id,
                plant,
                joint,
                JointScale.of(settings.servos, joint, chosen),
                prepared=prepared,
                mode=MODE_NUMBERS[settings.servos.mode],
                baud_index=chosen.baud_rates.index(rate),
                t=t,
            )
            for joint, servo_id in enumerate(settings.servos.ids if ids is None else ids)
        ]
        bus = cls(servos, plant, seed=settings.simulation.seed)
        for fault in faults:
            bus.fault(fault, t)
        return bus

    # --- time ------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """The time last advanced to [s]."""
        return self._now

    def advance(self, t: float) -> None:
        """Bring plant and servos to time t [s]; each servo's own events happen at their time."""
        if t <= self._now:
            return
        if t >= self._due:
            servos, plant = self.servos, self.plant
            while (due := min(servo.next_event() for servo in servos)) <= t:
                plant.advance(due)
                for servo in servos:
                    servo.act(due)
            self._due = due
        self.plant.advance(t)
        self._now = t

    def next_event(self) -> float:
        """When a servo next does something by itself [s]; possibly too early, never too late."""
        return self._due

    # --- bytes -----------------------------------------------------------------------------

    def feed(self, data: bytes, t: float, baud: int = 0) -> bytes:
        """What the bus answers to ``data`` arriving at time t, all at once."""
        return b"".join(reply.data for reply in self.exchange(data, t, baud))

    def exchange(self, data: bytes, t: float, baud: int = 0) -> list[Reply]:
        """As :meth:`feed`, reply by reply with their delays. ``baud`` 0 is heard by every servo."""
        self.advance(t)
        replies: list[Reply] = []
        for packet in self.parser.feed(data, t):
            self.packets += 1
            if self.faults.loses(packet.instruction in _READS):
                continue
            listening = [
                servo for servo in self.servos if servo.awake(t) and baud in (0, servo.baud)
            ]
            if packet.valid:
                for servo in listening:
                    servo.heard(t)
                replies += self._answers(packet, listening, t)
                if packet.instruction not in _READS:
                    self._due = min([servo.next_event() for servo in self.servos])
            elif self._crc_reply:
                replies += [
                    self._status(servo, protocol.CRC_ERROR)
                    for servo in listening
                    if servo.id == packet.id
                ]
        if not self.faults.active:
            return replies
        return [
            Reply(reply.delay, spoilt, late)
            for reply in replies
            for late, spoilt in self.faults.spoil(reply.data)
        ]

    def fault(self, text: str, t: float) -> None:
        """Put a fault on the bus: ``drop=0.01``, ``silent=2``, ``overheat=1`` …

        Raises:
            FaultError: it can't be understood, or no servo has that ID.
        """
        kind, number = parse_fault(text)
        self._due = -math.inf
        if kind in LINE_FAULTS:
            setattr(self.faults.rates, kind.replace("-", "_"), number)
            return
        servo = next((servo for servo in self.servos if servo.id == number), None)
        if servo is None:
            raise FaultError(f"fault {text!r}: no servo has that ID")
        model: ServoModel = servo.model
        if kind == "reboot":
            servo.reboot(t)
        elif kind == "overheat":
            servo.health.temperature = servo.table.get(reg.TEMPERATURE_LIMIT) + 5.0
        elif kind == "overload":
            servo.fail(5)
        elif kind == "undervoltage":
            servo.health.voltage = (model.voltage_min - 10) * reg.VOLTAGE_UNIT
        elif kind == "stuck":
            servo.stick()
        elif kind == "jump":
            servo.jump()
        elif kind == "frozen":
            servo.frozen = True
        elif kind == "refuse":
            servo.refuses = True
        elif kind == "recover":
            servo.recover()
        else:
            servo.silent = kind == "silent"

    def report(self, t: float) -> list[dict[str, Any]]:
        """Each servo's state, and what it was told since the record began."""
        self.advance(t)
        return [servo.report(t) for servo in self.servos]

    def forget(self, t: float) -> None:
        """Begin the record anew."""
        for servo in self.servos:
            servo.forget(t)

    # --- instructions ----------------------------------------------------------------------

    def _status(self, servo: EmulatedServo, error: int, data: bytes = b"") -> Reply:
        # The alert bit is taken after the instruction was done.
        return Reply(servo.return_delay, protocol.status(servo.id, error | servo.alert, data))

    def _answers(self, packet: Packet, servos: list[EmulatedServo], t: float) -> list[Reply]:
        instruction = packet.instruction
        if packet.id == BROADCAST:
            return self._broadcast(packet, servos, t)
        if instruction == protocol.STATUS:
            return []  # another servo's answer, or our own echo
        handler = self._unicast.get(instruction, self._unknown)
        replies = []
        for servo in servos:
            if servo.id == packet.id:
                level, delay, name = servo.status_return_level, servo.return_delay, servo.id
                error, data = handler(servo, packet.parameters, t)
                needed = {protocol.PING: 0, protocol.READ: 1}.get(instruction, 2)
                if level >= needed:
                    # ID and delay as they were when the instruction came.
                    status = protocol.status(name, error | servo.alert, data)
                    replies.append(Reply(delay, status))
            elif servo.shadow_id == packet.id and instruction != protocol.PING:
                handler(servo, packet.parameters, t)
        return self._at_once(replies, servos)

    def _broadcast(self, packet: Packet, servos: list[EmulatedServo], t: float) -> list[Reply]:
        instruction, data = packet.instruction, packet.parameters
        if instruction == protocol.PING:
            replies = []
            for servo_id in sorted({servo.id for servo in servos}):
                same = [servo for servo in servos if servo.id == servo_id]
                answers = [self._status(servo, *self._ping(servo, data, t)) for servo in same]
                replies += self._at_once(answers, same)
            return replies
        if instruction in (protocol.SYNC_READ, protocol.FAST_SYNC_READ):
            if len(data) < 5:
                return []
            address, length = _word(data, 0), _word(data, 2)
            wanted = [(servo_id, address, length) for servo_id in data[4:]]
            return self._group_read(wanted, servos, t, instruction == protocol.FAST_SYNC_READ)
        if instruction in (protocol.BULK_READ, protocol.FAST_BULK_READ):
            if len(data) % 5:
                return []
            wanted = [
                (data[i], _word(data, i + 1), _word(data, i + 3)) for i in range(0, len(data), 5)
            ]
            return self._group_read(wanted, servos, t, instruction == protocol.FAST_BULK_READ)
        if instruction == protocol.SYNC_WRITE:
            self._sync_write(data, servos, t)
        elif instruction == protocol.BULK_WRITE:
            self._bulk_write(data, servos, t)
        elif instruction in self._unicast and instruction != protocol.READ:
            if instruction == protocol.FACTORY_RESET and data == b"\xff":
                servos = [servo for servo in servos if servo.firmware < _FACTORY_RESET_GUARD]
            for servo in servos:
                self._unicast[instruction](servo, data, t)
        return []

    def _group_read(
        self,
        wanted: list[tuple[int, int, int]],
        servos: list[EmulatedServo],
        t: float,
        fast: bool,
    ) -> list[Reply]:
        by_id = {servo.id: servo for servo in servos}
        if len(by_id) < len(servos):
            return self._shared_read(wanted, servos, t)
        if len({servo_id for servo_id, _, _ in wanted}) < len(wanted):
            return []  # an ID may stand in the list once only
        replies: list[Reply] = []
        if fast:
            length = 1 + sum([length + 4 for _, _, length in wanted])
            piece = protocol.fast_head(length)
        block = b""
        crc, delay = 0, 0.0
        for servo_id, address, length in wanted:
            servo = by_id.get(servo_id)
            if servo is None or servo.status_return_level < 1 or (fast and not servo.fast_reads):
                break
            data = servo.read(address, length, t)
            error = protocol.OK if data is not None else protocol.ACCESS
            if not fast:
                replies.append(self._status(servo, error, data or b""))
                continue
            # Each CRC goes over all bytes before it, the earlier CRCs too.
            piece += bytes((error | servo.alert, servo_id))
            piece += bytes(length) if data is None else data
            crc = crc16(piece, crc)
            block += piece
            piece = crc.to_bytes(2, "little")
            delay += servo.return_delay
        if not block:
            return replies
        # The blocks follow each other as one packet; the delays before them add up.
        return [Reply(delay, block + piece)]

    def _shared_read(
        self, wanted: list[tuple[int, int, int]], servos: list[EmulatedServo], t: float
    ) -> list[Reply]:
        """A group read where several servos have one ID: they talk at once, fast read or not."""
        replies: list[Reply] = []
        for servo_id, address, length in wanted:
            same = [servo for servo in servos if servo.id == servo_id]
            if not same:
                break
            answers = [
                self._status(servo, protocol.OK, servo.read(address, length, t) or b"")
                for servo in same
            ]
            replies += self._at_once(answers, same)
        return replies

    def _at_once(self, replies: list[Reply], servos: list[EmulatedServo]) -> list[Reply]:
        """Replies of servos that share an ID come as one, garbled."""
        if len(replies) < 2:
            return replies
        data = collide([reply.data for reply in replies], servos[0].baud, self._jitter)
        return [Reply(min(reply.delay for reply in replies), data)]

    def _sync_write(self, data: bytes, servos: list[EmulatedServo], t: float) -> None:
        if len(data) < 4:
            return
        address, length = _word(data, 0), _word(data, 2)
        size = length + 1
        if length == 0 or (len(data) - 4) % size:
            return
        for i in range(4, len(data), size):
            for servo in servos:
                if data[i] in (servo.id, servo.shadow_id):
                    servo.write(address, data[i + 1 : i + size], t)

    def _bulk_write(self, data: bytes, servos: list[EmulatedServo], t: float) -> None:
        i = 0
        while i + 5 <= len(data):
            servo_id, address, length = data[i], _word(data, i + 1), _word(data, i + 3)
            values = data[i + 5 : i + 5 + length]
            if len(values) < length:
                return
            for servo in servos:
                if servo_id in (servo.id, servo.shadow_id):
                    servo.write(address, values, t)
            i += 5 + length

    def _ping(self, servo: EmulatedServo, _: bytes, t: float) -> tuple[int, bytes]:
        return protocol.OK, servo.model.number.to_bytes(2, "little") + bytes((servo.firmware,))

    def _read(self, servo: EmulatedServo, data: bytes, t: float) -> tuple[int, bytes]:
        if len(data) != 4:
            return protocol.DATA_LENGTH, b""
        values = servo.read(_word(data, 0), _word(data, 2), t)
        return (protocol.ACCESS, b"") if values is None else (protocol.OK, values)

    def _write(self, servo: EmulatedServo, data: bytes, t: float) -> tuple[int, bytes]:
        if len(data) < 3:
            return protocol.DATA_LENGTH, b""
        return servo.write(_word(data, 0), data[2:], t), b""

    def _reg_write(self, servo: EmulatedServo, data: bytes, t: float) -> tuple[int, bytes]:
        if len(data) < 3:
            return protocol.DATA_LENGTH, b""
        return servo.register(_word(data, 0), data[2:]), b""

    def _factory_reset(self, servo: EmulatedServo, data: bytes, t: float) -> tuple[int, bytes]:
        if len(data) != 1:
            return protocol.DATA_LENGTH, b""
        return servo.factory_reset(data[0], t), b""

    def _reboot(self, servo: EmulatedServo, _: bytes, t: float) -> tuple[int, bytes]:
        servo.reboot(t)
        return protocol.OK, b""

    def _unknown(self, servo: EmulatedServo, _: bytes, t: float) -> tuple[int, bytes]:
        return protocol.INSTRUCTION_ERROR, b""


def _word(data: bytes, at: int) -> int:
    return data[at] | data[at + 1] << 8
