"""The tick beside busy neighbours: loaded processors, many subscribers, a recorder, noisy sensors.

One daemon in a process of its own holds an object, on canned readings, so that the tick's cost is
its own; its neighbours come and go in turns, each beside a quiet turn. Then what is kept for a
subscriber that never reads: the publisher's memory, before and after its queue is full.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.daemon.gateway.config import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import parts
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import State
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, Publisher
from softfinger.tools.benchmarks.canned import can, hold, make_noisy
from softfinger.tools.benchmarks.wakeup import may_hurry

_ROUNDS = 5
_SECONDS = 2.0  # of each turn
_PRIORITY = 40  # of SCHED_FIFO
_NOISE_RATE = 200.0  # Hz
_AIM = 1.5  # of the quiet median
_FILL, _MORE = 5_000, 100_000  # messages: until the queue is full, and after that
_KEPT = 2.0  # MiB that memory may grow meanwhile by what is not the queue

_BUSY = "while True: pass"
# Ten subscribers to what tools subscribe to, of which the first never reads; `ready` once they are
# connected.
_SUBSCRIBERS = """
import sys, zmq
context = zmq.Context()
sockets = []
for number in range(10):
    socket = context.socket(zmq.SUB)
    for topic in ("state", "tactile", "event", "stats", "settings", "command"):
        socket.subscribe(f"hand/{topic}")
    socket.connect(sys.argv[1])
    sockets.append(socket)
poller = zmq.Poller()
for socket in sockets[1:]:
    poller.register(socket)
print("ready", flush=True)
while True:
    for socket, _ in poller.poll():
        socket.recv_multipart()
"""
_STUCK = """
import sys, time, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.subscribe("hand")
socket.connect(sys.argv[1])
time.sleep(3600)
"""


@dataclass(frozen=True)
class Beside:
    """The tick's cost beside one kind of neighbour [µs]; ``ratio`` of medians to the quiet one."""

    name: str
    median: float
    p99: float
    late_p99: float
    overruns: int
    ratio: float
    count: int

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {"unit": "µs", "aim": _AIM}


@dataclass(frozen=True)
class Kept:
    """What a subscriber that never reads costs the publisher [MiB]."""

    name: str
    full: float  # more memory once its queue is full
    later: float  # and after many more messages
    bound: float

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {"unit": "MiB"}


def measure(rounds: int = _ROUNDS, seconds: float = _SECONDS) -> list[Beside | Kept]:
    """All neighbours, with the usual scheduling and, where it is allowed, SCHED_FIFO."""
    rows: list[Beside | Kept] = []
    for priority in (0, _PRIORITY) if may_hurry() else (0,):
        rows += _beside(priority, rounds, seconds)
    return [*rows, stuck_subscriber()]


def table(rows: list[Beside | Kept]) -> str:
    """The rows as an aligned table."""
    lines = [f"{'µs':52} {'median':>7} {'p99':>8} {'late p99':>8} {'× quiet':>7} {'overruns':>8}"]
    for row in rows:
        if isinstance(row, Beside):
            lines.append(
                f"{row.name:52} {row.median:7.1f} {row.p99:8.1f} {row.late_p99:8.1f} "
                f"{row.ratio:7.2f} {row.overruns:4d}/{row.count}"
            )
        else:
            lines.append(
                f"{row.name}: {row.full:.1f} MiB once its queue is full, {row.later:.1f} MiB "
                f"after {_MORE} more messages, bound {row.bound:.1f}"
            )
    return "\n".join(lines)


def _beside(priority: int, rounds: int, seconds: float) -> list[Beside]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        address = f"ipc://{folder}/stream"
        holding = stack.enter_context(_daemon(address, priority, noise=False))
        noisy = stack.enter_context(_daemon(f"ipc://{folder}/noisy", priority, noise=True))
        subscribe = [sys.executable, "-c", _SUBSCRIBERS, address]
        busy = [sys.executable, "-c", _BUSY]
        record = [sys.executable, "-m", "softfinger", "record", "--address", address]
        file = str(folder / "run.mcap")
        neighbours: dict[str, tuple[Connection, list[list[str]]]] = {
            "quiet": (holding, []),
            "all processors busy": (holding, [busy] * (os.cpu_count() or 1)),
            "ten subscribers, one never reads": (holding, [subscribe]),
            "a recorder": (holding, [[*record, file]]),
            "a recorder of every topic": (holding, [[*record, "--topics", "all", "--", file]]),
            f"both sensors send noise at {_NOISE_RATE:g} Hz": (noisy, []),
        }
        taken: dict[str, list[Any]] = {name: [] for name in neighbours}
        for _ in range(rounds):
            for name, (link, commands) in neighbours.items():
                with _running(commands):
                    link.send(seconds)
                    taken[name].append(link.recv())
    scheduling = f"SCHED_FIFO {priority}" if priority else "usual scheduling"
    rows: list[Beside] = []
    for name, turns in taken.items():
        compute = np.concatenate([turn[0] for turn in turns])
        late = np.concatenate([turn[1] for turn in turns])
        median = 1e6 * float(np.median(compute))
        rows.append(
            Beside(
                f"tick, {scheduling}, {name}",
                median,
                1e6 * float(np.percentile(compute, 99)),
                1e6 * float(np.percentile(late, 99)),
                sum(turn[2] for turn in turns),
                median / rows[0].median if rows else 1.0,
                len(compute),
            )
        )
    return rows


