"""Start-up: from starting the process to the first published state, with cold and warm kernels.

Time and memory (peak resident set) of the daemon and, when cold, of the largest of the processes
that compile for it; the size of what is kept.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import zmq

from softfinger.tools.benchmarks.report import Row, row

_STATE = "tcp://127.0.0.1:19874"
_COMMANDS = "tcp://127.0.0.1:19875"
_WARM_RUNS = 5


class _Start(NamedTuple):
    seconds: float
    daemon: float  # bytes
    worker: float


def measure() -> list[Row]:
    """Seconds to the first ``hand/state`` of the built-in simulated hand, and what it takes."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "bench.toml"
        config.write_text(f'stream.address = "{_STATE}"\ncommands.address = "{_COMMANDS}"\n')
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        environment.pop("NUMBA_CACHE_DIR", None)
        cold = _start(config, environment)
        warm = [_start(config, environment) for _ in range(_WARM_RUNS)]
        kept = sum(file.stat().st_size for file in Path(folder, "softfinger").rglob("*"))
    return [
        row("start to first state, cold kernel cache", "s", [cold.seconds], aim=15.0),
        row(
            "start to first state, warm kernel cache", "s", [each.seconds for each in warm], aim=0.8
        ),
        row("daemon's peak memory, cold", "MB", [cold.daemon / 1e6], aim=300.0),
        row("daemon's peak memory, warm", "MB", [each.daemon / 1e6 for each in warm], aim=150.0),
        row("a compiling process's peak memory", "MB", [cold.worker / 1e6]),
        row("kept on disk", "MB", [kept / 1e6]),
    ]


def _start(config: Path, environment: dict[str, str]) -> _Start:
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, b"hand/state")
    socket.setsockopt(zmq.RECONNECT_IVL, 5)  # ms: the wait for the connection is not the daemon's
    socket.connect(_STATE)
    before = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "softfinger", "run", "--config", str(config)],
        env=environment,
        stderr=subprocess.DEVNULL,
    )
    largest = 0.0
    try:
        while not socket.poll(200):
            if process.poll() is not None:
                raise RuntimeError(f"the daemon ended with status {process.returncode}")
            largest = max([largest, *map(_peak, _children(process.pid))])
        return _Start(time.perf_counter() - before, _peak(process.pid), largest)
    finally:
        process.terminate()
        process.wait()
        socket.close(linger=0)
        context.term()


def _peak(process: int) -> float:
    """Its largest resident set so far [bytes]; 0 when it has ended."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0.0
    _, found, rest = status.partition("VmHWM:")
    return 1024.0 * float(rest.split()[0]) if found else 0.0


def _children(process: int) -> list[int]:
    try:
        return [
            int(word)
            for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()
        ]
    except OSError:
        return []
