"""Start-up: from starting the process to the first published state, with cold and warm kernels.

Time and memory (peak resident set) of the daemon and, when cold, of the largest of the processes
that compile for it; the size of what is kept.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import zmq

from softfinger.tools.benchmarks.measuring import Report, figure
from softfinger.tools.benchmarks.rigs import SOFTFINGER


class Start(NamedTuple):
    """What one start took."""

    seconds: float
    daemon: float  # MB
    worker: float  # MB


def measure(brief: bool = False) -> list[Report]:
    """Seconds to the first ``hand/state`` of the built-in simulated hand, and what it takes."""
    with tempfile.TemporaryDirectory() as name:
        cold = start(Path(name))
        warm = [start(Path(name)) for _ in range(2 if brief else 5)]
        kept = sum(file.stat().st_size for file in Path(name, "softfinger").rglob("*"))
    seconds = [
        figure("cold kernel cache", "s", [cold.seconds], aim=15.0),
        figure("warm kernel cache", "s", [each.seconds for each in warm], aim=0.8),
    ]
    memory = [
        figure("daemon's peak, cold", "MB", [cold.daemon], aim=300.0),
        figure("daemon's peak, warm", "MB", [each.daemon for each in warm], aim=150.0),
        figure("a compiling process's peak", "MB", [cold.worker]),
        figure("kernels on disk", "MB", [kept / 1e6]),
    ]
    return [
        Report("start to the first state", seconds, page=("",)),
        Report("memory", memory, page=("daemon",)),
    ]


def start(folder: Path, *words: str) -> Start:
    """One start with this folder for kernels and tables; ``words`` go to ``softfinger run``."""
    stream = f"ipc://{folder}/stream"
    addresses = {"stream.address": stream, "commands.address": f"ipc://{folder}/commands"}
    words += tuple(w for key, value in addresses.items() for w in ("--set", f"{key}={value}"))
    environment = os.environ | {"XDG_CACHE_HOME": str(folder)}
    for each in ("NUMBA_CACHE_DIR", "PYTHONDONTWRITEBYTECODE"):  # a user has neither
        environment.pop(each, None)
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.subscribe("hand/state")
        socket.setsockopt(zmq.LINGER, 0)
        # ms: the wait for the connection is not the daemon's
        socket.setsockopt(zmq.RECONNECT_IVL, 5)
        socket.connect(stream)
        before = time.perf_counter()
        process = subprocess.Popen(
            [*SOFTFINGER, "run", *words], env=environment, stderr=subprocess.DEVNULL
        )
        largest = 0.0
        try:
            while not socket.poll(200):
                if process.poll() is not None:
                    raise RuntimeError(f"the daemon ended with status {process.returncode}")
                largest = max([largest, *map(_peak, _children(process.pid))])
            return Start(time.perf_counter() - before, _peak(process.pid), largest)
        finally:
            process.terminate()
            process.wait()


def _peak(process: int) -> float:
    """Its largest resident set so far [MB]; 0 when it has ended."""
    with contextlib.suppress(OSError):
        _, found, rest = Path(f"/proc/{process}/status").read_text().partition("VmHWM:")
        if found:
            return 1024e-6 * float(rest.split()[0])
    return 0.0


def _children(process: int) -> list[int]:
    with contextlib.suppress(OSError):
        return list(map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split()))
    return []
