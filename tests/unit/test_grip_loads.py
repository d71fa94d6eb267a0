"""Test the grip controller and the slip monitor alone, with prescribed loads."""

import math

import numpy as np
import pytest

from softfinger.daemon.control.grip import Grip
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import ObjectPose, Reading

FORCE = 10.0
FRICTION = 0.05 / 0.03  # load that joint friction can hide at a moment arm of 30 mm [N]


class GripUnderLoad:
    """Grip controller with prescribed loads, without an object."""

    def __init__(self, asked: float = FORCE, **control: float) -> None:
        self.held = held = GraspState()
        held.load_arm = 0.03
        held.moment_arm, held.rolling_ratio, held.stiffness = (
            [0.079, 0.079],
            [0.75, 0.75],
            [6e3, 6e3],
        )
        held.d, held.force = [4e-3, 4e-3], [asked, asked]
        self.grip = Grip(Settings.model_validate({"control": control}), [0, 1], held)
        self.grip.start(asked, asked)

    def run(
        self,
        load: float,
        ticks: int,
        holding: bool = True,
        normal: float = 10.0,
        speed: float = 0.0,
        sense: float = 1.0,
    ) -> float:
        """Run ``ticks`` under a load; return the goal force [N]. The joints close at ``speed``.

        ``sense`` is the ratio of the right joint's values to the left joint's values. The ratio is
        -1 for a twist.
        """
        torque = self.held.load_arm * load
        self.held.torque_residual = [torque, sense * torque]
        self.held.normal = [normal, normal]
        for _ in range(ticks):
            self.grip.torques(Reading(dq=[speed, sense * speed]), ObjectPose(), holding)
        return self.grip.target


def test_a_load_is_detected_only_beyond_joint_friction():
    watched = GripUnderLoad(friction_speed=1e6)  # Friction is not compensated while closing.
    watched.run(1.5, 500, holding=False)
    watched.grip.begin_holding()
    assert watched.run(1.5, 500) == FORCE
    assert watched.grip.slip.load == 0.0
    # The controller adds the load that friction may hide to the detected load.
    for load in np.linspace(1.5, 6.0, 500):
        watched.run(load, 1)
    found = watched.run(6.0, 500)
    expected = (6.0 - watched.grip.slip.offset / 0.03 + FRICTION) / (0.6 * 0.8)
    assert found == pytest.approx(expected, rel=0.01)


def at_rest(asked: float = FORCE) -> GripUnderLoad:
    """Return a grip that has held without a load for 600 ticks."""
    watched = GripUnderLoad(asked, friction_speed=1e6)
    watched.run(0.0, 500, holding=False, normal=asked)
    watched.grip.begin_holding()
    watched.run(0.0, 600, normal=asked)
    return watched


def test_torque_that_the_friction_of_stationary_joints_balances_is_not_a_load():
    watched = at_rest()
    for load in np.linspace(0.0, -4.0, 4000):  # The tips relax, so the torques decrease.
        watched.run(load, 1)
    state, load_arm = watched.grip._state, watched.held.load_arm
    torque = state.torque[0]
    watched.held.energy_arm = [0.01, 0.01]  # The controller increases the torques by 0.1 N·m.
    for _ in range(100):
        assert watched.run(-4.0 + (state.torque[0] - torque) / load_arm, 1) == FORCE
        assert watched.grip.slip.load == 0.0


@pytest.mark.parametrize("error", [0.5, -0.5])
def test_a_lasting_force_error_does_not_wind_up_the_integral(error):
    """A joint that sticks keeps the force wrong for seconds; then the force recovers at once."""
    watched = GripUnderLoad()
    watched.held.force = [FORCE * (1.0 - error)] * 2
    watched.run(0.0, 2500, holding=False)
    assert (watched.grip._state.grip_force - FORCE) * error > 0.0
    watched.held.force = [FORCE * (1.0 + 0.5 * error)] * 2
    watched.run(0.0, 250, holding=False)
    assert (watched.grip._state.grip_force - FORCE) * error < 0.0


