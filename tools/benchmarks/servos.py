"""The servos' share of a tick: a read and a write of two servos over a pty, beside the plain SDK.

Paced, the emulated servos take the wire's own time; what is above it is ours and the machine's.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dynamixel_sdk as sdk
import numpy as np

from softfinger.daemon.clock import RealClock
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.simulation.emulator.folder import send_words
from softfinger.daemon.types import Goal, Reading
from softfinger.tools.benchmarks.framework.interleaved import timed
from softfinger.tools.benchmarks.framework.report import Report, Row, figure
from softfinger.tools.benchmarks.framework.rigs import emulator

TITLE = "read + write of two servos"
PAGE = {TITLE: ("unpaced", "2 Mbaud: cycle")}
PROFILE = """\
tactile.backend = "none"
[servos]
backend = "dynamixel"
port = "{dir}/servos"
"""
# Fast sync read of 2 × 10 bytes, its reply, and a sync write of 2 × 6.
_BITS = 10 * (16 + 36 + 28)
_IN_TURN = 20  # cycles
_RATES = (1, 2, 3, 4)  # Mbaud
_PATIENCE = 0.2  # s for a reply, where its deadline is not what is measured


def measure(brief: bool = False) -> list[Report]:
    """Wall and processor time a cycle, and what a missing reply costs.

    With the real-time measures that the daemon takes by default.
    """
    turns, paced, misses = (10, 200, 10) if brief else (100, 1500, 50)
    with RealTime(Settings()):
        rows = unpaced(turns)
        for baud in _RATES[1:2] if brief else _RATES:
            rows += at_rate(baud, paced)
        rows.append(missing_reply(misses))
    return [Report(TITLE, rows)]


def unpaced(turns: int) -> list[Row]:
    """Ours and the plain SDK's in turns, each on emulated servos of its own."""
    with emulated() as near, OurCycle(near) as ours, emulated() as far, PlainCycle(far) as plain:
        cycles: dict[str, OurCycle | PlainCycle] = {"unpaced": ours, "unpaced, plain SDK": plain}
        wall: dict[str, list[float]] = {name: [] for name in cycles}
        busy: dict[str, list[float]] = {name: [] for name in cycles}
        for _ in range(turns):
            for name, cycle in cycles.items():
                samples, processor = _timed(cycle, _IN_TURN)
                wall[name] += samples
                busy[name].append(processor)
        must_have_worked(ours.failed + plain.failed, 2 * turns * _IN_TURN)
    rows = []
    for name in cycles:
        aims = (120.0, 100.0) if name == "unpaced" else (None, None)
        rows.append(figure(f"{name}: cycle", "µs", wall[name], aims[0]))
        rows.append(figure(f"{name}: processor time", "µs", busy[name], aims[1]))
    return rows


def at_rate(mbaud: int, cycles: int) -> list[Row]:
    """A cycle against the time that its bytes take on a wire of this rate."""
    wire = _BITS / mbaud  # µs; the servos' return delay is 0
    with emulated(1_000_000 * mbaud) as folder, OurCycle(folder, 1_000_000 * mbaud) as cycle:
        timed(cycle, 50)
        # From start to start: the bytes of a write are still on the wire when it returns.
        samples, processor = _timed(cycle, cycles)
        must_have_worked(cycle.failed, cycles)
    name = f"{mbaud} Mbaud"
    return [
        figure(f"{name}: cycle, {wire:.0f} µs on the wire", "µs", samples),
        figure(f"{name}: over the bytes' own time", "×", np.array(samples) / wire, 1.15),
        figure(f"{name}: processor time", "µs", [processor], 200.0),
    ]


