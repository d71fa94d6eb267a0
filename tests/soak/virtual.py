"""Run random sequences of commands, loads and faults in virtual time, one sequence per seed.

``python -m tests.soak.virtual`` runs a thousand sequences of 10 s. In most sequences, the hand
grips the object. The soak test then loads, turns and stops the grip, and adds faulty measurements.
The daemon is complete except for its sockets. Requirements are checked against the plant's values
and the data sent to the servos, not against the daemon's own reports. The soak test counts the
checks of each requirement, and fails if a requirement is never checked. The test suite runs only a
few sequences.

``--ticks 14400000`` runs one hand for eight hours of virtual time and records the stream.
Violations are counted and do not end the run. The run fails if memory grows, or if a requirement
other than those on forces and reported channels is violated.
"""

import argparse
import gc
import math
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from softfinger.daemon.client.stream import Gaps, read
from softfinger.daemon.control.modes import COMMANDS, Mode
from softfinger.daemon.errors import Refused, ServoError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import Publishing
from softfinger.daemon.profile.load import checked
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, GRIP_FRACTION, Frame, Goal, Reading
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.publisher import Publisher, bit
from softfinger.daemon.wire.schema import INPUT, TOPICS
from softfinger.tools.recordings.record import RecordingWriter

SEQUENCES, TICKS = 1000, 5000
LONG = 1_000_000  # number of ticks above which a sequence counts as long
HELD = 0.3  # minimum fraction of the sequences in which a grip settles
_GRIPPING = ("grasping", "holding", "rotating")
_COMMAND_EVERY = 150  # average number of ticks between commands
_DISTURBED_EVERY = 800  # average number of ticks between loads or faults
_DISTURBED_FOR = 500
_WILD = 0.1  # fraction of commands that are drawn regardless of the mode
_LOOKS = 96  # number of memory checks in a long sequence
_WARM = 2  # number of memory checks in the warm-up, which takes ten minutes of eight hours
_FLAT = 2.0  # maximum memory growth after the warm-up [MB]
_STREAM = {"state_rate": 20.0, "tactile_rate": 10.0}  # message rates in a long sequence [Hz]
_SPLIT = 16e6  # file size limit for the recording of the long sequence [bytes]
# A "deaf" servo receives no data but still sends readings. A servo that has "jumped" reports an
# angle that is wrong by 0.2 rad. A "numb" servo always reports the same angle, velocity and
# current.
SERVO_FAULTS = (
    *("silent", "gone", "deaf", "alert", "hot", "low", "fast", "stuck", "strayed"),
    *("jumped", "numb"),
)
# faults that make the joint angle contradict the frames
_ENCODER = ("fast", "strayed", "jumped", "numb")
# faults that keep the torque-off command from reaching a servo
_UNHEARD = ("silent", "gone", "deaf")
_WATCHDOG = 100  # number of ticks until the servo watchdogs stop the motors (0.2 s)
_LOST = 20  # number of consecutive lost goals that triggers a report
SENSOR_FAULTS = ("no frames", "frozen", "full", "zero", "noise", "invalid")
# For each measurement fault, the range of its values and the channel that the daemon may report.
LIES = {
    "gain": ((0.5, 1.6), "sensor"),
    "shift-x": ((-4.0, 4.0), "sensor"),
    "shift-y": ((-4.0, 4.0), "sensor"),
    "mirror": ((1.0, 1.0), "sensor"),
    "drift": ((-0.2, 0.2), "sensor"),
    "replay": ((0.3, 1.0), "sensor"),
    "current": ((0.4, 2.5), "current"),
}
LOADS = ("push", "twist")
_TOO_LONG = 0.05  # maximum time above a bound on the tip force [s]
_TOO_MUCH = 1.3  # without a load: maximum ratio of a tip force to the requested force
_UNSURE = 1.2  # under a load: maximum ratio of a tip force to the raised grip force
_REMEMBERED = 5.0  # maximum time for which the grip force stays raised after a load or fault [s]
_RETARGETED = 0.5  # maximum time until a newly requested force applies [s]
_UNCOVERED = 1.0  # time after a footprint left the object in which false reports are allowed [s]

