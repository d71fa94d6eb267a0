"""Fuzz the emulated servo bus with random and mutated packets."""

import random
import struct

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import crc16
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, PacketParser, frame
from softfinger.daemon.simulation.servo_model.servo import REBOOT_TIME, EmulatedServo
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from tests.fuzz import Report, mutated
from tests.harness.servos import make_bus

SEEDS = (
    frame(1, framing.READ, struct.pack("<HH", 0, 147)),
    frame(2, framing.WRITE, struct.pack("<HI", reg.GOAL_POSITION, 9)),
    frame(1, framing.WRITE, struct.pack("<HB", reg.OPERATING_MODE, 4)),
    frame(1, framing.REG_WRITE, struct.pack("<HB", reg.SHADOW_ID, 2)),
    frame(BROADCAST, framing.ACTION),
    frame(1, framing.REBOOT),
    frame(2, framing.CLEAR, b"\x01DXL\x22"),
    frame(2, framing.FACTORY_RESET, b"\x02"),
    frame(BROADCAST, framing.PING),
    frame(BROADCAST, framing.SYNC_READ, struct.pack("<HHBB", 126, 10, 1, 2)),
    frame(BROADCAST, framing.FAST_SYNC_READ, struct.pack("<HHBB", 120, 27, 1, 2)),
    frame(BROADCAST, framing.SYNC_WRITE, struct.pack("<HHBBBB", 64, 1, 1, 1, 2, 1)),
    frame(BROADCAST, framing.BULK_READ, struct.pack("<BHHBHH", 1, 132, 4, 2, 146, 1)),
    frame(BROADCAST, framing.FAST_BULK_READ, struct.pack("<BHHBHH", 1, 132, 4, 2, 146, 1)),
    frame(BROADCAST, framing.BULK_WRITE, struct.pack("<BHHIBHHB", 1, 116, 4, 7, 2, 64, 1, 1)),
)


def fuzz(count: int, seed: int) -> Report:
    """Feed ``count`` packets to two servos; propagate exceptions from the bus."""
    source = random.Random(seed)
    bus = make_bus()
    t = 0.0
    for _ in range(count):
        packet = mutated(source, source.choice(SEEDS))
        if source.random() < 0.7:  # Most packets get a valid CRC, so that the bus processes them.
            packet = packet[:-2] + crc16(packet[:-2]).to_bytes(2, "little")
        t += source.choice((0.0, 0.0002, 0.002, 0.02))
        bus.feed(packet, t)
    t += REBOOT_TIME + 0.1
    bus.advance(t)
    silent = [k for k, servo in enumerate(bus.servos) if not _answers_alone(bus, servo, t)]
    return Report(bus.packets, [f"servo {k} is silent" for k in silent])


def _answers_alone(bus: ServoBus, servo: EmulatedServo, t: float) -> bool:
    """Return True if the servo replies to a ping while all other servos are silent.

    The other servos are silenced, because two servos may have the same ID.
    """
    for each in bus.servos:
        each.silent = each is not servo
    servo.table.set(reg.PROTOCOL_TYPE, 2)  # An earlier write may have selected Protocol 1.0.
    found = PacketParser().feed(bus.feed(frame(BROADCAST, framing.PING), t), 0.0)
    return [packet.id for packet in found] == [servo.id]
