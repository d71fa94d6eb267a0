"""One trial of the fault campaign: grip, inject, look, end it, and make the hand grip again.

What was on the servos' wire is judged from the emulated hand's record with arithmetic of its own.
"""

from __future__ import annotations

import contextlib
import math
import random
import time
from dataclasses import dataclass
from typing import Any

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.tools.benchmarks.campaigns.faults_cases import FaultCase
from softfinger.tools.benchmarks.campaigns.faults_rig import Rig, stopped
from softfinger.tools.benchmarks.framework.campaign import RigError

_SLACK = 0.05  # s that a look may come after what it sees, and a process be late
_WAITED = 0.015  # s between two looks that others took: what is late then is theirs
_RESOLUTION = 0.0016  # rad, a count of the servo's
_CURRENT_UNIT = 0.0027  # A
_READY_WITHIN = 15.0  # s
_PLACE_AFTER = 5.0  # s without a grip: the object has slipped away, and is put back
_TRIPPED = 0.7  # s in which the daemon finds that a servo was stopped
_TRIES = 5
_ASKEW = 0.07  # rad between the faces that the tips feel, above which an object is put upright
_GRIPPING = ("grasping", "holding", "rotating")
_TURN = 0.08  # rad


@dataclass
class Trial:
    """What came of one injection."""

    seed: int
    phase: str = ""
    fault: str = ""  # its name
    fault_s: float = math.nan  # until the daemon published it
    safe_s: float = math.nan  # until no motor was driven any more
    waited_s: float = 0.0  # longest between two looks that others had the processor
    wrong: str = ""  # what must never be
    missed: str = ""  # what was not as expected, and may be the busy machine's doing

    @property
    def disturbed(self) -> bool:
        """Not as expected, while other processes held this one up: no measurement."""
        return bool(self.missed) and not self.wrong and self.waited_s > _WAITED

    @property
    def failure(self) -> str:
        """What was not as it must be, with the phase."""
        text = self.wrong or self.missed
        return f"{self.phase}: {text}" if text else ""


def trial(rig: Rig, case: FaultCase, seed: int) -> Trial:
    """Inject once. Raises RigError when the set-up itself fails."""
    chance = random.Random(f"{case.name} {seed}")
    found = Trial(seed)
    rig.start()
    _grip(rig, case, chance, found)
    with case.inject(rig, chance):
        _look(rig, case, found)
    judge_wire(rig, found)
    _judge_daemon(rig, case, found)
    _judge(case, found)
    stays = case.expect == "works" and not found.failure
    if not stays and not ready(rig, chance):
        found.wrong = found.wrong or f"no working hand afterwards: {rig.status()}"
        _start_anew(rig)
    return found


def _grip(rig: Rig, case: FaultCase, chance: random.Random, found: Trial) -> None:
    """A hand that grips, and an empty record. Raises RigError when that can't be had."""
    for attempt in range(_TRIES):
        if not ready(rig, chance):
            if attempt:
                raise RigError(f"the hand does not grip: {rig.status()}")
            _start_anew(rig)
            continue
        if not _upright(rig):
            _place(rig)
            continue
        found.phase = _phase(rig, case, chance)
        time.sleep(chance.uniform(0.0, 0.02))
        rig.states(0.0)
        rig.waited()
        # A busy machine may have let a servo's watchdog act already; then once more.
        if not any(servo["stopped_by_watchdog"] for servo in rig.report("forget")["servos"]):
            return
        time.sleep(_TRIPPED)
    raise RigError("the servos' watchdogs stop them again and again")


def ready(rig: Rig, chance: random.Random) -> bool:
    """Clear, arm and grasp until the hand holds; False when it does not.

    An object that slipped out of the fingers, or turned over between them, is put back in between,
    as a person would do.
    """
    begin = now = time.monotonic()
    place = begin + _PLACE_AFTER
    grasp = {"command": "grasp", "force": chance.uniform(4.0, 9.0)}
    requests: dict[str, dict[str, Any]]
    requests = {"fault": {"command": "clear"}, "disarmed": {"command": "arm"}, "armed": grasp}
    while now < begin + _READY_WITHIN:
        if not rig.alive:
            return False
        status = rig.status(2.0)
        mode = "" if status is None else status["mode"]
        try:
            if mode == "holding":
                return True
            if now > place:
                place = now + _PLACE_AFTER
                _place(rig)
            elif mode in requests:
                rig.ask(requests[mode], 5.0)
        except NoAnswer:
            pass
        time.sleep(0.01)
        now = time.monotonic()
    return False