# Requirements. The soak test counts how often each requirement is checked.
STOPPED = {mode: f"no torque after a stop while {mode}" for mode in ("holding", "rotating")}
OFF = "no torque after disarm or fault"
WATCHDOG = "no torque 0.2 s after a stop that no servo hears"
STAYS = "no goal, no torque until arm"
GOAL = "goals within angles, currents, slew"
READING, FRAME = "no old reading", "no old frame in a grip"
STATE = "mode, fault and torque agree, contacts finite"
CALM = "force ≤ 1.3 × asked: nothing calls for more"
LIED = "force ≤ 1.3 × asked, with or after a false measurement"
RAISED = "force ≤ what it may be raised to, loaded"
MOST = "force ≤ safety.force_max, as well as it is known"
HONEST = {mode: f"nothing named while {mode}, no fault" for mode in _GRIPPING}
LOADED = "nothing named while loaded, no fault"
NAMED = {kind: f"only what lies is named: {kind}" for kind in LIES}
ASSERTIONS = (
    *STOPPED.values(), OFF, WATCHDOG, STAYS, GOAL, READING, FRAME, STATE, CALM, LIED, RAISED,
    MOST, *HONEST.values(), LOADED, *NAMED.values(),
)  # fmt: skip
# Requirements that a long sequence may violate in a few ticks.
_TOLERATED = {CALM, LIED, RAISED, MOST, *HONEST.values(), LOADED, *NAMED.values()}


class Judge:
    """Check requirements, and count how often each requirement is checked.

    If ``broken`` is given, a violation is counted there and does not raise an exception.
    """

    def __init__(self, judged: Counter[str], broken: Counter[str] | None = None) -> None:
        self._judged = judged
        self._broken = broken

    def __call__(self, name: str, holds: bool, *found: object) -> None:
        """Count a check of the requirement ``name``; raise AssertionError on a violation."""
        self._judged[name] += 1
        if not holds and self._broken is not None:
            self._broken[name] += 1
            return
        assert holds, f"{name}: {' '.join(map(str, found))}"


