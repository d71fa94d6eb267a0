"""A soak on the virtual clock: random commands, rare faults, and what must hold at every tick.

``python -m tests.soak.virtual`` runs ten million ticks, five and a half hours of the hand's time,
in some minutes; tests run a short one. The daemon is whole but for its sockets. Faults come in by
wrappers around its servos and sensors, and the same wrappers judge what reaches the servos, with
arithmetic of their own. A broken invariant ends the soak with AssertionError.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import random
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.daemon.control.modes import COMMANDS, Mode
from softfinger.daemon.errors import Refused, ServoError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, Goal, Reading

TICKS = 10_000_000
_GRIPPING = ("grasping", "holding", "rotating")
_EVERY = 1500  # ticks between two faults, in the mean
_COMMAND_EVERY = 150  # ticks between two random commands, in the mean
_WARM = 0.1  # share of the ticks after which memory counts
_LOOKS = 50  # at the memory, altogether
# deaf: all that is written gets lost, and readings come.
# jumped: the angle is 0.2 rad off. numb: angle, velocity and current stand still.
SERVO_FAULTS = (
    *("silent", "gone", "deaf", "alert", "hot", "low", "fast", "stuck", "strayed"),
    *("jumped", "numb"),
)
_UNHEARD = ("silent", "gone", "deaf")  # no servo hears that torque shall be off
_WATCHDOG = 100  # ticks, 0.2 s, within which the servos' watchdogs then stop them
_LOST = 20  # goals in a row that get lost and are noticed
SENSOR_FAULTS = ("no frames", "frozen", "full", "zero", "noise", "invalid")


class FaultyServos:
    """Servos that fail on demand, and a judge of all that is sent to them."""

    def __init__(self, servos: Any, settings: Settings, clock: Any) -> None:
        self._servos = servos
        self._settings = settings
        self._clock = clock
        self._rise = settings.safety.current_rate / settings.loop.rate
        self._current = [0.0, 0.0]
        self._hardware = [0, 0]
        self.fault = ""
        self.finger = 0
        self.last_good = -math.inf
        self.torque = False
        self.written = 0
        self._last = 0.0  # angle at which a numb joint stands [rad]
        self._unheard = 0

    def connect(self) -> None:
        if self.fault == "gone":
            raise ServoError("the port is gone")
        self._servos.connect()
        self.torque = False

    def read(self, reading: Reading) -> None:
        fault, finger = self.fault, self.finger
        if fault == "gone":
            raise ServoError("the port is gone")
        if fault == "silent":
            reading.seq += 1
            reading.valid = False
            return
        if fault != "numb":
            self._last = reading.q[finger]
        self._servos.read(reading)
        self.last_good = reading.t
        if fault == "alert":
            reading.alert = 1 << finger
            reading.hardware[finger] = 32
        elif fault == "hot":
            reading.temperature[finger] = 90.0
        elif fault == "low":
            reading.voltage[finger] = 5.0
        elif fault == "fast":
            reading.dq[finger] = 50.0
        elif fault == "stuck":
            reading.current[finger] = 3.0
        elif fault == "strayed":
            reading.q[finger] = -2.0
        elif fault == "jumped":
            reading.q[finger] += 0.2
        elif fault == "numb":
            reading.q[finger], reading.dq[finger], reading.current[finger] = self._last, 0.0, 0.0
        elif fault == "deaf" and self._unheard > _LOST:
            reading.lost = 1 << finger

    def write(self, goal: Goal) -> None:
        hand, safety = self._settings.hand, self._settings.safety
        now = self._clock.now()
        self.written += 1
        assert self.torque, "a goal was sent with torque off"
        age = now - self.last_good
        assert age <= self._settings.servos.fault_after, f"goal on a reading {age:.3f} s old"
        for i in range(2):
            q, current = goal.q[i], goal.current[i]
            assert hand.q_min[i] <= q <= hand.q_max[i], f"goal angle {q}"
            assert 0.0 <= current <= safety.current_max, f"goal current {current}"
            rise = current - self._current[i]
            assert rise <= self._rise + 1e-9, f"goal current rose by {rise} A in a tick"
            self._current[i] = current
        if self.fault == "gone":
            raise ServoError("the port is gone")
        self._unheard += 1
        if self.fault not in ("silent", "deaf"):
            self._unheard = 0
            self._servos.write(goal)

    def torque_on(self) -> None:
        if self.fault in ("gone", "silent"):
            raise ServoError("torque could not be set")
        self._servos.torque_on()
        self.torque = True
        self._current = [0.0, 0.0]

    def torque_off(self, reading: Reading) -> bool:
        if self.fault == "gone":
            raise ServoError("the port is gone")
        if self.fault in ("silent", "deaf"):
            self.read(reading)
            return False
        self._servos.torque_off(reading)
        self.torque = False
        return True

    def counters(self) -> dict[str, int]:
        return self._servos.counters()

    def close(self) -> None:
        self._servos.close()


class FaultySensor:
    """A sensor whose frames stop, freeze or go wrong on demand."""

    def __init__(self, sensor: Any, settings: Settings, source: np.random.Generator) -> None:
        self._sensor = sensor
        self._full = settings.tactile.full_count
        self._source = source
        self._given: Frame | None = None
        self._seen: Frame | None = None
        self.fault = ""
        self.last_sent = 0.0  # arrival of the last frame that a sound sensor gave [s]

    def open(self) -> None:
        self._sensor.open()

    def latest(self) -> Frame | None:
        frame = self._sensor.latest()
        if frame is None or frame is self._seen:
            return self._given
        if self.fault == "no frames" and self._given is not None:
            return self._given
        self._seen = frame
        self._given = self._spoilt(frame)
        self.last_sent = frame.t_arrival
        return self._given

    def _spoilt(self, frame: Frame) -> Frame:
        data, valid = frame.data, True
        if self.fault == "frozen" and self._given is not None:
            data = self._given.data
        elif self.fault == "full":
            data = np.full_like(data, self._full)
        elif self.fault == "zero":
            data = np.zeros_like(data)
        elif self.fault == "noise":
            data = self._source.integers(0, self._full, data.shape, np.uint16)
        elif self.fault == "invalid":
            valid = False
        return Frame(frame.seq, frame.t_sample, frame.t_arrival, valid, data)

    def counters(self) -> dict[str, int]:
        return self._sensor.counters()

    def close(self) -> None:
        self._sensor.close()


@dataclass
class Account:
    """What a soak went through."""

    ticks: int = 0
    seconds: float = 0.0  # that it took
    written: int = 0  # goals that reached the servos
    modes: Counter[str] = field(default_factory=Counter)  # ticks in each
    faults: Counter[str] = field(default_factory=Counter)  # latched, by name
    injected: Counter[str] = field(default_factory=Counter)
    commands: Counter[str] = field(default_factory=Counter)  # carried out
    refused: int = 0
    memory: list[float] = field(default_factory=list)  # MB, resident, since warm

    @property
    def growth(self) -> float:
        """Share by which the greatest memory is above that at the end of the warm-up."""
        return max(self.memory) / self.memory[0] - 1.0 if self.memory else math.nan

    def lines(self) -> list[str]:
        """For people."""
        memory = "not looked at"
        if self.memory:
            memory = (
                f"{self.memory[0]:.1f} MB warm, {max(self.memory):.1f} MB at most "
                f"({100.0 * self.growth:+.2f} %)"
            )
        return [
            f"{self.ticks} ticks in {self.seconds:.0f} s, "
            f"{1e6 * self.seconds / max(self.ticks, 1):.1f} µs a tick; {self.written} goals sent",
            f"memory: {memory}",
            *(
                f"{name}: " + ", ".join(f"{key} {count}" for key, count in counted.most_common())
                for name, counted in (
                    ("ticks", self.modes),
                    ("injected", self.injected),
                    ("latched", self.faults),
                    ("carried out", self.commands),
                )
            ),
            f"refused: {self.refused}",
        ]


class Soak:
    """A daemon on the virtual clock, what is done to it, and what must hold."""

    def __init__(self, seed: int = 1, cache: Path | None = None) -> None:
        self.settings = Settings.model_validate({"loop": {"clock": "virtual"}})
        self.daemon = Daemon(self.settings, wire=False, table_cache=cache)
        self.account = Account()
        self._random = random.Random(seed)
        source = np.random.default_rng(seed)
        loop = self.daemon.loop
        self.servos = FaultyServos(loop.servos, self.settings, self.daemon.clock)
        loop.servos = self.servos
        self.sensors = [
            FaultySensor(each.sensor, self.settings, source) for each in loop.perception.fingers
        ]
        for perception, sensor in zip(loop.perception.fingers, self.sensors, strict=True):
            perception.sensor = sensor
        self._well_at = math.inf  # tick at which the fault ends
        self._failed = ""
        self._off_by = math.inf  # tick by which torque must be off

    def close(self) -> None:
        self.daemon.close()

    def run(self, ticks: int, seconds: float = math.inf, tell: Any = None) -> Account:
        """So many ticks, or as many as ``seconds`` allow."""
        loop, account, chance = self.daemon.loop, self.account, self._random
        clock, period = self.daemon.clock, loop.period
        begin = time.monotonic()
        gc.freeze()  # what is there already need not be looked through again at each look
        first = max(int(_WARM * ticks), 1)
        every = max((ticks - first) // _LOOKS, 1)
        deadline = clock.now()
        next_fault = self._after(_EVERY)
        next_command = 1
        for count in range(1, ticks + 1):
            clock.sleep_until(deadline)
            loop.tick(clock.now())
            deadline += period
            self._judge(count)
            if count >= next_command:
                next_command = count + self._after(_COMMAND_EVERY)
                self._command(chance)
            if count >= next_fault:
                next_fault = count + self._after(_EVERY)
                self._break(chance, count)
            if count >= self._well_at:
                self._mend()
            if count >= first and (count - first) % every == 0:
                account.seconds = time.monotonic() - begin
                account.ticks, account.written = count, self.servos.written
                account.memory.append(resident())
                if tell is not None:
                    tell(account)
                if account.seconds > seconds:
                    break
        account.seconds = time.monotonic() - begin
        account.ticks, account.written = count, self.servos.written
        return account

    def _after(self, mean: float) -> int:
        return 1 + int(self._random.expovariate(1.0 / mean))

    # What is done to it

    def _command(self, chance: random.Random) -> None:
        state = self.daemon.loop.state
        usual = {
            "disarmed": "arm",
            "armed": chance.choice(("grasp", "grasp", "grasp", "move", "release")),
            "moving": "grasp",
            "holding": chance.choice(("rotate", "rotate", "grasp", "release")),
            "fault": "clear",
        }.get(state.mode, "status")
        name = usual if chance.random() < 0.7 else chance.choice(sorted(COMMANDS))
        request: dict[str, Any] = {"command": name}
        for key, required in COMMANDS[name][1].items():
            if required or chance.random() < 0.8:
                request[key] = self._number(chance, key)
        self._put_object_back()
        try:
            self.daemon.loop.command(request)
        except Refused:
            self.account.refused += 1
        else:
            self.account.commands[name] += 1

    def _number(self, chance: random.Random, key: str) -> Any:
        if chance.random() < 0.05:
            return chance.choice((math.nan, math.inf, -1e300, "12", True, None, 1 << 70))
        low, high = {
            "left": (-0.6, 1.1),
            "right": (-0.6, 1.1),
            "force": (0.0, 30.0),
            "angle": (-0.4, 0.4),
            "compliance": (0.0, 0.2),
        }[key]
        return chance.uniform(low, high)

    def _break(self, chance: random.Random, count: int) -> None:
        self._mend()
        self._well_at = count + self._after(200.0)
        if chance.random() < 0.5:
            self.servos.fault = chance.choice(SERVO_FAULTS)
            self.servos.finger = chance.randrange(2)
            name = self.servos.fault
        else:
            sensor = chance.choice(self.sensors)
            sensor.fault = name = chance.choice(SENSOR_FAULTS)
        self.account.injected[name] += 1

    def _mend(self) -> None:
        self._well_at = math.inf
        self.servos.fault = ""
        for sensor in self.sensors:
            sensor.fault = ""

    def _put_object_back(self) -> None:
        """Where pushes have carried it off, and the fingers leave room for it at its place."""
        hand, simulation = self.daemon.hand, self.settings.simulation
        assert hand is not None
        x, y = simulation.object_position
        pose, velocity = hand.object_pose, hand.object_velocity
        if max(abs(pose[0] - x), abs(pose[1] - y)) < 0.01 and abs(pose[2]) < 0.3:
            return
        before = pose.tolist(), velocity.tolist()
        pose[:], velocity[:] = (x, y, simulation.object_angle), 0.0
        hand.refresh()
        if max(hand.d) > 0.0:
            pose[:], velocity[:] = before
            hand.refresh()

    # What must hold

    def _driven(self) -> bool:
        """Whether a motor has torque, by the plant's own account."""
        hand = self.daemon.hand
        assert hand is not None
        hand.advance(self.daemon.clock.now())
        return bool(hand.torque_on.any())

    def _judge(self, count: int) -> None:
        state, servos, account = self.daemon.loop.state, self.servos, self.account
        mode = str(state.mode)
        account.modes[mode] += 1
        assert mode in set(Mode)
        assert (mode == "fault") == bool(state.fault), f"{mode} with fault {state.fault!r}"
        assert bool(state.fault) == bool(state.fault_name)
        assert state.torque or not servos.torque, "torque is on and the state says off"
        if state.fault and state.fault != self._failed:
            account.faults[state.fault_name] += 1
        self._failed = state.fault
        for contact in state.contacts:
            total = contact.d + contact.theta + contact.force + contact.energy + contact.gain
            assert math.isfinite(total), f"a contact is no number: {contact}"
        self._judge_torque(state, mode, count)

    def _judge_torque(self, state: Any, mode: str, count: int) -> None:
        servos = self.servos
        safe = mode in ("disarmed", "fault")
        if not safe or not self._driven():
            self._off_by = math.inf
        elif self._off_by == math.inf:
            self._off_by = count + (_WATCHDOG if servos.fault in _UNHEARD else 1)
        assert count <= self._off_by, f"a motor is driven while {mode}"
        if safe:
            return
        settings, now = self.settings, state.t
        reading = now - servos.last_good
        assert reading <= settings.servos.fault_after, f"{mode} on a reading {reading:.3f} s old"
        if mode in _GRIPPING:
            limit = settings.safety.frame_age_fault / settings.tactile.rate
            for sensor in self.sensors:
                age = now - sensor.last_sent
                assert age <= limit + 1e-9, f"{mode} on a frame {age:.3f} s old"


def resident() -> float:
    """This process's resident memory without what the collector could free at once [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.virtual", description=__doc__)
    parser.add_argument("--ticks", type=int, default=TICKS, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=math.inf, help="end after so long")
    arguments = parser.parse_args()
    soak = Soak(arguments.seed)

    def tell(account: Account) -> None:
        print(
            f"{account.ticks} ticks, {account.seconds:.0f} s, {account.memory[-1]:.1f} MB",
            file=sys.stderr,
            flush=True,
        )

    try:
        account = soak.run(arguments.ticks, arguments.seconds, tell)
    except BaseException:
        state = soak.daemon.loop.state
        print(f"after {state.seq} ticks: {state}", file=sys.stderr)
        raise
    finally:
        soak.close()
    print("\n".join(account.lines()))
    return 0 if account.growth <= 0.01 else 1


if __name__ == "__main__":
    sys.exit(main())
