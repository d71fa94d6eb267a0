"""Test detections and false alarms of the consistency checks on joint readings."""

import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.safety.limits import JointMotion
from softfinger.daemon.types import Reading
from tests.harness.loop import advance_to, armed, command, grasped, refusal

TICK = 0.002
COUNT = 2.0 * math.pi / 4096
RATE = 0.229 * 2.0 * math.pi / 60.0  # one velocity count [rad/s]


class Joint:
    """A moving joint, whose servo reports whole counts a few milliseconds late."""

    def __init__(self, seed: int = 1) -> None:
        self.reading = Reading(valid=True, t=0.0)
        self.motion = JointMotion((0, 1), 6.0, TICK)
        self.t = self.q = self.dq = 0.0
        self.random = random.Random(seed)

    def tick(self, dq: float, lag: float = 0.02, held: float = 0.0) -> int:
        """Move at ``dq`` [rad/s] for a tick; the loop receives the servo's reply ``held`` [s] late.
        The reported velocity has the time constant ``lag`` [s].
        """
        self.t += TICK
        self.q += dq * TICK
        self.dq += (dq - self.dq) * min(TICK / lag, 1.0)
        reading = self.reading
        if self.random.random() < 0.01:
            held += 0.015  # The process was suspended.
        reading.t = max(reading.t, self.t + self.random.uniform(0.0003, 0.004) + held)
        reading.q[0] = COUNT * round(self.q / COUNT)
        reading.dq[0] = RATE * round(self.dq / RATE)
        self.motion.update(self.t, reading)
        return self.motion.jumped


@pytest.mark.parametrize("seed", range(5))
def test_normal_motion_is_not_a_jump(seed):
    joint = Joint(seed)
    turn = 0.0
    for k in range(20_000):
        if k % 100 == 0:
            turn = joint.random.choice((0.0, 0.0, 0.05, 0.3, -1.0, 1.0, 2.0, -2.0))
        assert not joint.tick(turn), f"at {joint.t:.3f} s"


@pytest.mark.parametrize("jump", [0.2, -0.2, 0.12])
def test_an_angle_jump_is_detected_immediately(jump):
    joint = Joint()
    for _ in range(100):
        joint.tick(0.3)
    joint.q += jump
    assert joint.tick(0.3) == 1
    assert not joint.tick(0.3), "only the reading with the jump must be rejected"


def test_an_encoder_that_drifts_at_zero_velocity_is_detected():
    joint = Joint()
    seconds = next(k * TICK for k in range(200) if joint.tick(2.0, lag=math.inf))
    assert seconds < 0.1


def test_a_velocity_without_motion_is_detected():
    joint = Joint()
    joint.dq = 2.5
    seconds = next(k * TICK for k in range(200) if joint.tick(0.0, lag=math.inf))
    assert seconds < 0.1


def test_a_joint_that_stops_between_late_readings_of_a_slow_loop_does_not_jump():
    motion, reading = JointMotion((0, 1), 6.0, 0.1), Reading(valid=True)
    for t, q, dq in ((0.0, 0.0, 1.0), (0.1, 0.1, 1.0), (0.3, 0.25, 0.0)):
        reading.t, reading.q[0], reading.dq[0] = t, q, dq
        motion.update(t - 0.001, reading)
        assert not motion.jumped


@pytest.mark.parametrize("seconds", [0.03, 0.06, 0.2])
def test_a_stall_while_a_joint_moves_is_not_a_jump(seconds):
    """Stall the loop before it sends a request, or before it receives the reply."""
    for at_answer in (False, True):
        joint = Joint()
        for _ in range(100):
            joint.tick(3.0)
        if at_answer:
            assert not joint.tick(3.0, held=seconds)
        joint.t += seconds
        joint.q += 3.0 * seconds
        for _ in range(100):
            assert not joint.tick(3.0)


