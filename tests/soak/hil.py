"""Run a one-hour real-time soak test with ``python -m tests.soak.hil``.

A daemon process drives an emulated hand. A recorder, three subscribers and a client connect to the
daemon. The client grasps, turns, moves and releases the object, and streams setpoints at 50 Hz.
Meanwhile, faults disturb the servos, the boards and the daemon. Every few seconds, the soak test
checks the emulated hand's record of the servo bus. The memory use of each process must not grow,
and the clients must count all lost messages. Ticks must be as punctual at the end as at the
beginning. At least three out of ten grasps must settle. The soak test counts, reports and clears
faults that a busy machine causes.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import subprocess
import sys
import time
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.client.hand import Hand
from softfinger.daemon.errors import NoStream
from softfinger.tools.benchmarks.rigs import RigError
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.stop_condition import StopCondition
from tests.harness.daemon_process import SOFTFINGER
from tests.soak.rig import CASES, End, Rig, judge_wire

SECONDS = 3600.0
SUBSCRIBERS = 3
_LOOK = 5.0  # time between two checks of the bus and of the memory [s]
# Duration of the first window and of the last window, whose delays are compared [s]. A window takes
# at most a third of the run.
_WINDOW = 600.0
_FLAT = 2.0  # maximum memory growth of a process [MB]
_FAULT_EVERY = 40.0  # average time between faults [s]
_FAULT_FOR = 0.3
_SETPOINT = 0.02  # time between setpoints [s]
_STREAM = 3.0  # duration of a setpoint stream [s]
_SPLIT = 300  # duration of a recording file [s]; an open file's index uses memory
# Faults that leave the object tilted. After such a fault, the soak test puts the object upright.
_ASKEW = ("hand.angle", "tip.tilt")
_DROPPED = 20.0  # time without a grip after which the soak test puts the object back [s]
_HELD = 0.3  # minimum fraction of grasps that settle
_MANY = 50  # number of grasps above which `_HELD` is checked
_BEGUN = 1500  # maximum difference between the listeners' numbers of states


@dataclass
class Account:
    """Results of a soak."""

    seconds: float = 0.0
    ticks: int = 0
    overruns: int = 0
    modes: Counter[str] = field(default_factory=Counter)  # number of checks in each mode
    done: Counter[str] = field(default_factory=Counter)  # accepted commands
    injected: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    held: int = 0  # number of grips that settled
    placed: int = 0  # number of times the object was put upright
    # Pairs (received, lost) for each subscriber.
    received: list[tuple[int, int]] = field(default_factory=list)
    recorded: tuple[int, int] = 0, 0  # numbers of recorded and lost states
    wrong: list[str] = field(default_factory=list)
    # Private memory of each process at each check [MB].
    memory: dict[str, list[float]] = field(default_factory=dict)
    # Delay of each state's tick [s].
    late: array[float] = field(default_factory=lambda: array("f"))
    # Pairs of time [s] and current number of values in `late`.
    looked: list[tuple[float, int]] = field(default_factory=list)

    def growth(self) -> dict[str, float]:
        """Return the increase of each process's memory after the first window [MB]."""
        looks = [t for t, _ in self.looked]
        warm = int(np.searchsorted(looks, self.window))
        return {
            name: max(seen[warm + 1 :], default=math.nan) - max(seen[: warm + 1], default=math.nan)
            for name, seen in self.memory.items()
        }

    @property
    def window(self) -> float:
        """Duration of the first window and of the last window [s]."""
        return min(_WINDOW, self.seconds / 3.0)

    def lateness(self) -> tuple[float, float]:
        """Return p99.9 of the tick delays in the first window and in the last window [s]."""
        times, counts = np.array(self.looked).reshape(-1, 2).T
        first = int(np.interp(self.window, times, counts))
        last = int(np.interp(self.seconds - self.window, times, counts))
        late = np.array(self.late)
        ends = [each if each.size else np.full(1, np.nan) for each in (late[:first], late[last:])]
        return tuple(float(np.quantile(each, 0.999)) for each in ends)  # type: ignore[return-value]

    def __str__(self) -> str:
        def told(counted: Counter[str]) -> str:
            return ", ".join(f"{key} {count}" for key, count in counted.most_common()) or "none"

        first, last = self.lateness()
        grown = (f"{name} {max(self.memory[name]):.0f} {more:+.2f} MB"
                 for name, more in self.growth().items())  # fmt: skip
        return "\n".join(
            (
                f"{self.seconds:.0f} s, {self.ticks} ticks, {self.overruns} overruns",
                f"memory, greatest and growth: {', '.join(grown)}",
                f"lateness p99.9: {1e3 * first:.2f} ms in the first {self.window:.0f} s, "
                f"{1e3 * last:.2f} ms in the last",
                f"subscribers' states, and lost: {self.received}; recorder's: {self.recorded}",
                f"modes: {told(self.modes)}",
                f"carried out: {told(self.done)}; {self.held} grips came to hold",
                f"injected: {told(self.injected)}",
                f"faults: {told(self.faults)}; the object put upright {self.placed} times",
                f"wrong: {'; '.join(self.wrong) or 'nothing'}",
            )
        )


