"""Create emulated servo buses, which are called directly or served on a pty by a thread.

Timing tests run the bus in a separate process instead.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

from softfinger.daemon.clock import RealClock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.protocol import SerialPort
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import PacketParser, frame
from softfinger.daemon.simulation.servo_model.servo import EmulatedServo
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.testing.emulated import EmulatedBus, FreeJoints, free_servos

RADIAN = 2.0 * math.pi / COUNTS_PER_TURN


def make_bus(model: str = "XM430-W210", ids: Sequence[int] = (1, 2), **options: Any) -> ServoBus:
    """Return a bus with factory-new servos on free joints, by default at angle 0."""
    return free_servos(model, ids, **options)


def hand_bus(t: float = 0.0, servos: dict[str, Any] | None = None, **options: Any) -> ServoBus:
    """Return a bus of servos on free joints, configured according to the ``servos`` settings."""
    settings = Settings.model_validate({"servos": servos or {}})
    return ServoBus.from_settings(settings, FreeJoints(2, t), t=t, **options)


def backend_settings(path: str, **servos: Any) -> Settings:
    """Return settings for the Dynamixel backend, with timeouts that allow for a busy machine."""
    waits = {"reply_timeout": 1.0, "watchdog": 2.0}
    values = {"backend": "dynamixel", "port": path} | waits | servos
    return Settings.model_validate({"servos": values})


def connected(bus: RunningBus, **servos: Any) -> DynamixelServos:
    """Return a Dynamixel backend connected to a running bus."""
    backend = DynamixelServos(backend_settings(bus.port, **servos), RealClock())
    backend.connect()
    return backend


def lasting_notices(backend: DynamixelServos) -> list[Finding]:
    """Return the notices of `connect`, excluding those about slow replies on a busy machine."""
    return [each for each in backend.notices if "ticks will be late" not in each.text]


class BusClient:
    """Bus client that has its own clock and parses the replies of one servo.

    Without a ``bus``, the client creates factory-new servos; see `make_bus` for the ``options``.
    """

    def __init__(self, bus: ServoBus | None = None, **options: Any) -> None:
        self.bus = bus or make_bus(**options)
        self.t = 0.001

    def send(self, packet_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        return self.bus.feed(frame(packet_id, instruction, parameters), self.t)

    def ask(
        self, instruction: int, parameters: bytes = b"", packet_id: int = 1
    ) -> tuple[int, bytes]:
        """Return (error byte, data) of the only reply."""
        (packet,) = PacketParser().feed(self.send(packet_id, instruction, parameters), 0.0)
        assert packet.valid
        assert packet.instruction == framing.STATUS
        return packet.parameters[0], packet.parameters[1:]

    def read(self, address: int, size: int, packet_id: int = 1) -> int:
        error, data = self.ask(framing.READ, struct.pack("<HH", address, size), packet_id)
        assert error & 0x7F == 0, f"error {error}"
        return int.from_bytes(data, "little", signed=True)

    def write(self, address: int, value: int, size: int, packet_id: int = 1) -> int:
        """Write a register and return the error byte."""
        data = address.to_bytes(2, "little") + value.to_bytes(size, "little", signed=value < 0)
        return self.ask(framing.WRITE, data, packet_id)[0]

    def later(self, seconds: float) -> None:
        self.t += seconds
        self.bus.advance(self.t)


class DirectPort(SerialPort):
    """Port connected directly to a bus, so a reply is available immediately or never.

    The bus reads the time from ``clock``. Without a clock, the bus uses ``t``, which the test sets.
    If a reply is missing, the wait advances ``t`` by the reply timeout. If ``baud`` is 0, the
    servos accept any baud rate.
    """

    def __init__(
        self,
        bus: ServoBus,
        baud: int = 0,
        timeout: float = 0.01,
        t: float = 0.0,
        clock: Callable[[], float] | None = None,
    ) -> None:
        super().__init__("direct", baud or 2_000_000, timeout)
        self.bus = bus
        self.t = t
        self._clock = clock
        self._heard_at = baud

    def openPort(self) -> bool:
        return True

    def send(self, packet: bytes, reply: int = 0, until: float = math.inf) -> bool:
        if reply:
            self.received.clear()
        t = self.t if self._clock is None else self._clock()
        self.received += self.bus.feed(packet, t, self._heard_at)
        return True

    def fill(self) -> bool:
        self.t += self.reply_timeout
        self.deadline = -math.inf
        return False


class RunningBus(EmulatedBus):
    """Bus served by a thread; by default, the settings define the bus's servos."""

    def __init__(self, bus: ServoBus | None = None, baud: int = 0, **options: Any) -> None:
        super().__init__(baud=baud, bus=bus or hand_bus(baud=baud, **options))

    def servo(self, index: int) -> EmulatedServo:
        return self.bus.servos[index]

    def memory(self, index: int) -> bytes:
        """Return a copy of a servo's control table."""
        return self.call(lambda: bytes(self.servo(index).table.memory))