GIVES_WAY = -0.024  # one velocity count [rad/s]


def test_a_sudden_load_immediately_raises_the_grip_by_the_maximum():
    watched = at_rest()
    # A jump without joint motion is a frame error. A load below the friction limit is harmless.
    assert watched.run(3.0 * FRICTION, 1) == FORCE
    watched = at_rest()
    assert watched.run(0.8 * FRICTION, 1, speed=GIVES_WAY) == FORCE
    watched = at_rest()
    assert watched.run(2.0 * FRICTION, 1, speed=GIVES_WAY) == FORCE + 10.0
    state = watched.grip._state
    # The force reaches its limit on the same tick. The limit is the force increased by twice the
    # torque constant's error, plus friction and load.
    most = (FORCE + 10.0) * 1.2 + (0.05 + 0.03 * state.slip.load) / 0.079
    assert state.grip_force == pytest.approx(most, rel=0.02)
    # Once the measured force has increased, the controller keeps the force set by the reflex.
    watched.held.force = [FORCE + 10.0] * 2
    watched.run(2.0 * FRICTION, 1)
    assert state.grip_force == pytest.approx(FORCE + 10.0, rel=0.03)


@pytest.mark.parametrize(("duration", "raised"), [(3.0, False), (0.0, True)])
def test_the_end_of_a_load_that_the_offset_has_followed_is_not_a_sudden_load(duration, raised):
    """A load within the joint friction cannot be distinguished from friction after some time."""
    watched = at_rest(6.0)
    for load in np.linspace(0.0, 0.95 * FRICTION, 500) * (duration > 0.0):
        watched.run(load, 1, normal=6.0)
    watched.run(0.95 * FRICTION * (duration > 0.0), round(500 * duration), normal=6.0)
    end = 0.0 if duration else -0.95 * FRICTION
    watched.run(end, 1, normal=6.0, speed=-GIVES_WAY)
    assert watched.grip.slip.reflex_triggered == raised


def test_a_sudden_twist_immediately_raises_the_grip():
    for speed, raised in ((0.0, 0.0), (-GIVES_WAY, 0.0), (GIVES_WAY, 10.0)):
        watched = at_rest()
        assert watched.run(2.0 * FRICTION, 1, speed=speed, sense=-1.0) == FORCE + raised
    watched = at_rest()
    assert watched.run(0.8 * FRICTION, 1, speed=GIVES_WAY, sense=-1.0) == FORCE


def test_a_constant_load_leaves_less_margin_for_a_sudden_one():
    """If each tip already carries 3 N, a smaller sudden load triggers the reflex."""
    watched = at_rest()
    for load in np.linspace(0.0, 3.0, 500):
        watched.run(load, 1)
    assert watched.run(3.0, 1000) == FORCE
    assert watched.run(3.0 + 0.8 * FRICTION, 1, speed=GIVES_WAY) == FORCE + 10.0


@pytest.mark.parametrize("kind", ["pull_shear", "twist_shear"])
def test_shear_of_solid_tips_reveals_a_load(kind):
    watched = at_rest()
    setattr(watched.held, kind, -1.0)
    assert watched.run(0.0, 500) == FORCE
    setattr(watched.held, kind, -3.5)  # The load exceeds half of the friction limit.
    assert watched.run(0.0, 1) == FORCE + 10.0


def test_a_load_on_one_joint_alone_is_not_a_sudden_load():
    """If only one joint appears loaded, its current is wrong or the joint is defective."""
    watched = at_rest()
    for torque in (0.3, -0.3, 0.3):
        watched.held.torque_residual = [0.0, torque]
        for _ in range(5):
            watched.grip.torques(Reading(), ObjectPose(), True)
            assert not watched.grip.slip.reflex_triggered


