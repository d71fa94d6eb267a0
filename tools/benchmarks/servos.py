"""The servos' share of a tick: a read and a write of two servos over a pty, beside the plain SDK.

Paced, the emulated servos take the wire's own time; what is above it is ours and the machine's.
Hardware in the loop is measured with it: whole ticks against an emulated hand. Beside both stands
what the kernel takes for the same bytes, between two processes that do nothing else: over a pty;
and over sockets, which need no worker of the kernel, without real-time priority, to carry them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import numpy as np

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.types import Goal, Reading
from softfinger.tools.benchmarks.measuring import Report, Row, figure, timed
from softfinger.tools.benchmarks.rigs import HIL, emulator, hold, must_hold

TITLE = "read + write of two servos"
IN_THE_LOOP = "hardware in the loop"
PROFILE = """\
tactile.backend = "none"
[servos]
backend = "dynamixel"
port = "{dir}/servos"
"""
# Fast sync read of 2 × 10 bytes, its reply, and a sync write of 2 × 6.
_BITS = 10 * (16 + 36 + 28)
_IN_TURN = 20  # cycles
_RATES = (1, 2, 4)  # Mbaud
_LONGEST = 10.0  # s for bare bytes
_PATIENCE = 0.2  # s for a reply, whose deadline is not what is measured


def measure(brief: bool = False) -> list[Report]:
    """Wall and processor time a cycle, with the real-time measures of the daemon's defaults."""
    with RealTime(Settings()):
        rows = unpaced(10 if brief else 100)
        for mbaud in _RATES[1:2] if brief else _RATES:
            rows += at_rate(mbaud, 200 if brief else 1500)
    cycles = Report(TITLE, rows, page=("unpaced", "a pty", "2 Mbaud"))
    try:
        return [cycles, in_the_loop(10 if brief else 60)]
    except SoftfingerError as error:  # as on a machine that is busy elsewhere
        return [cycles, Report(IN_THE_LOOP, [], notes=(str(error),), failed=True)]


def unpaced(turns: int) -> list[Row]:
    """Ours and the plain SDK's, each on emulated servos of its own, and bare bytes, in turns."""
    with (
        emulated() as near,
        OurCycle(near) as ours,
        emulated() as far,
        PlainCycle(far) as plain,
        Bare("a pty") as terminal,
        Bare("sockets") as sockets,
    ):
        cycles: dict[str, OurCycle | PlainCycle | Bare] = {
            "unpaced": ours,
            "unpaced, plain SDK": plain,
            "a pty alone": terminal,
            "sockets alone": sockets,
        }
        wall: dict[str, list[float]] = {name: [] for name in cycles}
        busy: dict[str, list[float]] = {name: [] for name in cycles}
        for _ in range(turns):
            for name, cycle in cycles.items():
                before = time.thread_time_ns()
                wall[name] += timed(cycle, _IN_TURN)
                busy[name].append((time.thread_time_ns() - before) * 1e-3 / _IN_TURN)
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
        samples = np.array(timed(cycle, cycles))
        must_have_worked(cycle.failed, cycles)
    return [
        figure(f"{mbaud} Mbaud: cycle, {wire:.0f} µs on the wire", "µs", samples),
        figure(f"{mbaud} Mbaud: over the bytes' own time", "×", samples / wire, 1.15),
    ]


