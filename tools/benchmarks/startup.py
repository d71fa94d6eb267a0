"""Start-up: from starting the process to the first published state, with cold and warm kernels.

Time and memory (peak resident set) of the daemon.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
import time
from pathlib import Path

import zmq

from softfinger.tools.benchmarks.measuring import Report, figure
from softfinger.tools.benchmarks.rigs import SOFTFINGER


def measure(brief: bool = False) -> list[Report]:
    """Return seconds to the simulated hand's first ``hand/state``, and what it takes."""
    with tempfile.TemporaryDirectory() as name:
        cold = start(Path(name))
        warm = [start(Path(name)) for _ in range(2 if brief else 5)]
    seconds = [
        figure("cold kernel cache", "s", [cold[0]], aim=15.0),
        figure("warm kernel cache", "s", [each[0] for each in warm], aim=0.8),
    ]
    memory = [
        figure("daemon's peak, cold", "MB", [cold[1]], aim=300.0),
        figure("daemon's peak, warm", "MB", [each[1] for each in warm], aim=150.0),
    ]
    return [Report("start to the first state", seconds), Report("memory", memory)]


def start(folder: Path) -> tuple[float, float]:
    """Return seconds and MB of one start with this folder for kernels and tables."""
    stream = f"ipc://{folder}/stream"
    addresses = {"stream.address": stream, "commands.address": f"ipc://{folder}/commands"}
    words = [word for key, value in addresses.items() for word in ("--set", f"{key}={value}")]
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
        try:
            while not socket.poll(200):
                if process.poll() is not None:
                    raise RuntimeError(f"the daemon ended with status {process.returncode}")
            return time.perf_counter() - before, _peak(process.pid)
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