@pytest.mark.parametrize(
    ("shown", "raised"),
    [
        ((0.3, 0.3), True),
        ((0.4, 0.2), True),
        ((0.5, 0.1), False),
        ((0.6, 0.0), False),
        ((0.6, -0.2), False),
    ],
)
def test_a_turn_seen_by_one_tip_alone_is_ignored(shown, raised):
    """If one tip's image is mirrored or shifted, only one tip appears to turn."""
    watched = at_rest()
    watched.held.unexplained_rotation = list(shown)
    assert (watched.run(0.0, 1) > FORCE) == raised


@pytest.mark.parametrize("force", [5.0, 10.0])
def test_current_noise_is_not_a_load_but_does_not_hide_one(force):
    """Add noise of 30 mA; use a load towards the palm, which is the hardest to detect."""
    rng = np.random.default_rng(1)
    watched = at_rest(force)
    watched.held.load_arm, watched.held.load_curvature = 0.025, 0.02 / force
    noise = 0.030 * 1.78 * rng.standard_normal((30_000, 2))
    for tick, pair in enumerate(noise.tolist()):
        watched.held.torque_residual = pair
        # The load acts before the grip begins.
        watched.grip.torques(Reading(), ObjectPose(), tick > 500)
        assert watched.grip.target == force
    watched.held.torque_residual = [0.35, 0.35]
    watched.grip.torques(Reading(dq=[GIVES_WAY, GIVES_WAY]), ObjectPose(), True)
    assert watched.grip.slip.reflex_triggered


def standing(load: float, asked: float = 4.0) -> GripUnderLoad:
    """Return a grip after a slow increase of the load, during which the joints did not move."""
    watched = at_rest(asked)
    for part in np.linspace(0.0, load, 500):
        watched.run(part, 1, normal=asked)
    watched.run(load, 100, normal=asked)
    return watched


def test_a_load_is_still_known_after_the_force_has_changed():
    watched = standing(3.0 * FRICTION)
    raised = watched.grip.target
    watched.grip.retarget(4.4)
    watched.run(3.0 * FRICTION, 50, holding=False, normal=raised)
    watched.grip.begin_holding()
    assert watched.run(3.0 * FRICTION, 1000, normal=raised) > 1.5 * 4.4
    # Remove the load during a force change; the force must then return to the commanded value.
    watched.grip.retarget(4.8)
    watched.run(0.0, 50, holding=False, normal=raised)
    watched.grip.begin_holding()
    assert watched.run(0.0, 3000, normal=4.8) == 4.8


def test_torque_alone_raises_a_grip_by_30_percent_unless_the_load_exceeds_friction():
    assert standing(1.7 * FRICTION).grip.target == pytest.approx(1.3 * 4.0)
    assert standing(3.0 * FRICTION).grip.target > 1.5 * 4.0
    declared = GripUnderLoad(4.0, object_load=6.0)
    declared.grip.begin_holding()
    assert declared.run(0.0, 500) == pytest.approx(0.5 * 6.0 / (0.6 * 0.8))


def test_friction_identified_during_the_approach_limits_load_detection():
    for shown, raised in ((0.05, True), (0.2, False), (5.0, False)):
        watched = GripUnderLoad(friction_speed=1e6)
        watched.held.free_torque = [shown, shown]
        watched.run(0.0, 500, holding=False)
        watched.grip.begin_holding()
        for load in np.linspace(0.0, 5.5, 500):
            watched.run(load, 1)
        assert (watched.run(5.5, 100) > FORCE) == raised
        # The current of 0.15 A during the approach limits the torque.
        assert watched.grip.slip.joint_friction == pytest.approx(min(shown, 0.15 * 1.78))


def test_a_faulty_channel_cancels_the_force_increase_it_caused():
    watched = at_rest()
    assert watched.run(2.0 * FRICTION, 1, speed=GIVES_WAY) == FORCE + 10.0
    watched.held.sensor_fault = True
    assert watched.run(2.0 * FRICTION, 1, speed=GIVES_WAY) == FORCE
    assert not watched.grip.slip.reflex_triggered


