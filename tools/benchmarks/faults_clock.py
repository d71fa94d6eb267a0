"""The wall clock stepped by an hour under a daemon that grips.

This machine's clock is other programs' too, so the daemon's loop runs in this process, on a clock
whose wall steps; time.time, which libraries may ask, steps with it. The stand-in hand is a process
of its own as ever.
"""

from __future__ import annotations

import contextlib
import math
import random
import time
from collections.abc import Iterator
from unittest import mock

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.tools.benchmarks.faults_rig import Rig, RigError, stopped
from softfinger.tools.benchmarks.faults_trials import Trial, judge_wire

STEPS = {"clock stepped by +1 h": 3600.0, "clock stepped by -1 h": -3600.0}
_BEFORE = 0.04  # s, at most
_AFTER = 0.2  # s
_READY_WITHIN = 15.0  # s
_NEXT = {"fault": "clear", "disarmed": "arm", "armed": "grasp"}
_NEAR = 0.1  # s


class _Wall:
    """Unix time [s], as far off as was stepped."""

    def __init__(self) -> None:
        self.offset = 0.0
        self._true = time.time

    def __call__(self) -> float:
        return self._true() + self.offset


class ClockRig:
    """A stand-in hand, and the daemon's loop in this process."""

    def __init__(self, rig: Rig, daemon: Daemon, wall: _Wall) -> None:
        self._rig = rig
        self._loop = daemon.loop
        self._wall = wall

    def trial(self, name: str, seed: int) -> Trial:
        """Step the wall clock once. Raises RigError when the hand does not grip."""
        chance = random.Random(f"{name} {seed}")
        found = Trial(seed, "holding")
        loop, rig = self._loop, self._rig
        self._hold()
        loop.advance(chance.uniform(0.0, _BEFORE))
        rig.put_aside()
        rig.report(forget=True)
        begin = time.monotonic()
        self._wall.offset += STEPS[name]
        seq = loop.state.seq
        loop.advance(_AFTER)
        passed = time.monotonic() - begin
        found.aside_s = rig.put_aside()
        judge_wire(rig, found)
        report = rig.report()
        if abs(loop.state.wall - self._wall()) > _NEAR:
            found.wrong = f"states of {loop.state.wall:.1f} s, the wall says {self._wall():.1f} s"
        if loop.state.fault:
            found.fault, found.fault_s = loop.state.fault_name, math.nan
            found.missed = f"{loop.state.fault_name}: {loop.state.fault}"
        elif stopped(report):
            found.missed = "no motor was driven any more"
        elif not 0.5 < (loop.state.seq - seq) * loop.period / passed < 1.1:
            found.missed = f"{loop.state.seq - seq} ticks in {passed:.3f} s"
        return found

    def _hold(self) -> None:
        loop, end = self._loop, time.monotonic() + _READY_WITHIN
        while loop.state.mode != "holding":
            if time.monotonic() > end:
                raise RigError(f"the hand does not grip: {loop.state.mode} {loop.state.fault}")
            name = _NEXT.get(str(loop.state.mode))
            with contextlib.suppress(Refused):
                if name is not None:
                    loop.command({"command": name})
            loop.advance(0.02)


@contextlib.contextmanager
def clock_rig() -> Iterator[ClockRig]:
    """Ready for trials."""
    wall = _Wall()
    with Rig() as rig:
        rig.start_hand()
        with Daemon(rig.settings) as daemon:
            daemon.loop.advance(0.1)
            with (
                mock.patch.object(time, "time", wall),
                mock.patch.object(daemon.clock, "wall", wall),
            ):
                yield ClockRig(rig, daemon, wall)
                daemon.loop.command({"command": "stop"})
                daemon.loop.advance(0.02)
