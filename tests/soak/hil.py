"""A soak in real time, hardware in the loop: ``python -m tests.soak.hil``, ten minutes.

The daemon's process on the emulated hand's, without any fault: random grasps, turns, moves and
releases. What was on the servos' wire is judged every few seconds by the emulated hand's record,
and the daemon's memory must be flat. Faults that a busy machine brings about are counted, told and
cleared.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from softfinger.tools.benchmarks.faults import Trial, judge_wire
from softfinger.tools.benchmarks.rigs import Rig

SECONDS = 600.0
_LOOK = 5.0  # s between two looks at wire and memory
_WARM = 0.1  # share of the time after which memory counts
_FLAT = 0.01
_ASKEW = ("hand.angle", "tip.tilt")  # the object lies askew, as stops leave it: it is put upright


@dataclass
class Account:
    """What a soak went through."""

    seconds: float = 0.0
    ticks: int = 0
    overruns: int = 0
    modes: Counter[str] = field(default_factory=Counter)  # looks in each
    done: Counter[str] = field(default_factory=Counter)  # commands carried out
    faults: Counter[str] = field(default_factory=Counter)
    placed: int = 0  # times that the object was put upright
    wrong: list[str] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)  # MB of the daemon, resident

    @property
    def growth(self) -> float:
        """Share by which the greatest memory is above that after the warm-up."""
        return max(self.memory) / self.memory[0] - 1.0 if self.memory else 0.0

    def __str__(self) -> str:
        def told(counted: Counter[str]) -> str:
            return ", ".join(f"{key} {count}" for key, count in counted.most_common()) or "none"

        return "\n".join(
            (
                f"{self.seconds:.0f} s, {self.ticks} ticks, {self.overruns} overruns",
                f"memory: {100.0 * self.growth:+.2f} % over {len(self.memory)} looks",
                f"modes: {told(self.modes)}",
                f"carried out: {told(self.done)}",
                f"faults: {told(self.faults)}; the object put upright {self.placed} times",
                f"wrong: {'; '.join(self.wrong) or 'nothing'}",
            )
        )


def soak(seconds: float, seed: int = 1) -> Account:
    """Run it. Raises RigError when the set-up does not work."""
    chance = random.Random(seed)
    account = Account()
    with Rig() as rig:
        rig.start()
        begin = time.monotonic()
        next_look = begin + _LOOK
        last = ""
        while (now := time.monotonic()) < begin + seconds:
            status = rig.status(5.0)
            if status is None:
                account.wrong.append(f"no answer; the daemon lives: {rig.alive}")
                break
            account.ticks, account.overruns = status["seq"], status["overruns"]
            account.modes[status["mode"]] += 1
            if status["fault"] and status["fault"] != last:
                account.faults[status["fault_name"]] += 1
                if status["fault_name"] in _ASKEW:
                    rig.send("place")
                    account.placed += 1
            last = status["fault"]
            request = _next(chance, status["mode"])
            if request is not None and rig.ask(request, 5.0)["ok"]:
                account.done[str(request["command"])] += 1
            if now > next_look:
                next_look = now + _LOOK
                _judge(rig, account, now - begin > _WARM * seconds)
            time.sleep(chance.uniform(0.01, 0.1))
        account.seconds = time.monotonic() - begin
        rig.ask({"command": "stop"}, 5.0)
        if rig.end_daemon() not in (0, 1):
            account.wrong.append("the daemon did not end as it should")
    return account


def _next(chance: random.Random, mode: str) -> dict[str, object] | None:
    if mode == "fault":
        return {"command": "clear"}
    if mode == "disarmed":
        return {"command": "arm"}
    if mode == "armed":
        if chance.random() < 0.3:
            angles = {side: chance.uniform(-0.1, 0.0) for side in ("left", "right")}
            return {"command": "move", **angles}
        return {"command": "grasp", "force": chance.uniform(3.0, 12.0)}
    if mode == "holding" and chance.random() < 0.2:
        kind = chance.choice(("rotate", "rotate", "grasp", "release"))
        numbers = {
            "rotate": {"angle": chance.uniform(-0.15, 0.15)},
            "grasp": {"force": chance.uniform(3.0, 12.0)},
        }
        return {"command": kind, **numbers.get(kind, {})}
    return {"command": "stop"} if chance.random() < 0.002 else None


def _judge(rig: Rig, account: Account, warm: bool) -> None:
    found = Trial(0)
    judge_wire(rig, found)
    rig.report("forget")
    if found.wrong:
        account.wrong.append(found.wrong)
    if warm and rig.daemon is not None:
        pages = int(Path(f"/proc/{rig.daemon.pid}/statm").read_text().split()[1])
        account.memory.append(pages * resource.getpagesize() / 1e6)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.hil", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    account = soak(arguments.seconds, arguments.seed)
    print(account)
    return 1 if account.wrong or account.growth > _FLAT else 0


if __name__ == "__main__":
    sys.exit(main())
