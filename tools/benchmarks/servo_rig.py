"""Emulated servos in processes of their own, and the cycles that are measured on them."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk

from softfinger.daemon.clock import RealClock
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.types import Goal, Reading

PROFILE = """\
tactile.backend = "none"
[servos]
backend = "dynamixel"
port = "{dir}/servos"
"""
_SPAN = reg.PRESENT_POSITION + 4 - reg.PRESENT_CURRENT
BITS_PER_BYTE = 10
_PATIENCE = 0.2  # s


@dataclass(frozen=True)
class Stand:
    """A running emulator."""

    folder: Path
    process: int


@contextlib.contextmanager
def emulated(baud: int = 0) -> Iterator[Stand]:
    """Two emulated servos: ``baud`` 0 unpaced, else with the wire's time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "servos.toml"
        config.write_text(PROFILE)
        command = [sys.executable, "-m", "softfinger", "emulate", "--dir", name]
        process = subprocess.Popen(
            [*command, "--config", str(config), "--baud", str(baud)],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("the emulated servos did not start")
            yield Stand(folder, process.pid)
        finally:
            process.terminate()
            process.wait()


class OurCycle:
    """The daemon's own: one read and one write of all servos, torque on.

    Replies are waited for with patience, which a busy machine may need, or, where it matters, as
    long as the settings have it (``strict``).
    """

    def __init__(self, folder: Path, baud: int = 2_000_000, strict: bool = False) -> None:
        settings = load(folder / "servos.toml", folder)
        # No bus watchdog: the line is quiet while another way of driving it has its turn.
        change = {"baud": baud, "watchdog": 0.0, "reply_timeout": _PATIENCE}
        servos = settings.servos.model_copy(update=change)
        self.deadline = settings.servos.reply_timeout if strict else _PATIENCE  # s, of a reply
        self.settings: Settings = settings.model_copy(update={"servos": servos})
        self.clock = RealClock(self.settings.realtime.spin)
        self.servos = DynamixelServos(self.settings, self.clock)
        self.servos.connect()
        self.servos.torque_on()
        assert self.servos._line is not None
        self.servos._line.port.reply_timeout = self.deadline
        self.reading = Reading()
        self.goal = Goal(q=[0.05, 0.05], current=[0.3, 0.3])
        self.failed = 0

    def __call__(self) -> None:
        """One cycle."""
        self.servos.read(self.reading)
        self.failed += not self.reading.valid
        self.servos.write(self.goal)

    def bytes(self) -> Traffic:
        """What one cycle puts on the wire; one of many reads more than the others."""
        return min((self._counted() for _ in range(3)), key=lambda each: each.received)

    def _counted(self) -> Traffic:
        line = self.servos._line
        assert line is not None
        port = line.port
        sent: list[int] = []
        received = 0
        send, fill = port.send, port.fill

        def counted_send(packet: bytes, *reply: Any) -> bool:
            sent.append(len(packet))
            return send(packet, *reply)

        def counted_fill() -> bool:
            nonlocal received
            before = len(port.received)
            came = fill()
            received += len(port.received) - before
            return came

        port.send, port.fill = counted_send, counted_fill  # type: ignore[assignment, method-assign]
        try:
            self()
        finally:
            del port.send, port.fill
        request, goals = sent
        return Traffic(request, received, goals)

    def close(self) -> None:
        """Torque off, port closed."""
        self.servos.close()


@dataclass(frozen=True)
class Traffic:
    """Bytes of one cycle."""

    request: int
    received: int
    goals: int

    @property
    def parts(self) -> tuple[int, int, int]:
        """Request, reply, write."""
        return self.request, self.received, self.goals

    def seconds(self, baud: int) -> float:
        """Their own time on the wire."""
        return sum(self.parts) * BITS_PER_BYTE / baud


class PlainCycle:
    """The same with the SDK as it comes: fast sync read, two sync writes, its own port handler.

    Two writes, since the indirect map that puts both goals in one is not the SDK's doing.
    """

    def __init__(self, folder: Path, baud: int = 2_000_000) -> None:
        self._port = sdk.PortHandler(str(folder / "servos"))
        if not (self._port.openPort() and self._port.setBaudRate(baud)):
            raise RuntimeError("the plain SDK did not open the port")
        packets = sdk.PacketHandler(2.0)
        for servo in (1, 2):
            packets.write1ByteTxRx(self._port, servo, reg.TORQUE_ENABLE, 1)
        self._read = sdk.GroupSyncRead(self._port, packets, reg.PRESENT_CURRENT, _SPAN)
        self._currents = sdk.GroupSyncWrite(self._port, packets, reg.GOAL_CURRENT, 2)
        self._positions = sdk.GroupSyncWrite(self._port, packets, reg.GOAL_POSITION, 4)
        for servo in (1, 2):
            self._read.addParam(servo)
            self._currents.addParam(servo, [100, 0])
            self._positions.addParam(servo, [0, 8, 0, 0])
        self.failed = 0

    def __call__(self) -> None:
        """One cycle."""
        self.failed += self._read.fastSyncRead() != sdk.COMM_SUCCESS
        for servo in (1, 2):
            for address, size in (
                (reg.PRESENT_CURRENT, 2),
                (reg.PRESENT_VELOCITY, 4),
                (reg.PRESENT_POSITION, 4),
            ):
                self._read.getData(servo, address, size)
            self._currents.changeParam(servo, [100, 0])
            self._positions.changeParam(servo, [0, 8, 0, 0])
        self._currents.txPacket()
        self._positions.txPacket()

    def close(self) -> None:
        """Close the port."""
        self._port.closePort()
