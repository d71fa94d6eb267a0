"""The whole tick over bytes: the daemon on the emulated hand, through the real SDK and pyserial."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import load
from softfinger.tools.benchmarks.framework.report import Report, figure
from softfinger.tools.benchmarks.framework.rigs import HIL, emulator

PAGE = {"hardware in the loop": ("tick",)}
_SCRIPT: tuple[tuple[float, dict[str, Any]], ...] = (
    (0.2, {"command": "arm"}),
    (0.5, {"command": "grasp", "force": 10.0}),
)


def measure(brief: bool = False) -> list[Report]:
    """Ticks of a hand that grasps and holds over ptys, unpaced [µs]."""
    seconds = 3.0 if brief else 10.0
    with tempfile.TemporaryDirectory() as name, emulator(Path(name), HIL):
        settings = load(HIL, Path(name))
        with Daemon(settings, wire=False) as daemon:
            loop, clock = daemon.loop, daemon.clock
            loop.run(0.05)
            script = list(_SCRIPT)
            compute, late, cpu = [], [], time.process_time()
            start = deadline = clock.now()
            while deadline < start + seconds:
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
            share = (time.process_time() - cpu) / (clock.now() - start)
            loop.command({"command": "stop"})
            loop.tick(clock.now())
            rows = [
                figure(f"tick at {1.0 / loop.period:g} Hz, unpaced ptys", "µs", compute),
                figure("wake-up after the deadline", "µs", late),
                figure("processor share of the daemon's process", "%", [100.0 * share]),
            ]
    return [Report("hardware in the loop", rows)]
