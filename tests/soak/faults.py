"""Faults that a soak gives an emulated hand and its daemon, and a judge of the servos' wire."""

from __future__ import annotations

import random
import resource
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from softfinger.tools.benchmarks.rigs import Rig

# Begins a fault; what it returns ends the fault.
End = Callable[[], object]
Inject = Callable[[Rig, random.Random], End]

_SLACK = 0.05  # s by which a process may be late
_RESOLUTION = 0.0016  # rad, a count of the servo's
_CURRENT_UNIT = 0.0027  # A
_ROOM = 1 << 18  # bytes that a daemon without memory may still take


def _sent(begin: str, end: str = "well", *, places: tuple[Any, ...] = ("",)) -> Inject:
    """Words for the emulated hand that begin the fault and end it; ``{}`` is one of ``places``."""

    def inject(rig: Rig, chance: random.Random) -> End:
        place = chance.choice(places)
        rig.send(begin.format(place))
        return lambda: rig.send(end.format(place)) if end else None

    return inject


_servo = partial(_sent, places=(1, 2))


def _board(begin: str, end: str = "{}:well") -> Inject:
    return _sent(begin, end, places=("left", "right"))


def _stood_still(rig: Rig, chance: random.Random) -> End:
    """The daemon's process is stopped for 2 s, then goes on."""
    assert rig.daemon is not None
    rig.daemon.send_signal(signal.SIGSTOP)
    timer = threading.Timer(2.0, rig.daemon.send_signal, (signal.SIGCONT,))
    timer.start()
    return timer.join


def _without_memory(rig: Rig, chance: random.Random) -> End:
    """The daemon may take next to no address space any more, and is asked meanwhile."""
    assert rig.daemon is not None
    process = rig.daemon.pid
    _, hard = resource.prlimit(process, resource.RLIMIT_AS)
    size = int(Path(f"/proc/{process}/statm").read_text().split()[0]) * resource.getpagesize()
    resource.prlimit(process, resource.RLIMIT_AS, (size + _ROOM, hard))
    for _ in range(5):
        rig.status()
        time.sleep(chance.uniform(0.0, 0.02))
    return lambda: rig.alive and resource.prlimit(process, resource.RLIMIT_AS, (hard, hard))


CASES: dict[str, Inject] = {
    "replies dropped, 10%": _sent("drop=0.1"),
    "replies corrupted, 10%": _sent("corrupt=0.1"),
    "replies dropped, 100%": _sent("drop=1"),
    "one servo silent": _servo("silent={}", "answer={}"),
    "one servo rebooted": _servo("reboot={}", ""),
    "one servo overheated": _servo("overheat={0}", "recover={0} reboot={0}"),
    "one servo's readings frozen": _servo("frozen={}", "recover={}"),
    "writes lost, 100%": _sent("lose-writes=1"),
    "90% lost each way": _sent("lose=0.9 drop=0.9"),
    "servos' port gone and back": _sent("unplug", "plug"),
    "board silent": _board("{}:silent"),
    "board torn, 100%": _board("{}:torn=1"),
    "board's port gone and back": _board("{}:unplug", "{}:plug"),
    "board frozen": _board("{}:frozen"),
    "board zero": _board("{}:zero"),
    "daemon stood still for 2 s": _stood_still,
    "daemon without memory": _without_memory,
}


def judge_wire(rig: Rig) -> str:
    """Return what was wrong on the servos' wire, by the emulated hand's record; or an empty text.

    No goal may be outside its limits, no torque be without packets or switched on far from its
    goal.
    """
    settings = rig.settings
    wrong = ""
    hand, most = settings.hand, settings.safety.current_max + _CURRENT_UNIT
    for i, servo in enumerate(rig.report()["servos"]):
        q, current = servo["goal_q"], servo["goal_current"]
        low, high = hand.q_min[i] - _RESOLUTION, hand.q_max[i] + _RESOLUTION
        if q is not None and not (low <= q[0] and q[-1] <= high):
            wrong = f"goal angles {q} rad on the wire"
        if current is not None and not all(abs(each) <= most for each in current):
            wrong = f"goal currents {current} A on the wire"
        if servo["torque_on"]["far"]:
            wrong = f"torque on {servo['torque_on']['farthest']:.3f} rad off its goal"
        quiet, limit = servo["longest_quiet"], settings.servos.watchdog + 0.02
        if quiet > limit + _SLACK and not servo["watchdog_fired"]["count"]:
            wrong = f"torque on for {quiet:.3f} s without a packet"
        if servo["goals_refused"] and not servo["watchdog_fired"]["count"]:
            wrong = f"{servo['goals_refused']} goals that the servo refused"
    return wrong