class Listener(Link):
    """Gateway replacement that receives and records all published messages."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.wanted = sum(bit(topic) for topic in TOPICS if topic != INPUT)
        self._topics = list(TOPICS)
        self._gaps = {topic: Gaps() for topic in TOPICS}
        self._path = folder / "soak.mcap"
        self._writer = RecordingWriter(self._path)
        self.messages = 0

    def gaps(self) -> int:
        return sum(each.lost for each in self._gaps.values())

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        name = self._topics[topic]
        content = msgpack.unpackb(message)
        read(TOPICS[name].record, content)
        self._gaps[name].take(content)
        self._writer.add(name, content)
        self.messages += 1
        if self._writer.size > _SPLIT:
            self.close()
            self._writer = RecordingWriter(self._path)

    def close(self) -> None:
        self._writer.close()
        self._path.unlink()


class FaultyServos:
    """Servos that fail on demand and check all data sent to them."""

    def __init__(self, servos: Any, settings: Settings, clock: Any, must: Judge) -> None:
        self._servos = servos
        self._settings = settings
        self._clock = clock
        self._must = must
        self._rise = settings.safety.current_rate / settings.loop.rate
        self._current = [0.0, 0.0]
        self.fault = ""
        self.finger = 0
        self.last_good = -math.inf
        self.torque = False
        self.armed = False  # True if the hand has been armed since the last event that disarmed it
        self._last = 0.0  # last reported angle, which a numb joint repeats [rad]
        self._unheard = 0

    def connect(self) -> None:
        if self.fault == "gone":
            raise ServoError("the port is lost")
        self._servos.connect()
        self.torque = False

    def read(self, reading: Reading) -> None:
        fault, finger = self.fault, self.finger
        if fault == "gone":
            raise ServoError("the port is lost")
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
        must = self._must
        must(STAYS, self.torque and self.armed, "a goal was sent")
        age = self._clock.now() - self.last_good
        must(READING, age <= self._settings.servos.fault_after, f"goal on one {age:.3f} s old")
        for i in range(2):
            q, current = goal.q[i], goal.current[i]
            rise = current - self._current[i]
            must(
                GOAL,
                hand.q_min[i] <= q <= hand.q_max[i]
                and 0.0 <= current <= safety.current_max
                and rise <= self._rise + 1e-9,
                f"{q} rad, {current} A, which rose by {rise} A in a tick",
            )
            self._current[i] = current
        if self.fault == "gone":
            raise ServoError("the port is lost")
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
            raise ServoError("the port is lost")
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
    """Sensor whose frames stop, freeze or become incorrect on demand."""

    def __init__(self, sensor: Any, settings: Settings, source: np.random.Generator) -> None:
        self._sensor = sensor
        self._full = settings.tactile.full_count
        self._source = source
        self._given: Frame | None = None
        self._seen: Frame | None = None
        self.fault = ""
        self.last_sent = 0.0  # arrival time of the last valid frame from a fault-free sensor [s]

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
    """Results of the sequences."""

    sequences: int = 0
    held: int = 0  # number of sequences in which a grip settled
    ticks: int = 0
    seconds: float = 0.0  # run time
    judged: Counter[str] = field(default_factory=Counter)
    modes: Counter[str] = field(default_factory=Counter)  # number of ticks in each mode
    faults: Counter[str] = field(default_factory=Counter)  # number of latched faults by name
    injected: Counter[str] = field(default_factory=Counter)
    # Number of times the daemon reported each channel, by channel and actual fault.
    named: Counter[str] = field(default_factory=Counter)
    commands: Counter[str] = field(default_factory=Counter)  # accepted commands
    refused: int = 0
    failures: list[str] = field(default_factory=list)
    broken: Counter[str] = field(default_factory=Counter)  # number of ticks with violations
    published: tuple[int, int] = 0, 0  # number of messages published, and lost
    memory: list[float] = field(default_factory=list)  # resident memory after the warm-up [MB]

    @property
    def growth(self) -> float:
        """Maximum memory growth after the warm-up [MB]."""
        return max(self.memory) - self.memory[0] if self.memory else 0.0

    @property
    def never(self) -> list[str]:
        """Requirements that were never checked."""
        return [name for name in ASSERTIONS if not self.judged[name]]

    def lines(self) -> list[str]:
        """Return a readable report."""
        return [
            *(f"{self.judged[name]:>10}  {name}" for name in ASSERTIONS),
            f"{self.held} of {self.sequences} sequences came to hold; {self.ticks} ticks in "
            f"{self.seconds:.0f} s",
            f"memory grew by {self.growth:.2f} MB over {len(self.memory)} looks: "
            + ", ".join(f"{each:.1f}" for each in self.memory),
            f"messages published and lost: {self.published}",
            *(
                f"{name}: " + ", ".join(f"{key} {count}" for key, count in counted.most_common())
                for name, counted in (
                    ("ticks", self.modes),
                    ("injected", self.injected),
                    ("latched", self.faults),
                    ("named", self.named),
                    ("carried out", self.commands),
                    ("ticks that broke", self.broken),
                )
            ),
            f"refused: {self.refused}",
            *(f"FAILED: {failure}" for failure in self.failures),
        ]


class Soak:
    """Apply random actions to a daemon in virtual time, and check all requirements."""

    def __init__(
        self, seed: int = 1, account: Account | None = None, listener: Listener | None = None
    ) -> None:
        chance = self._random = random.Random(seed)
        mass = 0.1 * 2.0 ** chance.uniform(-1.0, 1.0)
        simulation = {"seed": seed, "object_mass": mass}
        stream = _STREAM if listener else {}
        self.settings = checked(
            {"loop": {"clock": "virtual"}, "simulation": simulation, "stream": stream}
        )
        self.account = account or Account()
        self.account.sequences += 1
        self.daemon = Daemon(self.settings, wire=False, on_event=self._hear)
        loop, clock = self.daemon.loop, self.daemon.clock
        self.must = Judge(self.account.judged, self.account.broken if listener else None)
        self.servos = FaultyServos(loop.torque.servos, self.settings, clock, self.must)
        loop.torque.servos = self.servos
        source = np.random.default_rng(seed)
        self.sensors = [
            FaultySensor(each.sensor, self.settings, source) for each in loop.perception.fingers
        ]
        for perception, sensor in zip(loop.perception.fingers, self.sensors, strict=True):
            perception.sensor = sensor
        assert self.daemon.hand is not None
        self.hand = self.daemon.hand
        if listener is not None:
            publisher = loop._publisher = Publisher(listener)
            loop._publishing = Publishing(
                self.settings, publisher, loop.perception.fingers, loop.statistics, self.hand
            )
        self.hand.plant.parameters.torque_constant *= chance.uniform(0.9, 1.1)
        self.count = 0  # ticks so far
        self.held = False
        self.off_by = math.inf  # tick from which torque must be off
        self._off_name = OFF
        self._failed = ""
        self._deadline = clock.now()
        self._next_command = 1
        self._next_disturbance = self._after(_DISTURBED_EVERY)
        self._well_at = math.inf  # tick at which a disturbance ends
        self._lie = ""  # kind of the current measurement fault
        self._false: set[str] = set()  # channels that the daemon may report as faulty
        self._loaded = 0.0  # N along the faces
        # Times [s] of the last load, the last wrong measurement, and the last footprint outside the
        # object.
        self._loaded_t = self._lied_t = self._uncovered_t = -math.inf
        # Requested forces [N] of the current grip, each with its time [s].
        self._asked: list[tuple[float, float]] = []
        # Times [s] since which forces have exceeded their bounds.
        self._above = {MOST: math.inf, CALM: math.inf}

    def close(self) -> None:
        self.daemon.close()

    def run(self, ticks: int) -> Account:
        """Advance by ``ticks``."""
        loop, clock = self.daemon.loop, self.daemon.clock
        for _ in range(ticks):
            self.count += 1
            clock.sleep_until(self._deadline)
            loop.tick(clock.now())
            self._deadline += loop.period
            self._judge()
            if self.count >= self._next_command:
                self._next_command = self.count + self._after(_COMMAND_EVERY)
                self._command()
            if self.count >= self._next_disturbance and self._may_be_disturbed():
                self._next_disturbance = self.count + self._after(_DISTURBED_EVERY)
                self._disturb()
            if self.count >= self._well_at:
                self._mend()
        self.account.ticks += ticks
        return self.account

    def _after(self, mean: float) -> int:
        return 1 + int(self._random.expovariate(1.0 / mean))

    def _may_be_disturbed(self) -> bool:
        """Return True in the ``holding`` mode, and occasionally in other modes."""
        return self.daemon.loop.state.mode == "holding" or self._random.random() < 1e-3

    # Actions

    def _command(self) -> None:
        chance, state = self._random, self.daemon.loop.state
        mode = state.mode
        usual = {
            "disarmed": ("arm",),
            "armed": ("grasp", "grasp", "grasp", "grasp", "move", "release"),
            "moving": ("grasp",),
            "holding": (
                *["rotate"] * 4,
                *["grasp"] * 3,
                *["hold"] * 3,
                "release",
                "stop",
                "status",
            ),
            "rotating": (*["status"] * 6, "grasp", "stop"),
            "fault": ("clear",),
        }.get(mode, ("status",))
        name = chance.choice(usual if chance.random() > _WILD else sorted(COMMANDS))
        request: dict[str, Any] = {"command": name}
        for key, parameter in COMMANDS[name].parameters.items():
            if parameter.required or chance.random() < 0.8:
                request[key] = self._number(key)
        self._put_object_back()
        try:
            self.daemon.loop.command(request)
        except Refused:
            self.account.refused += 1
        else:
            self.account.commands[name] += 1
            self._carried_out(request, str(mode))

    def _carried_out(self, request: dict[str, Any], mode: str) -> None:
        """Update the expected torque and force after an accepted command."""
        name = request["command"]
        if name == "arm":
            self.servos.armed, self.off_by = True, math.inf
        elif name in ("stop", "disarm"):
            self._must_end(STOPPED.get(mode, OFF) if name == "stop" else OFF)
        if name == "grasp" or (name == "hold" and ("force" in request or mode not in _GRIPPING)):
            force = request.get("force", self.settings.control.force_default)
            t = self.daemon.clock.now()
            if not self._asked:  # The force may already be higher after a motion.
                self._asked.append((t, max(self.hand.force.tolist())))
            self._asked.append((t, force))
        elif name in ("arm", "move", "release", "stop", "disarm"):
            self._asked.clear()

    def _must_end(self, name: str) -> None:
        """Require that motors turn off, and that no goals are sent until the hand is armed."""
        if not self.servos.armed:
            return
        self.servos.armed = False
        unheard = self.servos.fault in _UNHEARD
        self._off_name = WATCHDOG if unheard else name
        self.off_by = self.count + (_WATCHDOG if unheard else 1)

    def _number(self, key: str) -> Any:
        chance = self._random
        if chance.random() < 0.02:
            return chance.choice((math.nan, math.inf, -1e300, "12", True, None, 1 << 70))
        low, high = {
            "left": (-0.6, 1.1),
            "right": (-0.6, 1.1),
            "force": (2.0, 28.0),
            "angle": (-0.25, 0.25),
            "compliance": (0.0, 0.2),
        }[key]
        return chance.uniform(low, high)

    def _disturb(self) -> None:
        """Start a load, a measurement fault, a servo fault or a sensor fault."""
        self._mend()
        chance, t = self._random, self.daemon.clock.now()
        self._well_at = self.count + self._after(_DISTURBED_FOR)
        finger = chance.randrange(2)
        side = FINGERS[finger]
        which = chance.random()
        if which < 0.35:
            kind = chance.choice(LOADS)
            self._load(kind)
        elif which < 0.75:
            kind = self._lie = chance.choice(tuple(LIES))
            (low, high), false = LIES[kind]
            self._false.add(f"{side}_{false}")
            over = chance.choice((0.0, 0.0, 1.0))
            self.hand.measurement_faults[finger].begin(kind, chance.uniform(low, high), t, over)
        elif which < 0.87:
            kind = self.servos.fault = chance.choice(SERVO_FAULTS)
            self.servos.finger = finger
            self._false.add(f"{side}_current")
            if kind in _ENCODER:
                self._false.add(f"{side}_sensor")
        else:
            kind = self.sensors[finger].fault = chance.choice(SENSOR_FAULTS)
            self._false.add(f"{side}_sensor")
        self.account.injected[kind] += 1

    def _load(self, kind: str) -> None:
        """Apply a load that is usually below the grip's limit."""
        chance, friction = self._random, self.settings.simulation.tip_friction
        force = self._asked[-1][1] if self._asked else 5.0
        share = chance.uniform(-0.7, 0.7) if chance.random() < 0.8 else chance.uniform(-1.6, 1.6)
        self._loaded = 2.0 * share * friction * force
        arm = 1.0 if kind == "push" else 0.5 * self.settings.simulation.object_width
        self.hand.load(**{kind: arm * self._loaded})

    def _mend(self) -> None:
        self._well_at = math.inf
        self.servos.fault = self._lie = ""
        for sensor in self.sensors:
            sensor.fault = ""
        for each in self.hand.measurement_faults:
            each.clear()
        self._loaded = 0.0
        self.hand.load()

    def _put_object_back(self) -> None:
        """Put the object back if it has moved and no finger touches it."""
        hand, (x, y) = self.hand, self.settings.simulation.object_position
        pose = hand.object_pose.copy()
        if hand.force.any() or (math.dist(pose[:2], (x, y)) < 0.003 and abs(pose[2]) < 0.03):
            return
        hand.place_object()
        if max(hand.d) > 0.0:
            hand.object_pose[:] = pose
            hand.refresh()

    # Requirements

    def _hear(self, level: str, kind: str, _: str) -> None:
        if kind.startswith("consistency.") and level != "info":
            self._names(kind.removeprefix("consistency."))

    def _judge(self) -> None:
        state, servos, must = self.daemon.loop.state, self.servos, self.must
        mode = str(state.mode)
        self.account.modes[mode] += 1
        self.held = self.held or mode == "holding"
        finite = all(
            math.isfinite(each.d + each.theta + each.force + each.energy + each.gain)
            for each in state.contacts
        )
        must(
            STATE,
            mode in set(Mode)
            and (mode == "fault") == bool(state.fault) == bool(state.fault_name)
            and (state.torque or not servos.torque)
            and finite,
            state,
        )
        if state.fault and state.fault != self._failed:
            self.account.faults[state.fault_name] += 1
            self._must_end(OFF)
            self._asked.clear()
        self._failed = state.fault
        self.hand.advance(state.t)
        self._judge_torque()
        if mode not in ("disarmed", "fault"):
            self._judge_ages(mode)
        self._judge_forces(state.t)
        self._judge_sensor_faults(mode)

    def _judge_torque(self) -> None:
        if self.servos.armed:
            return
        if self.count < self.off_by and self.hand.torque_on.any():
            return
        if self.off_by < math.inf:
            self.must(self._off_name, not self.hand.torque_on.any(), "a motor is driven")
            self.off_by = math.inf
        self.must(STAYS, not self.hand.torque_on.any(), "a motor is driven")

    def _judge_ages(self, mode: str) -> None:
        now, settings = self.daemon.loop.state.t, self.settings
        age = now - self.servos.last_good
        self.must(READING, age <= settings.servos.fault_after, f"{mode} on one {age:.3f} s old")
        if mode in _GRIPPING:
            age = now - min(sensor.last_sent for sensor in self.sensors)
            most = settings.safety.frame_age_fault / settings.tactile.rate
            self.must(FRAME, age <= most + 1e-9, f"{mode} on one {age:.3f} s old")

    def _judge_forces(self, t: float) -> None:
        """Check that no tip force in the plant stays above its bound for over _TOO_LONG seconds."""
        control, most = self.settings.control, self.settings.safety.force_max
        if self._loaded:
            self._loaded_t = t
        if self._lie or any(sensor.fault for sensor in self.sensors):
            self._lied_t = t
        force = max(self.hand.force.tolist())
        # The relative error of the measured force is the error of the torque constant.
        self._must_end_soon(MOST, MOST, force, (1.0 + control.torque_error) * most, t)
        while len(self._asked) > 1 and self._asked[1][0] < t - _RETARGETED:
            del self._asked[0]
        if not self._asked:
            self._above[CALM] = math.inf
            return
        asked = max(each for _, each in self._asked)
        raised = asked + min(control.grip_raise_max, control.grip_raise_share * asked)
        loaded = t < self._loaded_t + _REMEMBERED
        friction = control.joint_friction / self.settings.hand.finger_length
        bound = _TOO_MUCH * asked
        if loaded:
            bound = max(bound, _UNSURE * min(raised, GRIP_FRACTION * most))
        bound += 2.0 * friction  # for friction compensation and static friction
        lied = t < self._lied_t + _REMEMBERED
        name = RAISED if loaded else LIED if lied else CALM
        self._must_end_soon(CALM, name, force, bound, t)

    def _must_end_soon(self, key: str, name: str, force: float, bound: float, t: float) -> None:
        self._above[key] = min(self._above[key], t) if force > bound else math.inf
        found = f"{force:.2f} N for {t - self._above[key]:.3f} s, bound {bound:.2f} N"
        self.must(name, t - self._above[key] <= _TOO_LONG, found)

    def _judge_sensor_faults(self, mode: str) -> None:
        if not self._covered():
            self._uncovered_t = self.daemon.loop.state.t
        for name in self._doubts(mode in _GRIPPING):
            self._names(name)
        if mode in HONEST and (self._lie or not self._false) and not self._exempt():
            self.must(self._naming(), True)

    def _doubts(self, held: bool) -> Iterator[str]:
        """Yield the measurement channels that the estimator currently treats as faulty."""
        perception = self.daemon.loop.perception
        found = perception.filter.grasp
        for sensor in perception.fingers:
            side, finger = FINGERS[sensor.finger], sensor.finger
            if (
                found.rejects_frames[finger]
                or (held and (found.has_d_bias[finger] or found.has_angle_bias[finger]))
                or sensor.repeats.is_fault
            ):
                yield f"{side}_sensor"
            if found.has_wrong_current[finger]:
                yield f"{side}_current"

    def _names(self, name: str) -> None:
        """Check that the reported channel is faulty, unless a footprint just left the object."""
        wrong = self._lie or self.servos.fault or "".join(each.fault for each in self.sensors)
        self.account.named[f"{name} ({wrong or ('load' if self._loaded else 'nothing')})"] += 1
        if not self._exempt():
            found = f"{name} named, wrong is {self._false or 'none'}"
            self.must(self._naming(), name in self._false, found)

    def _exempt(self) -> bool:
        """Return True if a footprint just left the object."""
        return self.daemon.loop.state.t <= self._uncovered_t + _UNCOVERED

    def _naming(self) -> str:
        """Return the requirement that currently restricts the reported channels."""
        honest = LOADED if self._loaded else HONEST.get(self.daemon.loop.state.mode, LOADED)
        return NAMED.get(self._lie, honest)

    def _covered(self) -> bool:
        """Return True if the footprints of both tips are on the object's faces in the plant."""
        hand, simulation = self.hand, self.settings.simulation
        x, y, angle = hand.object_pose.tolist()
        sine, cosine, radius = math.sin(angle), math.cos(angle), self.settings.tip.radius
        for k, depth in enumerate(hand.d.tolist()):
            tip = hand.plant.fingers[k]
            along = abs((tip.y - y) * cosine - (tip.x - x) * sine)
            footprint = math.sqrt(max(depth * (2.0 * radius - depth), 0.0))
            if depth <= 0.0 or along + footprint > 0.5 * simulation.object_height:
                return False
        return not hand.on_other_tip.any()


