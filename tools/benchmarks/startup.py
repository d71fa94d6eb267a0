"""Start-up: from starting the process to the first published state, with cold and warm kernels."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import zmq

from tools.benchmarks.report import Row, row

_STATE = "tcp://127.0.0.1:19874"
_COMMANDS = "tcp://127.0.0.1:19875"
_WARM_RUNS = 5


def measure() -> list[Row]:
    """Seconds to the first ``hand/state`` of the built-in simulated hand."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "bench.toml"
        config.write_text(f'stream.address = "{_STATE}"\ncommands.address = "{_COMMANDS}"\n')
        environment = os.environ | {
            "NUMBA_CACHE_DIR": f"{folder}/kernels",
            "XDG_CACHE_HOME": f"{folder}/cache",
        }
        cold = _start(config, environment)
        warm = [_start(config, environment) for _ in range(_WARM_RUNS)]
    return [
        row("start to first state, cold kernel cache", "s", [cold]),
        row("start to first state, warm kernel cache", "s", warm, aim=1.0),
    ]


def _start(config: Path, environment: dict[str, str]) -> float:
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, b"hand/state")
    socket.setsockopt(zmq.RECONNECT_IVL, 5)  # ms: the wait for the connection is not the daemon's
    socket.connect(_STATE)
    before = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", "run", "--config", str(config)],
        env=environment,
        stderr=subprocess.DEVNULL,
    )
    try:
        while not socket.poll(1000):
            if process.poll() is not None:
                raise RuntimeError(f"the daemon ended with status {process.returncode}")
        return time.perf_counter() - before
    finally:
        process.terminate()
        process.wait()
        socket.close(linger=0)
        context.term()
