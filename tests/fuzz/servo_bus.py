"""Random and mutated packets against the emulated servo bus.

The tests run a few thousand; ``python -m tests.fuzz.servo_bus --count 1000000`` runs a million.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
import time
from typing import NamedTuple

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.crc import crc16
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, PacketParser, frame
from softfinger.daemon.simulation.servo_model.servo import REBOOT_TIME, EmulatedServo
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from tests.harness.servos import make_bus

SEEDS = (
    frame(1, framing.READ, struct.pack("<HH", 0, 147)),
    frame(2, framing.WRITE, struct.pack("<HI", reg.GOAL_POSITION, 9)),
    frame(1, framing.WRITE, struct.pack("<HB", reg.OPERATING_MODE, 4)),
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


class Report(NamedTuple):
    packets: int  # that came through as packets
    alive: bool  # whether every servo still answers a ping
    slowest: float  # s that the slowest packet took


def mutated(source: random.Random) -> bytes:
    """One of the seeds with up to three bytes changed, removed or put in, or pure noise."""
    if source.random() < 0.05:
        return source.randbytes(source.randrange(40))
    packet = bytearray(source.choice(SEEDS))
    for _ in range(source.randrange(4)):
        kind, at = source.randrange(3), source.randrange(len(packet))
        if kind == 0:
            packet[at] = source.randrange(256)
        elif kind == 1:
            del packet[at]
        else:
            packet.insert(at, source.choice((0xFF, 0xFD, 0, 1, 0x55)))
    if source.random() < 0.7:  # most get a right CRC, so that they come through
        packet[-2:] = crc16(bytes(packet[:-2])).to_bytes(2, "little")
    return bytes(packet)


def fuzz(count: int, seed: int) -> Report:
    """Feed ``count`` packets to two servos; raises whatever the bus raises."""
    source = random.Random(seed)
    bus = make_bus()
    t = slowest = 0.0
    for _ in range(count):
        packet = mutated(source)
        t += source.choice((0.0, 0.0002, 0.002, 0.02))
        begin = time.perf_counter()
        bus.feed(packet, t)
        slowest = max(slowest, time.perf_counter() - begin)
    t += REBOOT_TIME + 0.1
    bus.advance(t)
    alive = all(_answers_alone(bus, servo, t) for servo in bus.servos)
    return Report(bus.packets, alive, slowest)


def _answers_alone(bus: ServoBus, servo: EmulatedServo, t: float) -> bool:
    """To a ping, with the others unplugged: by now they may all have one ID."""
    for each in bus.servos:
        each.silent = each is not servo
    found = PacketParser().feed(bus.feed(frame(BROADCAST, framing.PING), t), 0.0)
    return [packet.id for packet in found] == [servo.id]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    report = fuzz(arguments.count, arguments.seed)
    print(
        f"{arguments.count} fed, {report.packets} came through as packets, slowest "
        f"{report.slowest * 1e3:.2f} ms, servos {'answer' if report.alive else 'ARE SILENT'}"
    )
    return 0 if report.alive else 1


if __name__ == "__main__":
    sys.exit(main())