def _upright(rig: Rig) -> bool:
    """Whether both tips feel opposite faces: a grip on an edge would end in a fault of its own."""
    states = rig.states(0.1)
    if not states:
        return False
    left, right = states[-1]["left"], states[-1]["right"]
    apart = (left["theta"] - left["q"]) - (right["theta"] + right["q"])
    return bool(abs(apart + rig.settings.object.taper) < _ASKEW)


def _place(rig: Rig) -> None:
    """Put the object back, between open fingers where they can be opened."""
    end = time.monotonic() + 2.0
    if rig.ask({"command": "release"})["ok"]:
        while (status := rig.status()) and status["mode"] == "releasing":
            if time.monotonic() > end:
                break
            time.sleep(0.01)
    rig.send("place")


def _start_anew(rig: Rig) -> None:
    rig.end_daemon()
    if rig.hand is not None:
        rig.hand.terminate()
        rig.hand.wait()
    rig.start()


def _phase(rig: Rig, case: FaultCase, chance: random.Random) -> str:
    """Bring the hand into one of the states in which it grips."""
    phase = "holding" if case.holding_only else chance.choice(("holding", "grasping", "rotating"))
    if phase == "grasping":
        rig.ask({"command": "grasp", "force": chance.uniform(4.0, 9.0)})
    elif phase == "rotating":
        rig.ask({"command": "rotate", "angle": chance.uniform(-_TURN, _TURN)})
    return phase


def _look(rig: Rig, case: FaultCase, found: Trial) -> None:
    begin = now = time.monotonic()
    modes = set()
    if case.expect == "stops":
        with contextlib.suppress(NoAnswer):
            rig.ask({"command": "stop"})
    while now < begin + case.lasts:
        for state in rig.states():
            t = state["mono_ns"] * 1e-9
            if state["fault"] and not found.fault and t > begin - 0.1:
                found.fault, found.fault_s = state["fault_name"], t - begin
            modes.add(state["mode"])
            _judge_age(rig, state, found)
        report = rig.report()
        if stopped(report) and math.isnan(found.safe_s):
            found.safe_s = report["monotonic"] - begin
        found.waited_s = max(found.waited_s, rig.waited())
        safe = not math.isnan(found.safe_s)
        if safe and (found.fault or case.expect in ("dies", "stops")):
            return
        if case.expect == "lets go" and "armed" in modes:
            return
        now = time.monotonic()
    if case.expect == "lets go":
        found.missed = f"the joints did not stay where they were: {', '.join(sorted(modes))}"


def _judge_age(rig: Rig, state: dict[str, Any], found: Trial) -> None:
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
    """No goal outside its limits, no torque without packets, none switched on far from its goal."""
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


def _judge_daemon(rig: Rig, case: FaultCase, found: Trial) -> None:
    """No crash, no hang."""
    if not rig.alive:
        status = None if rig.daemon is None else rig.daemon.returncode
        found.wrong = f"the daemon ended with {status}: {' | '.join(rig.log()[-2:])}"
    elif rig.status(2.0) is None:
        found.wrong = "the daemon does not answer"


def _judge(case: FaultCase, found: Trial) -> None:
    """What was expected, and in time."""
    safe = not math.isnan(found.safe_s)
    if case.expect in ("works", "lets go"):
        if found.fault:
            found.missed = f"{found.fault} after {found.fault_s:.3f} s"
        elif safe:
            found.missed = f"no motor was driven after {found.safe_s:.3f} s"
        return
    if case.expect == "either" and not found.fault:
        return
    if not found.fault and case.expect == "fault":
        found.missed = "no fault"
    elif found.fault and case.expect != "stops" and found.fault not in case.names:
        found.missed = f"{found.fault} instead of {' or '.join(case.names)}"
    elif not safe:
        found.missed = "motors were driven on"
    elif not found.safe_s <= case.within + _SLACK:
        found.missed = f"motors driven for {found.safe_s:.3f} s, {case.within:.3f} s allowed"
