"""Campaign: each fault many times on an emulated hand and its daemon, each trial seeded.

For each: the safe state and the time to it, the fault's name, goals within their limits on the
servos' wire (by the emulated hand's own record), no crash, no hang, and a hand that grips again. On
a busy machine a trial may go otherwise than expected; what must never be stands apart.
"""

from __future__ import annotations

import contextlib
import math
import random
import resource
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.benchmarks.measuring import Report, Row
from softfinger.tools.benchmarks.rigs import Rig, RigError, stopped

# Begins a fault; what it returns ends the fault.
End = Callable[[], object]
Inject = Callable[[Rig, random.Random], End]
# works: it goes on gripping. fault: torque off by a fault. lets go: the joints stay where they are,
# without a fault. dies: the daemon is gone, the servos stop by themselves. stops: `stop` is sent,
# and no motor is driven in time, with a fault or without.
Expect = Literal["works", "fault", "lets go", "dies", "stops"]

_TRIALS = 100
_SHOWN = 5  # failures that are listed of each case
_GIVE_UP = 3  # trials in a row whose set-up failed
_SLACK = 0.05  # s by which a poll may lag, and a process be late
_RESOLUTION = 0.0016  # rad, a count of the servo's
_CURRENT_UNIT = 0.0027  # A
_READY_WITHIN = 30.0  # s
_GRIPPING = ("grasping", "holding", "rotating")
_TURN = 0.08  # rad

_SETTINGS = Settings()
_WATCHDOG = _SETTINGS.servos.watchdog + 0.02  # the servo counts in steps of 20 ms
_AT_ONCE = 0.03
_SILENT = _SETTINGS.servos.fault_after + _AT_ONCE
_FRAMES = _SETTINGS.safety.frame_age_fault / 100.0 + 0.01 + _AT_ONCE  # of a board of 100 Hz
_FROZEN = _SETTINGS.safety.frozen_after + 0.05  # judged in turn
_STOP = 0.2  # s from a stop to no motor driven
_SAME = 0.3  # s in which a hand that holds may send the same goal, of which none is missed
_ROOM = 1 << 18  # bytes that a daemon without memory may still take


@dataclass(frozen=True)
class FaultCase:
    """One kind of fault, injected into a hand that grips."""

    name: str
    expect: Expect
    inject: Inject
    names: tuple[str, ...] = ()  # of the fault that may latch
    within: float = 0.0  # s in which no motor must be driven any more, where it faults
    lasts: float = 3.0  # s, at most, that it is watched
    holding_only: bool = False  # the hand must hold; else it may be closing or turning, too


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


def _killed(rig: Rig, chance: random.Random) -> End:
    rig.end_daemon(signal.SIGKILL)
    return rig.start_daemon


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


_works = partial(FaultCase, expect="works", lasts=0.3)
_fault = partial(FaultCase, expect="fault")
_silent = partial(_fault, names=("servos.silent",), within=_SILENT)
_blind = partial(_fault, names=("tactile.silent",), within=_FRAMES)

CASES: tuple[FaultCase, ...] = (
    _works("replies dropped, 10%", inject=_sent("drop=0.1")),
    _works("replies corrupted, 10%", inject=_sent("corrupt=0.1")),
    _silent("replies dropped, 100%", inject=_sent("drop=1")),
    _silent("one servo silent", inject=_servo("silent={}", "answer={}"), within=_WATCHDOG),
    _silent("one servo rebooted", inject=_servo("reboot={}", "")),
    _silent("one servo overheated", inject=_servo("overheat={0}", "recover={0} reboot={0}"),
            names=("servos.alert", "servos.temperature")),
    _fault("one servo's encoder jumped", inject=_servo("jump={}", "recover={}"),
           names=("joint.jump",), within=_AT_ONCE),
    _fault("one servo's readings frozen", inject=_servo("frozen={}", "recover={}"),
           names=("servos.frozen",), within=0.12 + _AT_ONCE),
    _fault("writes lost, 100%", inject=_sent("lose-writes=1"), names=("goal.lost",),
           within=_SAME + 0.05 + _STOP),
    FaultCase("stop, 90% lost each way", "stops", _sent("lose=0.9 drop=0.9"), within=_STOP),
    _fault("servos' port gone and back", inject=_sent("unplug", "plug"), names=("servos.bus",),
           within=_WATCHDOG),
    _blind("board silent", inject=_board("{}:silent")),
    _blind("board torn, 100%", inject=_board("{}:torn=1")),
    _blind("board's port gone and back", inject=_board("{}:unplug", "{}:plug")),
    _fault("board frozen", inject=_board("{}:frozen"), names=("tactile.frozen",), within=_FROZEN,
           holding_only=True),
    FaultCase("board zero", "lets go", _board("{}:zero"), lasts=0.4, holding_only=True),
    FaultCase("daemon killed", "dies", _killed, within=_WATCHDOG),
    _fault("daemon stood still for 2 s", inject=_stood_still,
           names=("servos.bus", "servos.silent", "tactile.silent"), within=_WATCHDOG, lasts=4.0),
    _works("daemon without memory", inject=_without_memory),
)  # fmt: skip
NAMES = tuple(case.name for case in CASES)