def soak(seconds: float, seed: int = 1) -> Account:
    """Run the soak test; raise RigError if the hand has exited or a process fails to start."""
    chance = random.Random(seed)
    account = Account()
    with Rig() as rig, ExitStack() as others:
        rig.start()
        processes = others.enter_context(_listeners(rig, account))
        begin = time.monotonic()
        next_look, gripped, fault_at = begin + _LOOK, begin, begin + _LOOK
        last, last_mode, end_fault, ends_at = "", "", None, math.inf
        while (now := time.monotonic()) < begin + seconds:
            try:
                _listen(rig, account, chance.uniform(0.01, 0.1))
                status = rig.status(60.0)
                if status is None:
                    account.wrong.append(f"no answer; the daemon lives: {rig.alive}")
                    break
                account.ticks, account.overruns = status["seq"], status["overruns"]
                mode = status["mode"]
                account.modes[mode] += 1
                account.held += last_mode == "grasping" and mode in ("holding", "rotating")
                last_mode = mode
                gripped = now if mode == "holding" else gripped
                if status["fault"] and status["fault"] != last:
                    account.faults[status["fault_name"]] += 1
                askew = (
                    status["fault"] and status["fault"] != last and status["fault_name"] in _ASKEW
                )
                if askew or now > gripped + _DROPPED:
                    rig.send("place")
                    account.placed, gripped = account.placed + 1, now
                last = status["fault"]
                with suppress(NoAnswer):
                    if mode == "holding" and chance.random() < 0.05:
                        _teleoperate(rig, account, chance)
                    request = _next(chance, mode)
                    if request is not None and rig.ask(request, 5.0)["ok"]:
                        account.done[str(request["command"])] += 1
                    elif request is not None and mode == "armed":  # Arming reopens a lost board.
                        rig.ask({"command": "disarm"}, 5.0)
                if end_fault is not None and now > ends_at:
                    end_fault()
                    end_fault, ends_at = None, math.inf
                if end_fault is None and now > fault_at:
                    end_fault, ends_at = _inject(rig, account, chance), now + _FAULT_FOR
                    fault_at = now + chance.expovariate(1.0 / _FAULT_EVERY)
                if now > next_look:
                    next_look = now + _LOOK
                    _judge(rig, account, processes, now - begin)
            except RigError as error:
                if rig.hand is None or rig.hand.poll() is not None:
                    raise
                account.faults[f"busy: {error}".replace(str(rig.folder), "")] += 1
        if end_fault is not None:
            end_fault()
        account.seconds = time.monotonic() - begin
        rig.ask({"command": "stop"}, 60.0)
        others.close()
        if rig.end_daemon() not in (0, 1):
            account.wrong.append("the daemon did not end as it should")
    _conclude(account)
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


def _teleoperate(rig: Rig, account: Account, chance: random.Random) -> None:
    """Stream force and angle setpoints for _STREAM seconds, as a teleoperation device does."""
    force, swing, pace = chance.uniform(4, 10), chance.uniform(0.02, 0.15), chance.uniform(2, 8)
    begin = time.monotonic()
    while (t := time.monotonic() - begin) < _STREAM:
        angle = swing * math.sin(pace * t)
        if not rig.ask({"command": "hold", "force": force, "angle": angle}, 5.0)["ok"]:
            return
        account.done["hold"] += 1
        _listen(rig, account, _SETPOINT)