@contextlib.contextmanager
def _running(commands: list[list[str]]) -> Iterator[None]:
    """Processes that run meanwhile; subscribers say when they are ready, recorders have a file."""
    processes = []
    file = Path(commands[0][-1]) if commands and "record" in commands[0] else None
    try:
        for command in commands:
            process = subprocess.Popen(command, stdout=subprocess.PIPE)
            processes.append(process)
            if _SUBSCRIBERS in command:
                assert process.stdout is not None
                process.stdout.readline()
        while file is not None and not file.exists():
            if processes[0].poll() is not None:
                raise RuntimeError("the recorder did not start")
            time.sleep(0.01)
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
        if file is not None:
            file.unlink(missing_ok=True)


@contextlib.contextmanager
def _daemon(address: str, priority: int, noise: bool) -> Iterator[Connection]:
    """A daemon that answers seconds with the times of its ticks in them, and its overruns."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    process = spawn.Process(target=_serve, args=(there, address, priority, noise))
    process.start()
    there.close()
    try:
        here.recv()  # it holds
        yield here
    finally:
        here.close()
        process.join()


def _serve(link: Connection, address: str, priority: int, noise: bool) -> None:
    settings = Settings.model_validate(
        {
            "stream": {"address": address},
            "commands": {"address": f"{address}-commands"},
            "realtime": {"priority": priority},
        }
    )
    with Daemon(settings) as daemon, RealTime(settings):
        loop = daemon.loop
        if noise:
            loop.advance(0.1)
            can(daemon)
            make_noisy(daemon, _NOISE_RATE)
        else:
            hold(daemon)
            can(daemon)
        compute: list[float] = []
        late: list[float] = []
        tick = loop.tick

        def kept(now: float) -> float:
            done = tick(now)
            late.append(loop.state.timing.wake_late_s)
            compute.append(loop.state.timing.compute_s)
            return done

        loop.tick = kept  # type: ignore[method-assign]
        link.send(True)
        with contextlib.suppress(EOFError):
            while True:
                seconds = link.recv()
                loop.advance(0.3)  # until whoever has connected is seen
                compute.clear()
                late.clear()
                before = loop.state.timing.overruns
                loop.advance(seconds)
                if loop.state.fault:
                    raise RuntimeError(f"the hand has a fault: {loop.state.fault}")
                overruns = loop.state.timing.overruns - before
                link.send((np.array(compute), np.array(late), overruns))


def stuck_subscriber(fill: int = _FILL, more: int = _MORE) -> Kept:
    """The gateway's memory while one subscriber never reads: bounded by its queue."""
    with tempfile.TemporaryDirectory() as folder:
        address = f"ipc://{folder}/stream"
        gateway = Gateway(Config(address, "", GATEWAY_TOPICS, Settings().stream.queue)).wait()
        publisher = Publisher(gateway.link)
        try:
            with _running([[sys.executable, "-c", _STUCK, address]]):
                patience = time.monotonic() + 10.0
                while not publisher.wanted and time.monotonic() < patience:
                    gateway.link.wait(0.1)
                before = _resident(gateway.process)
                _publish(gateway, publisher, fill)
                full = _resident(gateway.process) - before
                _publish(gateway, publisher, more)
                later = _resident(gateway.process) - before
        finally:
            gateway.close()
    return Kept("memory for a subscriber that never reads", full, later, full + _KEPT)


def _publish(gateway: Gateway, publisher: Publisher, count: int) -> None:
    state, scene = State(), parts(Settings())
    for _ in range(count):
        gateway.link.wait_for_room(1.0)
        state.seq += 1
        publisher.state(state, scene)


def _resident(process: int) -> float:
    """Memory of a process [MiB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