@dataclass
class Trial:
    """The outcome of one injection."""

    seed: int
    phase: str = ""
    fault: str = ""  # its name
    fault_s: float = math.nan  # until the daemon published it
    safe_s: float = math.nan  # until no motor was driven any more
    wrong: str = ""  # what must never be
    missed: str = ""  # what was not as expected, and may be the busy machine's doing

    @property
    def failure(self) -> str:
        """The first thing that was not as it must be, with the phase."""
        text = self.wrong or self.missed
        return f"{self.phase}: {text}" if text else ""


def measure(trials: int | None = None, only: str = "") -> list[Report]:
    """Every fault whose name ``only`` is found in."""
    rows, notes, failed = [], [], False
    with Rig() as rig:
        for case in CASES:
            if only not in case.name:
                continue
            found = run_trials(trials or _TRIALS, partial(trial, rig, case))
            row = summary(case, found)
            print(f"{case.name}: {row['passed']} of {row['trials']}", file=sys.stderr, flush=True)
            rows.append(row)
            wrong = [f"seed {each.seed}, {each.failure}" for each in found if each.failure]
            notes += [f"  {case.name}, {failure}" for failure in wrong[:_SHOWN]]
            failed = failed or bool(wrong)
    return [Report("fault", rows, notes=tuple(notes), failed=failed)]


def run_trials(trials: int, one: Callable[[int], Trial]) -> list[Trial]:
    """Return ``trials`` of ``one(seed)``; a RigError is a failed one, three in a row end them."""
    found: list[Trial] = []
    in_a_row = 0
    while len(found) < trials and in_a_row < _GIVE_UP:
        seed = len(found) + 1
        try:
            found.append(one(seed))
            in_a_row = 0
        except RigError as error:
            found.append(Trial(seed, wrong=f"the set-up failed: {error}"))
            in_a_row += 1
    return found


def summary(case: FaultCase, found: list[Trial]) -> Row:
    """Return counts, and times [ms] of those trials that have them: median and greatest."""
    row: Row = {
        "name": case.name,
        "expected": case.expect,
        "passed": sum(not each.failure for each in found),
        "trials": len(found),
    }
    for key, times in (
        ("fault ms", [each.fault_s for each in found]),
        ("motors off ms", [each.safe_s for each in found]),
    ):
        seen = 1e3 * np.array([time for time in times if np.isfinite(time)])
        row[key] = float(np.median(seen)) if seen.size else None
        row[f"{key} at most"] = float(seen.max()) if seen.size else None
    row["allowed ms"] = 1e3 * case.within or None
    counts = Counter(each.fault for each in found if each.fault)
    row["faults"] = ", ".join(f"{fault} {count}" for fault, count in counts.items())
    return row


def trial(rig: Rig, case: FaultCase, seed: int) -> Trial:
    """Inject once. Raises RigError when the set-up itself fails."""
    chance = random.Random(f"{case.name} {seed}")
    found = Trial(seed)
    rig.start()
    if not _ready(rig, chance):
        raise RigError(f"the hand does not grip: {rig.status()}")
    found.phase = "holding" if case.holding_only else chance.choice(_GRIPPING)
    if found.phase == "grasping":
        rig.ask({"command": "grasp", "force": chance.uniform(4.0, 9.0)})
    elif found.phase == "rotating":
        rig.ask({"command": "rotate", "angle": chance.uniform(-_TURN, _TURN)})
    time.sleep(chance.uniform(0.0, 0.02))
    rig.states(0.0)
    rig.report("forget")
    end = case.inject(rig, chance)
    try:
        _watch(rig, case, found)
    finally:
        end()
    judge_wire(rig, found)
    if not rig.alive:
        status = None if rig.daemon is None else rig.daemon.returncode
        found.wrong = f"the daemon ended with {status}: {' | '.join(rig.log()[-2:])}"
    elif rig.status(2.0) is None:
        found.wrong = "the daemon does not answer"
    judge(case, found)
    if not _ready(rig, chance):
        found.wrong = found.wrong or f"no working hand afterwards: {rig.status()}"
        rig.end_daemon()
        rig.end_hand()
    return found


