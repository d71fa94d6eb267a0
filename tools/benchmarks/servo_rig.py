"""Emulated servos in processes of their own, and the cycles that are measured on them."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk

from daemon.clock import RealClock
from daemon.profiles import load
from daemon.records import Goal, Reading
from daemon.servos import registers as reg
from daemon.servos.dynamixel import DynamixelServos
from daemon.settings import Settings

PROFILE = """\
tactile.backend = "none"
[servos]
backend = "dynamixel"
port = "{dir}/servos"
"""
_SPAN = reg.PRESENT_POSITION + 4 - reg.PRESENT_CURRENT
BITS_PER_BYTE = 10
_PRIORITY = 40  # of SCHED_FIFO: below the kernel's own threads at 50


@contextlib.contextmanager
def urgent(process: int = 0) -> Iterator[bool]:
    """SCHED_FIFO for a process (this one is 0) and no deep idle states; whether it was allowed.

    What else runs on the machine then holds nothing up but the kernel's own work.
    """
    before = os.sched_getscheduler(process), os.sched_getparam(process)
    try:
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        yield False
        return
    try:
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):
                latency = stack.enter_context(Path("/dev/cpu_dma_latency").open("wb", buffering=0))
                latency.write(bytes(4))
            yield True
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(process, *before)


@contextlib.contextmanager
def emulated(baud: int = 0, hurry: bool = False) -> Iterator[Path]:
    """The folder of two emulated servos: ``baud`` 0 unpaced, else with the wire's time.

    ``hurry``: :func:`urgent` as far as that is allowed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "servos.toml"
        config.write_text(PROFILE)
        command = [sys.executable, "-m", "tools.cli", "emulate", "--dir", name]
        process = subprocess.Popen(
            [*command, "--config", str(config), "--baud", str(baud)],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("the emulated servos did not start")
            with urgent(process.pid) if hurry else contextlib.nullcontext():
                yield folder
        finally:
            process.terminate()
            process.wait()


class OurCycle:
    """The daemon's own: one read and one write of all servos, torque on."""

    def __init__(self, folder: Path, baud: int = 2_000_000) -> None:
        settings = load(folder / "servos.toml", folder)
        # No bus watchdog: the line is quiet while another way of driving it has its turn.
        servos = settings.servos.model_copy(update={"baud": baud, "watchdog": 0.0})
        self.settings: Settings = settings.model_copy(update={"servos": servos})
        self.servos = DynamixelServos(self.settings, RealClock())
        self.servos.connect()
        self.servos.set_torque(True)
        self.reading = Reading()
        self.goal = Goal(q=[0.05, 0.05], current=[0.3, 0.3])
        self.failed = 0

    def __call__(self) -> None:
        """One cycle."""
        self.servos.read(self.reading)
        self.failed += not self.reading.valid
        self.servos.write(self.goal)

    def bytes(self) -> Traffic:
        """What one cycle puts on the wire."""
        line = self.servos._line
        assert line is not None
        port = line.port
        sent, received = 0, 0
        write, fill = port.writePort, port.fill

        def counted_write(packet: Any) -> int:
            nonlocal sent
            sent += len(packet)
            return int(write(packet))

        def counted_fill() -> bool:
            nonlocal received
            before = len(port.received)
            came = fill()
            received += len(port.received) - before
            return came

        port.writePort, port.fill = counted_write, counted_fill  # type: ignore[method-assign]
        try:
            self()
        finally:
            del port.writePort, port.fill
        return Traffic(sent, received)

    def close(self) -> None:
        """Torque off, port closed."""
        self.servos.close()


@dataclass(frozen=True)
class Traffic:
    """Bytes of one cycle."""

    sent: int
    received: int

    def seconds(self, baud: int) -> float:
        """Their own time on the wire."""
        return (self.sent + self.received) * BITS_PER_BYTE / baud


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