def _inject(rig: Rig, account: Account, chance: random.Random) -> End:
    name = chance.choice(list(CASES))
    account.injected[name] += 1
    return CASES[name](rig, chance)


def _listen(rig: Rig, account: Account, seconds: float) -> None:
    """Receive states for ``seconds``, and record the delay of each state's tick."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        account.late.extend(state["wake_late_s"] for state in rig.states(left))


@contextmanager
def _listeners(rig: Rig, account: Account) -> Iterator[dict[str, int]]:
    """Run the recorder and the subscribers; yield the names and IDs of all processes."""
    assert rig.daemon is not None
    assert rig.hand is not None
    file = rig.folder / "soak.mcap"
    record = (
        *SOFTFINGER,
        "record",
        str(file),
        "--address",
        rig.stream,
        "--split-time",
        str(_SPLIT),
    )
    subscribe = (
        sys.executable,
        "-m",
        "tests.soak.hil",
        "--subscribe",
        f"{rig.stream},{rig.commands}",
    )
    with ExitStack() as running:
        recorder, *subscribers = [
            running.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
            for words in (record, *[subscribe] * SUBSCRIBERS)
        ]
        for each in subscribers:
            assert each.stdout is not None
            each.stdout.readline()  # The subscriber has received a state.
        while not file.exists() or not file.stat().st_size:
            if recorder.poll() is not None:
                raise RigError("the recorder has exited")
            rig.states()
        try:
            children = Path(f"/proc/{rig.daemon.pid}/task/{rig.daemon.pid}/children").read_text()
            yield {
                "daemon": rig.daemon.pid,
                **{f"daemon's child {i}": int(pid) for i, pid in enumerate(children.split(), 1)},
                "hand": rig.hand.pid,
                "recorder": recorder.pid,
                **{f"subscriber {i}": each.pid for i, each in enumerate(subscribers, 1)},
            }
        finally:
            for each in (recorder, *subscribers):
                each.terminate()
            said = recorder.communicate()[0]
            account.received = [tuple(json.loads(each.communicate()[0])) for each in subscribers]
    lost = said.partition("lost: ")[2].splitlines()[0]
    of_states = [part for part in lost.split(", ") if part.endswith(" of hand/state")]
    count = sum(Recording(each).counts["hand/state"] for each in rig.folder.glob("soak*.mcap"))
    account.recorded = count, int(of_states[0].split()[0]) if of_states else 0


def _judge(rig: Rig, account: Account, processes: dict[str, int], now: float) -> None:
    wrong = judge_wire(rig)
    rig.report("forget")
    if wrong:
        account.wrong.append(wrong)
    for name, pid in list(processes.items()):
        try:
            status = Path(f"/proc/{pid}/status").read_text().split("RssAnon:")[1]
        except (OSError, IndexError):
            account.wrong.append(f"{name} has ended")
            del processes[name]
            continue
        account.memory.setdefault(name, []).append(int(status.split()[0]) / 1e3)
    account.looked.append((now, len(account.late)))


def _conclude(account: Account) -> None:
    for name, more in account.growth().items():
        if more > _FLAT:
            account.wrong.append(f"{name} grew by {more:.1f} MB")
    grasps = account.done["grasp"]
    if grasps >= _MANY and account.held < _HELD * grasps:
        account.wrong.append(f"{account.held} of {grasps} grasps came to hold")
    counts = [sum(each) for each in (*account.received, account.recorded)]
    if max(counts) - min(counts) > _BEGUN:
        account.wrong.append(f"numbers of states differ: {account.received}, {account.recorded}")


def subscribe(addresses: str) -> None:
    """Print "ready" at the first state, and the counts of received and lost states at the end."""
    received = 0
    with (
        StopCondition() as ending,
        Hand(addresses, timeout=60.0) as hand,
        hand.stream(1.0) as states,
    ):
        ending.begin()
        while not ending.is_met:
            with suppress(NoStream):  # The daemon may have exited.
                next(states)
                received += 1
                if received == 1:
                    print("ready", flush=True)
        print(json.dumps([received, states.lost]))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.hil", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--subscribe", metavar="ADDRESSES", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.subscribe:
        subscribe(arguments.subscribe)
        return 0
    account = soak(arguments.seconds, arguments.seed)
    print(account)
    return 1 if account.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