def missing_reply(misses: int) -> Row:
    """A cycle's time over the deadline of its reply [ms], where a servo is silent."""
    with emulated() as folder, OurCycle(folder, strict=True) as cycle:
        send_words(folder, "silent=2")
        samples = timed(cycle, misses)
        missed = cycle.failed
        send_words(folder, "answer=2")
    if missed < misses - 1:
        raise RuntimeError(f"only {missed} of {misses} replies were missing")
    extra = 1e-3 * np.array(samples[-missed:]) - 1e3 * cycle.deadline
    return figure(f"missing reply, over its deadline of {1e3 * cycle.deadline:g} ms", "ms", extra)


def must_have_worked(failed: int, count: int) -> None:
    """RuntimeError for more failures than a machine that is busy elsewhere makes."""
    if failed > 0.02 * count:
        raise RuntimeError(f"{failed} of {count} cycles failed")


def _timed(cycle: Callable[[], None], count: int) -> tuple[list[float], float]:
    """Wall time of each cycle and the mean processor time of one [µs]."""
    before = time.thread_time_ns()
    samples = timed(cycle, count)
    return samples, (time.thread_time_ns() - before) * 1e-3 / count


@contextlib.contextmanager
def emulated(baud: int = 0) -> Iterator[Path]:
    """The folder of two emulated servos: ``baud`` 0 unpaced, else with the wire's time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "servos.toml"
        config.write_text(PROFILE)
        with emulator(folder, config, "--baud", str(baud)):
            yield folder


class OurCycle:
    """The daemon's own: one read and one write of all servos, torque on.

    A reply is waited for longer than the settings say, unless ``strict``.
    """

    def __init__(self, folder: Path, baud: int = 2_000_000, strict: bool = False) -> None:
        settings = load(folder / "servos.toml", folder)
        self.deadline = settings.servos.reply_timeout if strict else _PATIENCE  # s
        # No bus watchdog: the line is quiet while the other way of driving it has its turn.
        change = {"baud": baud, "watchdog": 0.0, "reply_timeout": self.deadline}
        servos = settings.servos.model_copy(update=change)
        settings = settings.model_copy(update={"servos": servos})
        self._servos = DynamixelServos(settings, RealClock(settings.realtime.spin))
        self._servos.connect()
        self._servos.torque_on()
        self._reading = Reading()
        self._goal = Goal(q=[0.05, 0.05], current=[0.3, 0.3])
        self.failed = 0

    def __enter__(self) -> OurCycle:
        return self

    def __call__(self) -> None:
        self._servos.read(self._reading)
        self.failed += not self._reading.valid
        self._servos.write(self._goal)

    def __exit__(self, *_: object) -> None:
        self._servos.close()


class PlainCycle:
    """The same with the SDK as it comes: fast sync read, two sync writes, its own port handler.

    Two writes, since the indirect map that puts both goals in one is not the SDK's doing.
    """

    def __init__(self, folder: Path, baud: int = 2_000_000) -> None:
        self._port = sdk.PortHandler(str(folder / "servos"))
        if not (self._port.openPort() and self._port.setBaudRate(baud)):
            raise RuntimeError("the plain SDK did not open the port")
        packets = sdk.PacketHandler(2.0)
        span = reg.PRESENT_POSITION + 4 - reg.PRESENT_CURRENT
        self._read = sdk.GroupSyncRead(self._port, packets, reg.PRESENT_CURRENT, span)
        self._currents = sdk.GroupSyncWrite(self._port, packets, reg.GOAL_CURRENT, 2)
        self._positions = sdk.GroupSyncWrite(self._port, packets, reg.GOAL_POSITION, 4)
        for servo in (1, 2):
            packets.write1ByteTxRx(self._port, servo, reg.TORQUE_ENABLE, 1)
            self._read.addParam(servo)
            self._currents.addParam(servo, [100, 0])
            self._positions.addParam(servo, [0, 8, 0, 0])
        self.failed = 0

    def __enter__(self) -> PlainCycle:
        return self

    def __call__(self) -> None:
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

    def __exit__(self, *_: object) -> None:
        self._port.closePort()
