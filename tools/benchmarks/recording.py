"""Ten readers of the stream, one of them stuck, and a recorder; then recordings read again.

A real daemon at 1 kHz publishes every state and two sensors' frames at 100 Hz, for ten minutes.
What counts: messages the recorder lost, the publish step, memory and processor time.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfinger.daemon.client import Hand
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, HandFacts, SensorFacts
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.packer import message_maker
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.report import Row, row
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.writer import RecordingWriter

_SECONDS = 600.0
_SHORTER = 60.0  # of the recorder of every topic, and of the loop on its own processor
_READERS = 9  # that read, beside the one that doesn't
_FRAMES = 5_000
_HOUR = 3600  # s
_TICK = 1.0 / os.sysconf("SC_CLK_TCK")

_TOPICS = ("state", "tactile", "event", "stats", "settings", "command")

_READER = """
import sys, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.subscribe("hand/state")
socket.subscribe("hand/tactile")
socket.connect(sys.argv[1])
while True:
    socket.recv_multipart()
"""
_STUCK = """
import sys, time, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.subscribe("hand/state")
socket.subscribe("hand/tactile")
socket.connect(sys.argv[1])
time.sleep(1e6)
"""


def measure(seconds: float = _SECONDS, hour: float = _HOUR) -> list[Row]:
    """All of it: the live part, the frames' pass, the summary of ``hour`` s at 1 kHz."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        return [*_live(place, seconds), *_analysis(place), *_summary(place, hour)]


def _single(name: str, value: float, unit: str, aim: float | None = None, n: int = 1) -> Row:
    return Row(name, unit, value, value, n, aim)


def _live(folder: Path, seconds: float) -> list[Row]:
    shorter = min(seconds, _SHORTER)
    with _readers(folder / "beside", apart=False) as (stream, daemon):
        file = folder / "run.mcap"
        cost = _recorded(file, stream, _TOPICS, seconds, daemon)
        every = _recorded(folder / "all.mcap", stream, ("all",), shorter, daemon)
    recording = Recording(file)
    readers = f"{_READERS + 1} readers, one stuck, and a recorder at 1 kHz"
    rows = [
        _publishing(f"{readers}, {seconds:.0f} s: publish", file),
        _single("messages recorded a second", recording.total / recording.duration, "1/s"),
        _single("messages lost by the recorder", cost.lost, "1", 0.0, recording.total),
        _single("recorder, of a core", 100.0 * cost.share, "%", 5.0),
        _single("recorder of every topic, hand/input and hand/truth too", 100.0 * every.share, "%"),
        _single("messages lost by that", every.lost, "1", 0.0),
        _single("recorder, memory grown", cost.grown / 2**20, "MiB"),
        _single("daemon, memory grown", cost.beside / 2**20, "MiB"),
    ]
    if len(os.sched_getaffinity(0)) > 1:
        with _readers(folder / "apart", apart=True) as (stream, daemon):
            file = folder / "apart.mcap"
            _recorded(file, stream, _TOPICS, shorter, daemon)
        told = f"{shorter:.0f} s of that, the loop on a processor of its own: publish"
        rows.insert(1, _publishing(told, file))
    return rows


def _publishing(name: str, file: Path) -> Row:
    """The publish step [µs], median and 99 %, as the daemon told it last."""
    recording = Recording(file)
    (*_, told) = (message["publish"] for _, message in recording.messages([schema.STATS]))
    return Row(name, "µs", 1e6 * told["p50"], 1e6 * told["p99"], recording.total, 15.0)


@contextlib.contextmanager
def _readers(folder: Path, apart: bool) -> Iterator[tuple[str, int]]:
    """A daemon and its readers: the stream's address and the daemon's process.

    With ``apart`` the loop has a processor that nobody else here may use.
    """
    folder.mkdir()
    stream, commands = (f"ipc://{folder}/{name}" for name in ("stream", "commands"))
    words = [f"stream.address={stream}", f"commands.address={commands}"]
    words += ["loop.rate=1000", "stream.state_rate=1000", "tactile.rate=100", "task.name=demo"]
    processors = os.sched_getaffinity(0)
    own = max(processors)
    if apart:
        words.append(f"realtime.cpus=[{own}]")
    daemon = ["run"]
    for word in words:
        daemon += ["--set", word]
    try:
        if apart:  # what is started from here on inherits it
            os.sched_setaffinity(0, processors - {own})
        with contextlib.ExitStack() as stack:
            running = stack.enter_context(_process(daemon))
            with Hand(stream, commands, timeout=120.0) as hand:
                hand.state()
                stack.enter_context(_script(_STUCK, stream))
                for _ in range(_READERS):
                    stack.enter_context(_script(_READER, stream))
                yield stream, running.pid
    finally:
        os.sched_setaffinity(0, processors)


