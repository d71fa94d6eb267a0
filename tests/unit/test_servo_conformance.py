"""Test the simulated servo backend and the Dynamixel backend in each operating mode.

Both backends must pass the same tests. To test another backend, add it to ``RIGS``.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any, Protocol

import pytest

from softfinger.daemon.clock import Clock, VirtualClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import ServoSettings, Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos import dynamixel
from softfinger.daemon.servos.base import Servos, make_servos
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.joint import current_toward
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.types import Goal, Reading
from softfinger.testing.emulated import FreeJoints
from tests.harness.plant import PAPER
from tests.harness.servos import RADIAN, DirectPort

CURRENT_UNIT = 2.69e-3
MODES = ("current-based position", "current", "position")
BOUNDED = ("current-based position", "current")


class Rig(Protocol):
    """A backend and the joints that it moves."""

    servos: Servos
    clock: Clock

    def torque(self) -> list[bool]:
        """Return a list that contains True for each servo whose motor is driven."""


class SimulatedRig:
    """The simulated backend, which uses a virtual clock."""

    def __init__(self, _: pytest.MonkeyPatch, **sections: Any) -> None:
        settings = Settings.model_validate({"material": {"law": "constant"}, **sections})
        self.clock: Clock = VirtualClock()
        self._hand = SimulatedHand(settings, table=PAPER)
        self.servos = make_servos(settings, self.clock, self._hand)

    def torque(self) -> list[bool]:
        self._hand.advance(self.clock.now())
        return [bool(on) for on in self._hand.torque_on]


class DynamixelRig:
    """The Dynamixel backend with the SDK, and an emulated bus that uses the same clock.

    Bytes are transferred immediately, without a pty, so a busy machine has no effect.
    """

    def __init__(
        self, patch: pytest.MonkeyPatch, *, servos: dict[str, Any], **sections: Any
    ) -> None:
        settings = Settings.model_validate(
            {"servos": {"backend": "dynamixel", **servos}, **sections}
        )
        self.clock: Clock = VirtualClock()
        self.bus = ServoBus.from_settings(settings, FreeJoints(2))
        port = DirectPort(self.bus, clock=self.clock.now)
        patch.setattr(dynamixel, "SerialPort", lambda *_: port)
        self.servos = DynamixelServos(settings, self.clock)

    def torque(self) -> list[bool]:
        return [servo.torque_on for servo in self.bus.servos]


RIGS: dict[str, Callable[..., Rig]] = {"simulated": SimulatedRig, "dynamixel": DynamixelRig}


@pytest.fixture(params=RIGS)
def make(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Rig]]:
    """Return a function that creates rigs of one backend; the rigs are closed after the test."""

    def start(mode: str = MODES[0], **sections: Any) -> Rig:
        servos = {"mode": mode, "watchdog": 0.5, **sections.pop("servos", {})}
        rig = RIGS[request.param](monkeypatch, servos=servos, **sections)
        stack.enter_context(closing(rig.servos))
        return rig

    with ExitStack() as stack:
        yield start


def ticks(rig: Rig, goal: Goal, seconds: float) -> list[Reading]:
    """Read and write on each tick as the loop does; return all readings."""
    readings = []
    deadline, end = rig.clock.now(), rig.clock.now() + seconds
    while deadline < end:
        rig.clock.sleep_until(deadline)
        reading = Reading()
        rig.servos.read(reading)
        assert reading.valid
        readings.append(reading)
        rig.servos.write(goal)
        deadline = max(deadline + 0.002, rig.clock.now())
    return readings


def armed(rig: Rig) -> Reading:
    rig.servos.connect()
    rig.servos.torque_on()
    reading = Reading()
    rig.servos.read(reading)
    return reading


@pytest.mark.parametrize("mode", MODES)
def test_connect_leaves_torque_off_and_reads(make, mode):
    rig = make(mode)
    rig.servos.connect()
    assert rig.torque() == [False, False]
    first, second = ticks(rig, Goal(q=[0.3, 0.3], current=[1.0, 1.0]), 0.004)[:2]
    assert first.q == second.q == [0.0, 0.0]  # A goal has no effect while torque is off.
    assert first.current == [0.0, 0.0]
    assert second.t >= first.t
    assert first.alert == 0
    assert rig.torque() == [False, False]


@pytest.mark.parametrize("mode", MODES)
def test_torque_on_holds_the_current_positions(make, mode):
    rig = make(mode)
    before = armed(rig)
    assert rig.torque() == [True, True]
    after = ticks(rig, Goal(q=list(before.q), current=[0.5, 0.5]), 0.1)[-1]
    assert after.q == pytest.approx(before.q, abs=1.5 * RADIAN)


@pytest.mark.parametrize("mode", MODES)
def test_joints_reach_their_goals_in_the_right_direction(make, mode):
    rig = make(mode)
    armed(rig)
    goal = Goal(q=[0.08, -0.12], current=[0.5, 0.5])
    readings = ticks(rig, goal, 0.6)
    assert readings[-1].q == pytest.approx(goal.q, abs=0.01)
    fastest = [max((r.dq[i] for r in readings), key=abs) for i in (0, 1)]
    assert fastest[0] > 0.2
    assert fastest[1] < -0.2
    pushed = [max((r.current[i] for r in readings), key=abs) for i in (0, 1)]
    assert pushed[0] * fastest[0] > 0.0
    assert pushed[1] * fastest[1] > 0.0


@pytest.mark.parametrize("mode", BOUNDED)
def test_the_current_limit_holds_along_the_entire_motion(make, mode):
    rig = make(mode)
    armed(rig)
    bound = 0.1
    readings = ticks(rig, Goal(q=[0.1, -0.3], current=[bound, bound]), 0.3)
    currents = [abs(current) for reading in readings for current in reading.current]
    assert 0.5 * bound < max(currents) <= bound + CURRENT_UNIT


def test_position_mode_uses_the_current_it_needs(make):
    rig = make("position")
    armed(rig)
    readings = ticks(rig, Goal(q=[0.08, -0.3], current=[0.0, 0.0]), 0.4)
    assert readings[-1].q == pytest.approx([0.08, -0.3], abs=0.01)


@pytest.mark.parametrize("mode", BOUNDED)
def test_zero_current_causes_no_motion(make, mode):
    rig = make(mode)
    armed(rig)
    readings = ticks(rig, Goal(q=[0.1, -0.3], current=[0.0, 0.0]), 0.1)
    assert readings[-1].q == pytest.approx([0.0, 0.0], abs=1.5 * RADIAN)
    assert max(abs(current) for r in readings for current in r.current) <= CURRENT_UNIT


@pytest.mark.parametrize("mode", MODES)
def test_torque_off_and_close_release_the_joints(make, mode):
    rig = make(mode)
    armed(rig)
    goal = Goal(q=[0.05, -0.05], current=[0.5, 0.5])
    ticks(rig, goal, 0.1)
    assert rig.servos.torque_off(Reading())
    assert rig.torque() == [False, False]
    assert ticks(rig, goal, 0.1)[-1].current == pytest.approx([0.0, 0.0], abs=CURRENT_UNIT)
    rig.servos.torque_on()
    assert rig.torque() == [True, True]
    rig.servos.close()
    assert rig.torque() == [False, False]
    rig.servos.close()
    with pytest.raises(ServoError, match="not connected"):
        rig.servos.torque_on()


@pytest.mark.parametrize("mode", MODES)
def test_a_finger_outside_the_scene_stays_zero(make, mode):
    rig = make(mode, scene={"fingers": ("right",)})
    if isinstance(rig, DynamixelRig):
        rig.bus.fault("silent", 1, 0.0)  # The backend does not use servo 1.
    armed(rig)
    reading = ticks(rig, Goal(q=[0.1, -0.1], current=[0.4, 0.4]), 0.4)[-1]
    assert reading.q[0] == reading.dq[0] == reading.current[0] == 0.0
    assert reading.q[1] == pytest.approx(-0.1, abs=0.01)
    assert rig.torque() == [False, True]


@pytest.mark.parametrize("mode", MODES)
def test_a_model_without_current_sensing_only_supports_position_mode(make, mode):
    rig = make(mode, servos={"model": "XL430-W250"})
    if mode != "position":
        with pytest.raises(ServoError, match=f"XL430-W250 does not support {mode} mode"):
            rig.servos.connect()
        return
    armed(rig)
    assert ticks(rig, Goal(q=[0.08, -0.1]), 0.5)[-1].q == pytest.approx([0.08, -0.1], abs=0.01)


# Control loop in current mode, and checks in position mode


def test_the_control_loop_of_current_mode():
    servos = ServoSettings(stiffness=10.0, damping=0.5)
    assert current_toward(servos, 0.1, 2.0, 0.0, 0.0) == pytest.approx(1.0)
    assert current_toward(servos, 0.1, 2.0, 0.0, 1.0) == pytest.approx(0.5)
    assert current_toward(servos, 0.1, 0.3, 0.0, 0.0) == 0.3
    assert current_toward(servos, -9.0, -0.3, 0.0, 0.0) == -0.3


def test_position_limits_that_exclude_the_joint_range_are_reported(monkeypatch):
    rig = DynamixelRig(monkeypatch, servos={"mode": "position"})
    table = rig.bus.servos[1].table
    table.set(reg.MAX_POSITION_LIMIT, 2100)
    with pytest.raises(
        ServoError, match=r"servo 2 .*max position limit is 2100, the joint requires"
    ):
        rig.servos.connect()
    table.set(reg.MAX_POSITION_LIMIT, 4095)
    rig.servos.connect()
    notices = [each.text for each in rig.servos.notices]
    assert notices.count('servos.mode = "position" does not limit the current of the servo') == 2
    rig.servos.close()


@pytest.mark.parametrize("mode", BOUNDED)
def test_each_joint_has_its_own_current_limit(make, mode):
    rig = make(mode, servos={"current_limit": (0.15, 0.08)})
    armed(rig)
    readings = ticks(rig, Goal(q=[0.1, -0.3], current=[1.0, 1.0]), 0.2)
    for finger, limit in enumerate((0.15, 0.08)):
        greatest = max(abs(reading.current[finger]) for reading in readings)
        assert 0.6 * limit < greatest <= limit + CURRENT_UNIT
