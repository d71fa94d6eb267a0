"""From a slip's onset to the servos' bytes: the emulated hand and a daemon, two real processes.

Sudden pulls and twists that the grip's friction can't bear. When the tips slip and what comes over
the servos' wire is read from the emulated hand's record, by its clock; the daemon is not asked.
"""

from __future__ import annotations

import math
import random
import time
from typing import Any

from softfinger.tools.benchmarks.measuring import Report, figure
from softfinger.tools.benchmarks.rigs import Rig

_FORCE = 10.0  # N: the tips' friction bears 12 N along the faces
_RAISED = 1.25  # of the goal currents before: a firmer grip, and not only damped joints
_LOADS = {"push": (14.0, 18.0), "twist": (0.30, 0.45)}  # N away from the palm; N·m
_SLIPS = 18  # of each
_SETTLED = 1.3  # s in a grip, after which loads show fully
_CALM = 0.1  # s looked at before the load
_LOOK = 0.3  # and after it
_LOST = 0.010  # m
_AIM = 20.0  # ms
_TRIES = 3
_PATIENCE = 20.0  # s for a grip
_STEPS = {"fault": "clear", "disarmed": "arm"}


def measure(brief: bool = False) -> list[Report]:
    """Onset to a raised grip on the wire [ms], over many slips. Raises RuntimeError."""
    chance, rows = random.Random(1), []
    with Rig() as rig:
        rig.start()
        before = rig.settings.simulation.object_position
        for kind, (least, most) in _LOADS.items():
            took: list[float] = []
            waited: list[float] = []
            lost = 0
            for _ in range(1 if brief else _SLIPS):
                _grip(rig)
                rig.waited()
                found = _slip(rig, kind, chance.uniform(least, most), chance.uniform(0.0, 0.02))
                waited.append(1e3 * rig.waited())
                took.append(1e3 * reaction(found))
                lost += math.dist(found["object"]["pose"][:2], before) > _LOST
            answered = [each for each in took if each < math.inf]
            if answered:
                row = figure(f"{kind}: slip to a firmer grip on the wire", "ms", answered, _AIM)
                rows.append(row | {"greatest": max(answered)})
            unanswered = len(took) - len(answered)
            rows.append(figure(f"{kind}: slips without an answer", "1", [unanswered], 0.0))
            rows.append(figure(f"{kind}: objects lost", "1", [lost]))
            rows.append(figure(f"{kind}: a process waited for a processor meanwhile", "ms", waited))
    return [Report("reflex, 100 Hz frames, by the emulated hand's clock", rows)]


def reaction(report: dict[str, Any]) -> float:
    """Seconds from the slip's onset until both servos' goal currents together are raised.

    Infinity when they are not.
    """
    pushed, slipped = report["object"]["pushed"], report["object"]["slipped"]
    left, right = (servo["goal_currents"] for servo in report["servos"])
    both = [(t, abs(a) + abs(b)) for (t, a), (_, b) in zip(left, right, strict=True)]
    calm = [value for t, value in both if t <= pushed] or [math.inf]
    most = _RAISED * sum(calm) / len(calm)
    raised = [float(t) for t, value in both if t > pushed and value > most]
    return min(raised, default=math.inf) - float(slipped)


def _grip(rig: Rig) -> None:
    """Put the object back between open fingers and grip it. Raises RuntimeError."""
    rig.ask({"command": "release"})
    end, placed = time.monotonic() + _PATIENCE, False
    while time.monotonic() < end:
        mode = (rig.status(2.0) or {"mode": ""})["mode"]
        if mode in _STEPS:
            rig.ask({"command": _STEPS[mode]}, 5.0)
        elif mode == "armed":
            rig.send("place")
            placed = True
            rig.ask({"command": "grasp", "force": _FORCE})
        elif mode == "holding" and placed:
            time.sleep(_SETTLED)
            return
        time.sleep(0.02)
    raise RuntimeError(f"the hand does not grip: {rig.status()}")


def _slip(rig: Rig, kind: str, load: float, after: float) -> dict[str, Any]:
    """Load the object ``after`` so many seconds; the hand's record a while later.

    Raises RuntimeError when it does not slip.
    """
    for _ in range(_TRIES):
        rig.send(f"forget {kind}={load:.3f}@{_CALM + after:.4f}")
        time.sleep(_CALM + after + _LOOK)
        found: dict[str, Any] = rig.report("goals")
        if found["object"]["slipped"] is not None:
            return found
        _grip(rig)  # raised before, on a busy machine, it may bear the load
    raise RuntimeError(f"{kind}={load:.3f}: the object did not slip")
