"""The whole tick over bytes: the daemon on the stand-in hand, through the real SDK and pyserial."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.loop import Loop
from softfinger.daemon.profile.load import load
from softfinger.tools.benchmarks.report import Row, row

_SECONDS = 10.0
_EMULATE = ("-m", "softfinger", "emulate")
_PROFILE = Path(__file__).parents[2] / "config" / "hil.toml"


def measure() -> list[Row]:
    """Ticks of a hand that grasps and holds over ptys, unpaced, in µs."""
    with tempfile.TemporaryDirectory() as folder:
        emulator = subprocess.Popen(
            [sys.executable, *_EMULATE, "--dir", folder, "--config", str(_PROFILE)],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert emulator.stdout is not None
            if emulator.stdout.readline().strip() != "ready":
                raise RuntimeError("the stand-in hand did not start")
            settings = load(_PROFILE, Path(folder))
            with Daemon(settings, wire=False) as daemon:
                return _hold(daemon.loop, daemon)
        finally:
            emulator.terminate()
            emulator.wait()


def _hold(loop: Loop, daemon: Daemon) -> list[Row]:
    script: list[tuple[float, dict[str, Any]]] = [
        (0.2, {"command": "arm"}),
        (0.5, {"command": "grasp", "force": 10.0}),
    ]
    compute, late, cpu = [], [], time.process_time()
    loop.run(0.05)
    clock = daemon.clock
    start = deadline = clock.now()
    while deadline < start + _SECONDS:
        clock.sleep_until(deadline)
        now = clock.now()
        if script and now > start + script[0][0]:
            loop.command(script.pop(0)[1])
        loop.tick(now)
        compute.append((clock.now() - now) * 1e6)
        late.append((now - deadline) * 1e6)
        deadline = max(deadline + loop.period, clock.now())
    if loop.state.mode != "holding":
        raise RuntimeError(f"the hand did not hold: {loop.state.mode} {loop.state.fault}")
    loop.command({"command": "stop"})
    loop.tick(clock.now())
    share = (time.process_time() - cpu) / (clock.now() - start)
    rate = 1.0 / loop.period
    return [
        row(f"hardware-in-the-loop tick at {rate:g} Hz, unpaced pty", "µs", compute),
        row("  its wake-up after the deadline", "µs", late),
        row("  processor share of the daemon's process", "%", [100.0 * share]),
    ]
