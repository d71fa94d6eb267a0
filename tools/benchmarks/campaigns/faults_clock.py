"""The wall clock stepped by an hour under a daemon that grips.

This machine's clock is other programs' too, so the daemon's loop runs in this process, on a clock
whose wall steps; time.time, which libraries may ask, steps with it. The emulated hand is a process
of its own as ever.
"""

from __future__ import annotations

import contextlib
import math
import random
import time
from collections.abc import Callable, Iterator
from unittest import mock

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.loop import Loop
from softfinger.tools.benchmarks.campaigns.faults_rig import Rig, stopped
from softfinger.tools.benchmarks.campaigns.faults_trials import Trial, judge_wire
from softfinger.tools.benchmarks.framework.campaign import RigError

STEPS = {"clock stepped by +1 h": 3600.0, "clock stepped by -1 h": -3600.0}
_BEFORE = 0.04  # s, at most
_AFTER = 0.2  # s
_READY_WITHIN = 15.0  # s
_NEXT = {"fault": "clear", "disarmed": "arm", "armed": "grasp"}
_NEAR = 0.1  # s


@contextlib.contextmanager
def clock_rig() -> Iterator[Callable[[str, int], Trial]]:
    """A trial of a named step by its seed. It raises RigError when the hand does not grip."""
    true, offset = time.time, 0.0

    def wall() -> float:
        return true() + offset

    def trial(name: str, seed: int) -> Trial:
        nonlocal offset
        chance = random.Random(f"{name} {seed}")
        found = Trial(seed, "holding")
        _hold(loop)
        loop.advance(chance.uniform(0.0, _BEFORE))
        rig.waited()
        rig.report("forget")
        begin, seq = time.monotonic(), loop.state.seq
        offset += STEPS[name]
        loop.advance(_AFTER)
        passed = time.monotonic() - begin
        found.waited_s = rig.waited()
        judge_wire(rig, found)
        if abs(loop.state.wall - wall()) > _NEAR:
            found.wrong = f"states of {loop.state.wall:.1f} s, the wall clock is at {wall():.1f} s"
        if loop.state.fault:
            found.fault, found.fault_s = loop.state.fault_name, math.nan
            found.missed = f"{loop.state.fault_name}: {loop.state.fault}"
        elif stopped(rig.report()):
            found.missed = "no motor was driven any more"
        elif not 0.5 < (loop.state.seq - seq) * loop.period / passed < 1.1:
            found.missed = f"{loop.state.seq - seq} ticks in {passed:.3f} s"
        return found

    with Rig() as rig:
        rig.start_hand()
        with (
            Daemon(rig.settings) as daemon,
            mock.patch.object(time, "time", wall),
            mock.patch.object(daemon.clock, "wall", wall),
        ):
            loop = daemon.loop
            loop.advance(0.1)
            yield trial
            loop.command({"command": "stop"})
            loop.advance(0.02)


def _hold(loop: Loop) -> None:
    end = time.monotonic() + _READY_WITHIN
    while loop.state.mode != "holding":
        if time.monotonic() > end:
            raise RigError(f"the hand does not grip: {loop.state.mode} {loop.state.fault}")
        name = _NEXT.get(str(loop.state.mode))
        with contextlib.suppress(Refused):
            if name is not None:
                loop.command({"command": name})
        loop.advance(0.02)