def resident() -> float:
    """Return this process's resident memory after garbage collection [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def sequence(seed: int, ticks: int, account: Account) -> None:
    """Run the sequence of a seed, and add the violations to ``account``."""
    soak = Soak(seed, account)
    try:
        soak.run(ticks)
    except AssertionError as error:
        t, mode = soak.daemon.loop.state.t, soak.daemon.loop.state.mode
        account.failures.append(f"seed {seed}, tick {soak.count} ({t:.3f} s, {mode}): {error}")
    finally:
        account.held += soak.held
        soak.close()


def long_sequence(seed: int, ticks: int, account: Account) -> None:
    """Run one hand for a long time; record all messages and check the memory."""
    with tempfile.TemporaryDirectory() as folder:
        listener = Listener(Path(folder))
        soak = Soak(seed, account, listener)
        for look in range(_LOOKS):
            soak.run(ticks // _LOOKS)
            memory = resident()
            print(f"{soak.count} ticks: {memory:.1f} MB", file=sys.stderr, flush=True)
            if look >= _WARM - 1:
                account.memory.append(memory)
        account.published = listener.messages, listener.gaps()
        account.held += soak.held
        soak.close()
        listener.close()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.virtual", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of the first sequence")
    parser.add_argument("--sequences", type=int, default=SEQUENCES, metavar="N")
    parser.add_argument("--ticks", type=int, default=TICKS, metavar="N", help="of each")
    arguments = parser.parse_args()
    account, begin = Account(), time.monotonic()
    if arguments.ticks >= LONG:
        long_sequence(arguments.seed, arguments.ticks, account)
    else:
        for seed in range(arguments.seed, arguments.seed + arguments.sequences):
            sequence(seed, arguments.ticks, account)
            gc.collect()  # Reference cycles in a daemon keep megabytes of frames in memory.
    account.seconds = time.monotonic() - begin
    print("\n".join(account.lines()))
    few = account.held < HELD * account.sequences
    broken = account.failures or account.broken.keys() - _TOLERATED
    return 1 if broken or account.never or few or account.growth > _FLAT else 0


if __name__ == "__main__":
    sys.exit(main())