def test_a_jump_during_lost_readings_is_detected():
    joint = Joint()
    for _ in range(10):
        joint.tick(0.0)
    joint.t += 0.02
    joint.q += 0.3
    assert joint.tick(0.0) == 1


# --- in the loop --------------------------------------------------------------------------------


def spoil(daemon: Daemon, how: Callable[[Reading], None]) -> None:
    """Corrupt all later readings with the function ``how``."""
    servos = daemon.loop.torque.servos
    really = servos.read

    def read(reading: Reading) -> None:
        really(reading)
        how(reading)

    servos.read = read


def jumped(reading: Reading) -> None:
    reading.q[1] += 0.2


class Stuck:
    """Simulate an encoder and a current sensor that are stuck."""

    def __init__(self) -> None:
        self.q: float | None = None

    def __call__(self, reading: Reading) -> None:
        if self.q is None:
            self.q = reading.q[1]
        reading.q[1], reading.dq[1], reading.current[1] = self.q, 0.0, 0.0


@pytest.mark.parametrize(
    ("how", "name", "within"),
    [(jumped, "joint.jump", 0.01), (Stuck(), "joint.dead", 0.12)],
    ids=["jumped", "stuck"],
)
def test_a_joint_fault_ends_a_grip(make, how, name, within):
    daemon = grasped(make(), 8.0)
    spoil(daemon, how)
    advance_to(daemon, "fault", within)
    assert daemon.loop.state.fault_name == name


@pytest.mark.parametrize(("ticks_with_torque", "fault"), [(0, ""), (3, "joint.jump")])
def test_only_readings_with_torque_on_are_compared(make, ticks_with_torque, fault):
    """With torque off, an emulated hand does not wait for the daemon, so readings may jump."""
    daemon = make()
    daemon.loop.advance(0.1)
    if ticks_with_torque:
        command(daemon, "arm")
        daemon.loop.advance(ticks_with_torque * TICK)
    spoil(daemon, jumped)
    if not ticks_with_torque:
        command(daemon, "arm")
    daemon.loop.advance(0.1)
    assert daemon.loop.state.fault_name == fault


@pytest.mark.parametrize(
    "mode", ["current-based position", pytest.param("current", marks=pytest.mark.extended)]
)
def test_grips_turns_stops_and_pushes_cause_no_false_alarm(make, mode):
    """Move joints freely, grip and turn an object, and push joints away from their goals."""
    daemon = make(servos={"mode": mode})
    hand: Any = daemon.hand
    command(daemon, "arm")
    command(daemon, "move", left=-0.5, right=-0.5)
    daemon.loop.advance(3.0)
    hand.apply_load(0.0, 0.0)
    command(daemon, "grasp", force=6.0)
    advance_to(daemon, "holding", 6.0)
    daemon.loop.advance(0.5)
    assert [c.force for c in daemon.loop.state.contacts] == pytest.approx([6.0, 6.0], rel=0.05)
    for angle in (0.1, -0.1, 0.0):
        command(daemon, "rotate", angle=angle)
        daemon.loop.advance(1.5)
    hand.apply_load(1.0, 0.5, 0.02)
    daemon.loop.advance(1.0)
    hand.apply_load(0.0, 0.0)
    daemon.loop.advance(5.0)
    command(daemon, "release")
    daemon.loop.advance(2.0)
    assert daemon.loop.state.fault_name == ""


def test_position_mode_moves_without_current_checks(make):
    daemon = armed(make(servos={"mode": "position", "model": "XL430-W250"}))
    assert "does not limit the current" in refusal(daemon, "grasp", force=8.0)
    command(daemon, "move", left=0.05, right=-0.1)
    daemon.loop.advance(1.0)
    assert daemon.loop.state.reading.q == pytest.approx([0.05, -0.1], abs=0.01)
    command(daemon, "move", left=0.3, right=0.3)  # The fingers close on the object.
    daemon.loop.advance(2.0)
    assert daemon.loop.state.fault_name == ""
