"""Create states for tests of the limits, and `Safety` objects that check the states."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.perception import RepeatDetector
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.limits import LIMITS
from softfinger.daemon.safety.safety import Safety
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.tactile.base import TactileSensor
from softfinger.daemon.types import Contact, Frame, Goal, State
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid

SETTINGS = Settings()
BOUNDS = SETTINGS.safety


class Sensor:
    """Sensor with only those properties that the limits read."""

    def __init__(self, finger: int) -> None:
        self.finger = finger
        self.frame: Frame | None = None
        self.changed_time = 0.0
        self.repeats = RepeatDetector(100.0, 10.0)
        self.estimate = ContactEstimate()
        self.full_count = SETTINGS.tactile.full_count
        self.noise = 0.0
        self.sensor: TactileSensor | None = None

    def give(self, t: float, data: Any) -> None:
        last, self.frame = self.frame, Frame(0, t, t, True, np.array(data, np.uint16))
        if last is None or not np.array_equal(last.data, self.frame.data):
            self.changed_time = t


def safety(
    settings: Settings = SETTINGS, grasp: GraspState | None = None, sensors: Sequence[Any] = ()
) -> Safety:
    return Safety(settings, grasp or GraspState(), sensors)


def sound(mode: Mode = Mode.HOLDING) -> State:
    """Return a fault-free state whose time is 5 s."""
    state = State(t=5.0, mode=mode, torque=True, seq=10)
    state.reading.t = 5.0
    state.reading.valid = True
    state.reading.temperature = [40.0, 40.0]
    state.reading.voltage = [12.0, 12.0]
    state.contacts = [
        Contact(
            seq=1,
            t=4.99,
            t_arrival=5.0,
            t_valid=5.0,
            invalid=Invalid.NONE,
            contact=True,
            d=0.004,
            theta=0.1,
            theta_std=1e-3,
            force=5.0,
        )
        for _ in range(2)
    ]
    state.object.valid = True
    state.object.width = 0.04
    state.goal = goal((0.0, 0.0), (0.3, 0.3))
    return state


class Deaf:
    """Servos that accept and ignore all goals."""

    def write(self, _: Goal) -> None:
        pass


def bounded(judge: Safety, state: State) -> None:
    """Limit the state's goal as the daemon does before it sends a goal to the servos."""
    judge.write(cast(Servos, Deaf()), state)


def goal(q: tuple[float, float], current: tuple[float, float]) -> Goal:
    return Goal(valid=True, q=list(q), current=list(current))


def later(state: State, dt: float) -> None:
    """Advance the time without changing the age of the data."""
    state.t += dt
    state.reading.t += dt
    state.seq += 1
    for contact in state.contacts:
        contact.t_valid += dt
        contact.t_arrival += dt


def levers(lever: float) -> GraspState:
    held = GraspState()
    held.energy_arm = [lever, lever]
    return held


def judged(judge: Safety, state: State, seconds: float = 0.0) -> tuple[str, str]:
    """Check the same state repeatedly for ``seconds``; return the fault. Every limit is checked."""
    found = None
    for _ in range(max(round(seconds / 0.002), len(LIMITS)) + len(LIMITS)):
        found = judge.judge(state)
        later(state, 0.002)
    return ("", "") if found is None else (found.name, found.text)