def in_the_loop(turns: int) -> Report:
    """Ticks of a hand that holds over unpaced ptys, and what its servos' exchanges take.

    In turns on one emulated hand: ticks; ticks with bare bytes halfway between them, so that those
    are sent after a sleep, too; and the servos' cycles back to back, the measure of all.
    """
    samples: dict[str, list[float]] = {}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(emulator(folder, HIL))
        bare = [stack.enter_context(Bare(kind)) for kind in ("a pty", "sockets")]
        daemon = stack.enter_context(Daemon(load(HIL, folder), wire=False))
        stack.enter_context(RealTime(daemon.settings))
        loop, clock, state = daemon.loop, daemon.clock, daemon.loop.state
        hold(daemon)
        servos: Any = loop.servos
        loop.servos = shared = _Timed(servos)

        def cycle() -> None:
            servos.read(state.reading)
            servos.write(state.goal)

        deadline = clock.now()
        for turn in range(turns):
            between = bare[turn % 2]
            for k in range(2 * _IN_TURN):
                deadline = max(deadline + loop.period, clock.now())
                clock.sleep_until(deadline)
                shared.spent = 0.0
                tick = timed(lambda: loop.tick(clock.now()))
                if k >= _IN_TURN:
                    clock.sleep_until(deadline + 0.5 * loop.period)
                    samples.setdefault(f"{between.kind} alone", []).extend(timed(between))
                    continue
                samples.setdefault("tick", []).extend(tick)
                samples.setdefault("its read + write", []).append(shared.spent)
            samples.setdefault("read + write back to back", []).extend(timed(cycle, _IN_TURN))
        must_hold(daemon)
        loop.command({"command": "stop"})
        loop.tick(clock.now())
    base = float(np.median(samples["read + write back to back"]))
    rows = [
        figure(name, "µs", found, 1.5 * base if name == "tick" else None)
        for name, found in sorted(samples.items(), key=lambda item: item[0] != "tick")
    ]
    for row in rows:
        row["× back to back"] = row["median"] / base
    return Report(f"{IN_THE_LOOP}, {1.0 / loop.period:g} Hz", rows, page=("",))


class _Timed:
    """Servos, and the time that was spent in their reads and writes [µs]."""

    def __init__(self, servos: Any) -> None:
        self._servos = servos
        self.spent = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servos, name)

    def read(self, reading: Reading) -> None:
        before = time.perf_counter_ns()
        self._servos.read(reading)
        self.spent += (time.perf_counter_ns() - before) * 1e-3

    def write(self, goal: Goal) -> None:
        before = time.perf_counter_ns()
        self._servos.write(goal)
        self.spent += (time.perf_counter_ns() - before) * 1e-3


class Bare:
    """As many bytes to and fro as a cycle has, between two processes that do nothing else."""

    _PEER = """\
import os, select
while select.select((0,), (), ())[0]:
    if os.read(0, 4096)[-1:] == b"?":
        os.write(0, bytes(36))
"""

    def __init__(self, kind: str) -> None:
        """``kind``: over ``a pty`` or ``sockets``."""
        self.kind = kind
        if kind == "a pty":
            far, self._end = os.openpty()
            tty.setraw(self._end)
        else:
            far, self._end = (each.detach() for each in socket.socketpair())
        self._peer = subprocess.Popen((sys.executable, "-c", self._PEER), stdin=far)
        os.close(far)

    def __enter__(self) -> Bare:
        return self

    def __call__(self) -> None:
        end = (self._end,)
        os.write(self._end, b"?" * 16)
        left = 36
        while left > 0:
            if not select.select(end, (), (), _LONGEST)[0]:
                raise RuntimeError(f"{self.kind}: no answer within {_LONGEST:g} s")
            left -= len(os.read(self._end, 4096))
        os.write(self._end, b"!" * 28)

    def __exit__(self, *_: object) -> None:
        self._peer.kill()
        self._peer.wait()
        os.close(self._end)


def must_have_worked(failed: int, count: int) -> None:
    """RuntimeError for more failures than a machine that is busy elsewhere makes."""
    if failed > 0.02 * count:
        raise RuntimeError(f"{failed} of {count} cycles failed")


@contextlib.contextmanager
def emulated(baud: int = 0) -> Iterator[Path]:
    """The folder of two emulated servos: ``baud`` 0 unpaced, else with the wire's time."""
    with tempfile.TemporaryDirectory() as name:
        config = Path(name, "servos.toml")
        config.write_text(PROFILE)
        with emulator(Path(name), config, "--baud", str(baud)):
            yield Path(name)


class OurCycle:
    """The daemon's own: one read and one write of all servos, torque on."""

    def __init__(self, folder: Path, baud: int = 2_000_000) -> None:
        settings = load(folder / "servos.toml", folder)
        # No bus watchdog: the line is quiet while the other way of driving it has its turn.
        change = {"baud": baud, "watchdog": 0.0, "reply_timeout": _PATIENCE}
        servos = settings.servos.model_copy(update=change)
        settings = settings.model_copy(update={"servos": servos})
        self._servos = DynamixelServos(settings, RealClock(settings.realtime.spin))
        logging.disable(logging.WARNING)  # of no watchdog
        self._servos.connect()
        logging.disable(logging.NOTSET)
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