def _ready(rig: Rig, chance: random.Random) -> bool:
    """Bring the hand to hold; False when it does not.

    Faults are cleared, and the object is put between open fingers: it may have slipped out of them
    or turned over.
    """
    end = time.monotonic() + _READY_WITHIN
    opened = False
    while time.monotonic() < end and rig.alive:
        mode = (rig.status(2.0) or {"mode": ""})["mode"]
        with contextlib.suppress(NoAnswer):
            if mode == "holding":
                return True
            if mode == "fault":
                rig.ask({"command": "clear"}, 5.0)
            elif mode == "disarmed":
                rig.ask({"command": "arm"}, 5.0)
            elif mode == "armed" and not opened:
                opened = rig.ask({"command": "release"}, 5.0)["ok"]
            elif mode == "armed":
                rig.send("place")
                opened = False
                rig.ask({"command": "grasp", "force": chance.uniform(4.0, 9.0)}, 5.0)
        time.sleep(0.01)
    return False


def _watch(rig: Rig, case: FaultCase, found: Trial) -> None:
    """Watch states and wire until it is clear what comes of the fault, or it has lasted."""
    begin = time.monotonic()
    modes = set()
    if case.expect == "stops":
        with contextlib.suppress(NoAnswer):
            rig.ask({"command": "stop"})
    while time.monotonic() < begin + case.lasts:
        for state in rig.states():
            t = state["mono_ns"] * 1e-9
            if state["fault"] and not found.fault and t > begin - 0.1:
                found.fault, found.fault_s = state["fault_name"], t - begin
            modes.add(state["mode"])
            judge_age(rig, state, found)
        report = rig.report()
        if stopped(report) and math.isnan(found.safe_s):
            found.safe_s = report["monotonic"] - begin
        safe = not math.isnan(found.safe_s)
        if safe and (found.fault or case.expect in ("dies", "stops")):
            return
        if case.expect == "lets go" and "armed" in modes:
            return
    if case.expect == "lets go":
        found.missed = f"the joints did not stay where they were: {', '.join(sorted(modes))}"


def judge_age(rig: Rig, state: dict[str, Any], found: Trial) -> None:
    """Torque never on in a grip on frames older than their limit."""
    if not state["torque"] or state["fault"] or state["mode"] not in _GRIPPING:
        return
    settings = rig.settings
    most = settings.safety.frame_age_fault / settings.tactile.rate
    most += settings.simulation.tactile_delay + settings.tactile.latency + 0.01
    for side in ("left", "right"):
        age = state[side]["frame_age_s"]
        if age > most:
            found.wrong = f"{state['mode']} on a frame {age:.3f} s old"


def judge_wire(rig: Rig, found: Trial) -> None:
    """No goal outside its limits, no torque without packets, none switched on far from its goal.

    Judged from the emulated hand's record with arithmetic of its own.
    """
    settings = rig.settings
    hand, most = settings.hand, settings.safety.current_max + _CURRENT_UNIT
    for i, servo in enumerate(rig.report()["servos"]):
        q, current = servo["goal_q"], servo["goal_current"]
        low, high = hand.q_min[i] - _RESOLUTION, hand.q_max[i] + _RESOLUTION
        if q is not None and not (low <= q[0] and q[-1] <= high):
            found.wrong = f"goal angles {q} rad on the wire"
        if current is not None and not all(abs(each) <= most for each in current):
            found.wrong = f"goal currents {current} A on the wire"
        if servo["torque_on"]["far"]:
            found.wrong = f"torque on {servo['torque_on']['farthest']:.3f} rad off its goal"
        quiet, limit = servo["longest_quiet"], settings.servos.watchdog + 0.02
        if quiet > limit + _SLACK and not servo["watchdog_fired"]["count"]:
            found.wrong = f"torque on for {quiet:.3f} s without a packet"
        if servo["goals_refused"] and not servo["watchdog_fired"]["count"]:
            found.wrong = f"{servo['goals_refused']} goals that the servo refused"


def judge(case: FaultCase, found: Trial) -> None:
    """Compare with what was expected, and its time."""
    safe = not math.isnan(found.safe_s)
    if case.expect in ("works", "lets go"):
        if found.fault:
            found.missed = f"{found.fault} after {found.fault_s:.3f} s"
        elif safe:
            found.missed = f"no motor was driven after {found.safe_s:.3f} s"
    elif not found.fault and case.expect == "fault":
        found.missed = "no fault"
    elif found.fault and case.expect != "stops" and found.fault not in case.names:
        found.missed = f"{found.fault} instead of {' or '.join(case.names)}"
    elif not safe:
        found.missed = "motors were driven on"
    elif not found.safe_s <= case.within + _SLACK:
        found.missed = f"motors driven for {found.safe_s:.3f} s, {case.within:.3f} s allowed"