def test_the_force_increase_is_limited_by_its_setting_and_the_force_limit():
    for more, share, expected in (
        *((2.0, 10.0, 12.0), (100.0, 10.0, 27.0), (0.0, 10.0, 10.0)),
        (10.0, 0.5, 15.0),
    ):
        watched = GripUnderLoad(grip_raise_max=more, grip_raise_share=share)
        watched.grip.begin_holding()
        assert watched.run(50.0, 500) == pytest.approx(expected)


def test_the_more_loaded_tip_is_not_pressed_beyond_the_force_limit():
    """A push perpendicular to the faces presses the object into one tip and resembles a twist."""
    watched = GripUnderLoad(grip_raise_share=10.0)
    watched.grip.begin_holding()
    watched.held.force = [FORCE - 9.0, FORCE + 9.0]
    assert watched.run(50.0, 500) == pytest.approx(0.9 * 30.0 - 9.0)
    watched.held.force = [FORCE - 18.0, FORCE + 18.0]
    assert watched.run(50.0, 500) == FORCE, "the commanded force is never reduced"


def test_a_grip_force_below_the_friction_limit_is_not_raised_by_torques():
    watched = GripUnderLoad(2.0)
    watched.held.normal = [2.0, 2.0]
    watched.grip.begin_holding()
    assert {watched.run(4.0, 1, normal=2.0) for _ in range(1000)} == {2.0}
    watched.grip.retarget(12.0)
    assert watched.run(4.0, 1, holding=False, normal=2.0) == 12.0


def test_no_load_is_detected_before_holding_or_when_friction_reverses():
    watched = GripUnderLoad()
    assert {watched.run(20.0, 1, holding=False) for _ in range(500)} == {FORCE}
    watched.run(2.0, 500, holding=False)
    watched.grip.begin_holding()
    assert {watched.run(-1.5, 1) for _ in range(500)} == {FORCE}


def some_held(generator: np.random.Generator, force: float) -> GraspState:
    held = GraspState()
    held.force = [force, force]
    held.q = list(generator.uniform(-0.2, 0.2, 2))
    held.moment_arm = list(generator.uniform(0.06, 0.09, 2))
    held.rolling_ratio = list(generator.uniform(0.5, 1.0, 2))
    held.energy_arm = list(generator.uniform(0.06, 0.09, 2))
    held.stiffness = list(generator.uniform(2e3, 9e3, 2))
    held.normal = list(generator.uniform(5.0, 9.0, 2))
    held.slide = generator.uniform(-0.02, 0.02)
    held.angle_std = generator.uniform(0.0, 0.02)
    return held


def test_late_frames_keep_the_force_and_let_a_turn_stop():
    generator = np.random.default_rng(6)
    held = some_held(generator, 8.0)
    grip = Grip(Settings(), [0, 1], held)
    held.slide, held.moment_arm = 0.0, [0.08, 0.08]
    grip.start(8.0, 8.0)
    grip.steer(0.0, 0.3)
    for _ in range(100):
        grip.torques(Reading(), ObjectPose(True, 0.0, 0.03), False)
    pushes, leans = [], []
    for _ in range(400):
        left, right = grip.hold_goal(Reading())
        pushes.append(left / held.moment_arm[0] + right / held.moment_arm[1])
        leans.append(left - right)
    assert np.ptp(pushes) < 1e-6 * pushes[0]
    assert abs(leans[-1] - leans[-2]) < 1e-6 < abs(leans[1] - leans[0])