class _Cost(NamedTuple):
    share: float  # of a core
    grown: float  # bytes of memory
    beside: float  # that the daemon's has grown by meanwhile
    lost: float  # messages


def _recorded(
    file: Path, stream: str, topics: tuple[str, ...], seconds: float, daemon: int
) -> _Cost:
    """What a recorder costs over ``seconds``."""
    words = ["record", str(file), "--address", stream, "--topics", *topics]
    with _process(words) as recorder:
        while not file.exists():
            time.sleep(0.05)
        time.sleep(2.0)  # what starts up is not what is measured
        kept, beside = _memory(recorder.pid), _memory(daemon)
        used, began = _cpu(recorder.pid), time.monotonic()
        time.sleep(seconds)
        share = (_cpu(recorder.pid) - used) / (time.monotonic() - began)
        grown, beside = _memory(recorder.pid) - kept, _memory(daemon) - beside
        recorder.send_signal(signal.SIGINT)
        out, _ = recorder.communicate(timeout=60)
    return _Cost(share, grown, beside, _lost(out))


def _lost(out: str) -> float:
    for line in out.splitlines():
        if "lost on the way: " in line:
            parts = line.split("lost on the way: ")[1]
            return float(sum(int(p.split()[0]) for p in parts.split(", ") if p[0].isdigit()))
    return float("nan")


def _analysis(folder: Path) -> list[Row]:
    from softfinger.tools.analysis.contacts import analyse
    from softfinger.tools.analysis.sources import open_source

    path = folder / "frames.mcap"
    tip, pitch = Fingertip(0.020), 0.058 / 44
    grid = SensorGrid(rows=44, cols=44, pitch=pitch)
    noise = np.random.default_rng(1)
    press = [grid.pressure(tip, Material.table_i(), d, 0.1, 0.0) for d in np.linspace(0, 5e-3, 50)]
    writer = RecordingWriter(path)
    facts = HandFacts("", Settings().model_dump_json(), "", "", "", "")
    writer.add(schema.SETTINGS, message_maker(schema.SETTINGS)(1, 1e9, 1.0, facts))
    sensor = SensorFacts(pitch, pitch, 0.0, 0.0, 0.0, "count", 4.0, False, "")
    tactile = message_maker(schema.TACTILE)
    for k in range(_FRAMES):
        pressure = press[abs(k // 5 % 98 - 49)]
        counts = np.clip(pressure / 4.0 + noise.normal(0.0, 380.0, pressure.shape), 0.0, 65535.0)
        data = counts.astype(np.uint16)
        frame = Frame(k + 1, 0.01 * k, 0.01 * k, True, data)
        writer.add(schema.TACTILE, tactile(frame, data, 0, sensor, 1e9 + 0.01 * k))
    writer.close()
    times = []
    source = open_source(path, Settings(), None, own=True)
    for _ in range(3):
        began = time.process_time()
        analyse(source, lambda done: None)
        times.append(1e6 * (time.process_time() - began) / _FRAMES)
    return [row("analyse, a recorded frame (20,000 a second: 50 µs)", "µs", times, 50.0)]


def _summary(folder: Path, hour: float) -> list[Row]:
    path = folder / "hour.mcap"
    count = round(hour * 1000)
    writer = RecordingWriter(path)
    state = {"schema": 1, "seq": 0, "timestamp": 0.0, "padding": "x" * 1200}  # as long as a state
    for k in range(count):
        writer.add(schema.STATE, {**state, "seq": k, "timestamp": 1e9 + 1e-3 * k})
        if k % 500 == 0:
            writer.flush()  # as `record` does twice a second
    writer.close()
    began = time.perf_counter()
    recording = Recording(path)
    elapsed = time.perf_counter() - began
    assert recording.total == count
    return [_single(f"{hour:.0f} s of states at 1 kHz, opened", elapsed, "s", 2.0, count)]


@contextlib.contextmanager
def _process(words: list[str]) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "softfinger", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.communicate(timeout=30)


@contextlib.contextmanager
def _script(code: str, address: str) -> Iterator[None]:
    process = subprocess.Popen([sys.executable, "-c", code, address])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _cpu(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK


def _memory(pid: int) -> float:
    """Resident memory of a process [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
