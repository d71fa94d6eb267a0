"""Test the tolerances and timeouts of the state machine, with prescribed contacts."""

import math

import pytest

from softfinger.daemon.control.state_machine import Changing, Control, Settled, Turning
from softfinger.daemon.control.task import Task, TaskEnded
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Goal, State
from softfinger.kinematics.estimation.invalid import Invalid

FORCE = 8.0  # N
DT = 0.002  # s


class Machine:
    """State machine whose contacts and joint angles are set by the test."""

    def __init__(self) -> None:
        self.state, self.goal, grasp = State(), Goal(), GraspState()
        grasp.moment_arm, grasp.energy_arm = [0.079, 0.079], [0.079, 0.079]
        grasp.rolling_ratio, grasp.stiffness = [0.75, 0.75], [6e3, 6e3]
        grasp.d, grasp.normal = [4e-3, 4e-3], [FORCE, FORCE]
        self.grasp = grasp
        self.control = Control(Settings(), self.state, grasp)
        self.control.arm()
        self.run(0.1)

    def touch(self, force: float = FORCE, angle: float = 0.0) -> None:
        """Let both tips press with ``force`` [N] on an object at ``angle`` [rad]."""
        for contact in self.state.contacts:
            contact.contact, contact.invalid = True, Invalid.NONE
            contact.d, contact.force = 4e-3, force
        self.grasp.force = [force, force]
        pose = self.state.object
        pose.valid, pose.width, pose.angle = True, 0.04, angle

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.state.t += DT
            self.control.step(DT, self.goal)

    def hold(self, force: float = FORCE) -> str:
        """Grasp with FORCE while the tips press with ``force`` [N]; return the mode after 1 s."""
        self.touch(force)
        self.control.grasp(FORCE)
        self.run(1.0)
        return self.control.mode

    @property
    def warnings(self) -> list[str]:
        return [kind for level, kind, _ in self.control.events if level == "warning"]


@pytest.mark.parametrize(("share", "mode"), [(0.98, "holding"), (1.02, "holding")])
def test_a_force_within_a_few_percent_counts_as_reached_at_once(share, mode):
    assert Machine().hold(share * FORCE) == mode


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_force_that_friction_may_explain_counts_as_reached_after_two_seconds(share):
    machine = Machine()
    assert machine.hold(share * FORCE) == "grasping"
    machine.run(0.7)
    assert machine.control.mode == "grasping"
    machine.run(1.3)
    assert machine.control.mode == "holding"


@pytest.mark.parametrize(("share", "mode"), [(0.93, "holding"), (0.87, "grasping")])
def test_a_force_further_off_than_friction_may_explain_is_never_reached(share, mode):
    machine = Machine()
    machine.hold(share * FORCE)
    machine.run(9.0)
    assert machine.control.mode == mode


@pytest.mark.parametrize(("off", "arrives"), [(0.35, True), (0.7, False)])
def test_a_turn_ends_within_half_a_degree_of_its_target(off, arrives):
    machine = Machine()
    assert machine.hold() == "holding"
    machine.control.rotate(0.1)
    machine.touch(angle=0.1 - math.radians(off))
    machine.run(3.0)
    assert isinstance(machine.control.state, Settled if arrives else Turning)


def test_a_turn_ends_within_the_noise_of_the_angle():
    """The controller does not correct errors within the noise, so such errors would persist."""
    machine = Machine()
    assert machine.hold() == "holding"
    machine.grasp.angle_std = 0.01
    machine.control.rotate(0.1)
    machine.touch(angle=0.1 - math.radians(1.0))
    machine.run(3.0)
    assert isinstance(machine.control.state, Settled)


@pytest.mark.parametrize(("change", "expected"), [(1.3e-3, Settled), (3e-3, Changing)])
def test_small_changes_of_a_streamed_angle_are_noise(change, expected):
    machine = Machine()
    machine.hold()
    machine.control.hold(angle=change)
    assert isinstance(machine.control.state, expected)


@pytest.mark.parametrize(("change", "expected"), [(1.02, Settled), (1.045, Changing)])
def test_small_changes_of_a_streamed_force_are_noise(change, expected):
    machine = Machine()
    machine.hold()
    machine.control.hold(force=change * FORCE)
    assert isinstance(machine.control.state, expected)


@pytest.mark.parametrize(("off", "arrives"), [(0.02, True), (0.045, False)])
def test_a_joint_arrives_within_a_small_distance_or_is_stuck_after_two_seconds(off, arrives):
    machine = Machine()
    machine.control.move(left=-0.1)
    machine.state.reading.q[0] = -0.1 + off
    machine.run(1.7)
    assert machine.control.mode == ("armed" if arrives else "moving")
    machine.run(1.5)
    assert machine.control.mode == "armed"
    assert machine.warnings == ([] if arrives else ["short"])


def test_in_a_grip_the_current_limits_determine_the_torques():
    """A servo draws its full current from 0.25 rad on, and the goal may jump within its reach."""
    machine = Machine()
    assert machine.hold() == "holding"
    for goal, q in zip(machine.goal.q, machine.state.reading.q, strict=True):
        assert 0.25 < abs(goal - q) < Settings().safety.goal_reach


def test_a_turn_stays_a_tenth_of_a_radian_below_the_largest_tilt():
    machine = Machine()
    machine.touch()
    angle = machine.control.fingers.limited_angle(3.0)
    tilt = angle * (1.0 + 1.0 / 1.5)  # The joints move by angle/(r1 + r2).
    largest = math.asin(1.0 - 4e-3 / 0.020) - Settings().safety.theta_margin
    assert largest - tilt == pytest.approx(0.1, rel=0.4)


def test_a_task_ends_if_a_step_takes_longer_than_ten_seconds():
    task, state = Task(Settings()), State()
    assert any(task.next(state, DT) for _ in range(round(5.0 / DT)))
    state.mode = "moving"
    assert not any(task.next(state, DT) for _ in range(round(8.0 / DT)))
    with pytest.raises(TaskEnded, match="still moving after"):
        any(task.next(state, DT) for _ in range(round(4.0 / DT)))