@pytest.mark.parametrize("finger", [0, 1])
def test_one_finger_alone_presses_with_the_requested_force(finger):
    settings = Settings.model_validate({"scene": {"fingers": (("left", "right")[finger],)}})
    held, closing = some_held(np.random.default_rng(7), 5.0), Reading()
    grip = Grip(settings, [finger], held)
    grip.start(5.0, 5.0)
    closing.dq[finger] = 0.1
    for reading in (Reading(), closing):
        for torques in (grip.torques(reading, ObjectPose(), False), grip.hold_goal(reading)):
            force = torques[finger] / held.moment_arm[finger]
            assert force < 5.0 if reading is closing else force == pytest.approx(5.0)
            assert torques[1 - finger] == 0.0


def test_torques_are_averaged_over_a_tenth_of_a_second():
    watched = at_rest()
    watched.run(0.8 * FRICTION, 50)  # 0.1 s
    reached = watched.grip.slip.residual[0] / watched.held.torque_residual[0]
    assert reached == pytest.approx(1.0 - 1.0 / math.e, abs=0.1)


def test_a_force_increase_is_held_for_one_second_and_removed_within_two():
    watched = at_rest()
    watched.run(2.0 * FRICTION, 1, speed=GIVES_WAY)
    targets = np.array([watched.run(0.0, 1) for _ in range(2500)])
    held = 0.002 * np.argmax(targets < FORCE + 9.99)
    removed = 0.002 * np.argmax(targets < FORCE + 0.01) - held
    assert held == pytest.approx(1.0, abs=0.3)
    assert removed == pytest.approx(2.0, abs=0.6)


@pytest.mark.parametrize("kind", ["pull_shear", "twist_shear"])
@pytest.mark.parametrize(("jump", "raised"), [(0.4, False), (0.8, True)])
def test_a_shear_jump_counts_only_beyond_the_noise(kind, jump, raised):
    watched = at_rest()
    for shear in np.linspace(0.0, 3.3, 2000):
        setattr(watched.held, kind, shear)
        watched.run(0.0, 1)
    watched.run(0.0, 500)
    setattr(watched.held, kind, 3.3 + jump)
    watched.run(0.0, 1)
    assert watched.grip.slip.reflex_triggered == raised


@pytest.mark.parametrize(("share", "is_load"), [(0.14, False), (0.3, True)])
def test_rubber_may_lose_a_fifth_of_the_force_without_a_load(share, is_load):
    watched = at_rest()
    lost = share * 10.0 * 0.079 + 0.05  # lost moment plus joint friction [N·m]
    for load in np.linspace(0.0, -lost / 0.03, 4000):
        watched.run(load, 1)
    watched.run(-lost / 0.03, 500)
    assert (watched.grip.slip.load > 0.0) == is_load


def test_friction_that_rolling_uses_up_counts_as_at_most_70_percent():
    watched = GripUnderLoad(4.0, object_load=2.0)
    watched.held.shear = 0.5  # more than the tip friction less its margin
    watched.grip.begin_holding()
    assert watched.run(0.0, 500) == pytest.approx(0.5 * 2.0 / (0.3 * 0.6), rel=0.05)


def test_the_tip_forces_are_equalised_within_80_ms_and_a_quarter_degree():
    def turned(imbalance: float, ticks: int) -> tuple[float, float]:
        """Return the remaining imbalance [N] and the rotation of the object [rad]."""
        watched = at_rest()
        start, state, off = watched.grip._state.offset, watched.grip._state, imbalance
        watched.held.load_arm = 0.0  # The loads of this test are not watched.
        for _ in range(ticks):
            watched.held.normal = [10.0 + 0.5 * off, 10.0 - 0.5 * off]
            watched.grip.torques(Reading(), ObjectPose(), True)
            # The left tip is compressed and the right tip is released, both by arm × offset.
            off = imbalance + 2.0 * 6e3 * 0.079 * (state.offset - start)
        return off, 1.5 * (state.offset - start)

    assert turned(0.4, 40)[0] / 0.4 == pytest.approx(1.0 / math.e, abs=0.1)
    assert math.radians(0.15) < abs(turned(20.0, 1000)[1]) < math.radians(0.4)
