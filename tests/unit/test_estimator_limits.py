"""Test the thresholds of the hand estimator with prescribed frames and joint readings."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from softfinger.daemon.perception.hand_estimator import HandEstimator
from softfinger.daemon.perception.hand_state import (
    ANGLE,
    ANGLE_BIAS,
    D_BIAS,
    FRICTION,
    GAIN,
    LATENCY,
    MODULUS,
    STATES,
)
from softfinger.daemon.perception.hand_state import (
    D as DISPLACEMENT,
)
from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Contact, Frame, Goal, ObjectPose, Reading
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid

SETTINGS = Settings()
TORQUE_CONSTANT = SETTINGS.control.torque_constant  # [N·m/A]
CLOSED = 0.15  # joint angle [rad]
D = 3e-3  # [m]
DT = 0.002  # s


STATE = {
    "D": DISPLACEMENT,
    "D_BIAS": D_BIAS,
    "ANGLE": ANGLE,
    "ANGLE_BIAS": ANGLE_BIAS,
    "MODULUS": MODULUS,
    "GAIN": GAIN,
    "FRICTION": FRICTION,
    "LATENCY": LATENCY,
}
APART = {"D0": 0.5, "D1": -0.5}  # sideways position of the object


class Held:
    """Estimator of a hand that holds an upright object; each argument is (left, right)."""

    def __init__(self, d_std: float = 5e-5, gain_variance: float = 1e-4) -> None:
        table = make_table(SETTINGS)
        self.estimator = HandEstimator(SETTINGS, (table, table))
        self.grasp, self.state = self.estimator.grasp, self.estimator._state
        self.contacts, self.pose = [Contact(), Contact()], ObjectPose()
        self.covariance = np.diag([d_std**2, 5e-3**2, 1e-4, gain_variance])
        self.t, self.tick = 5.0, 0
        self.q = [CLOSED, CLOSED]

    def run(
        self,
        seconds: float,
        d: Sequence[float] = (D, D),
        turned: Sequence[float] = (0.0, 0.0),
        dq: float | Sequence[float] = 0.0,
        current: Sequence[float] = (0.0, 0.0),
        goal: float = 0.0,
        touches: bool = True,
        gripping: bool | None = None,
        fingers: Sequence[int] = (0, 1),
    ) -> None:
        """Send readings every 2 ms and frames of ``fingers`` every 10 ms.

        ``d`` [m] and the object angles ``turned`` [rad] are those that each frame shows.
        ``gripping`` is True from the start of an approach; by default, while the tips touch.
        """
        gripping = touches if gripping is None else gripping
        speeds = [dq, dq] if isinstance(dq, float) else list(dq)
        for _ in range(round(seconds / DT)):
            self.t, self.tick = self.t + DT, self.tick + 1
            self.q = [q + speed * DT for q, speed in zip(self.q, speeds, strict=True)]
            reading = Reading(
                t=self.t, q=list(self.q), dq=speeds, current=list(current), valid=True
            )
            goals = Goal(q=[q + 0.35 for q in self.q], current=[goal, goal])
            self.estimator.predict(reading, goals if gripping else None)
            if self.tick % 5 == 0:
                self.frames(d, turned, touches, fingers)
            self.estimator.write_contacts(self.t, self.contacts, self.pose)

    def frames(
        self,
        d: Sequence[float],
        turned: Sequence[float],
        touches: bool,
        fingers: Sequence[int],
    ) -> None:
        for finger in fingers:
            sense = 1.0 - 2.0 * finger
            estimate = ContactEstimate(
                contact=touches,
                invalid=Invalid.NONE,
                d=d[finger] if touches else 0.0,
                tilt_x=turned[finger] + sense * self.q[finger],
                covariance=self.covariance,
            )
            frame = Frame(self.tick, self.t, self.t, True, np.zeros((1, 1), np.uint16))
            self.estimator.update(finger, frame, estimate, self.contacts[finger])

    def std(self, **weights: float) -> float:
        """Return the standard deviation of a weighted sum of states, such as ``D0=0.5, D1=0.5``."""
        slopes = np.zeros(STATES)
        for name, weight in weights.items():
            slopes[STATE[name[:-1]] + int(name[-1])] = weight
        return math.sqrt(slopes @ self.state.covariance @ slopes)

    @property
    def is_rejected(self) -> bool:
        """True if the newest frame of the left tip was rejected."""
        return self.contacts[0].invalid == Invalid.CONTRADICTS_JOINTS


@pytest.mark.parametrize(("jump", "rejected"), [(0.9e-3, False), (1.8e-3, True)])
def test_a_jump_in_d_by_more_than_six_percent_of_the_radius_is_an_outlier(jump, rejected):
    held = Held()
    held.run(1.0)
    held.run(0.01, d=(D + jump, D))
    assert held.is_rejected == rejected


@pytest.mark.parametrize(("jump", "rejected"), [(0.09, False), (0.18, True)])
def test_a_jump_in_the_angle_is_an_outlier(jump, rejected):
    held = Held()
    held.run(1.0)
    held.run(0.01, turned=(jump, 0.0))
    assert held.is_rejected == rejected


def test_late_frames_of_a_turning_object_do_not_pull_the_angle_back():
    """If the cells are slow, frames show an angle of the past until the joints have stopped."""
    held, speed, lag = Held(), 0.3, 0.06
    held.run(1.0)
    turning, angle = 0.0, 0.0
    for tick in range(30):
        rate = speed * sum(held.grasp.rolling_ratio)
        held.run(0.01, turned=[turning] * 2, dq=(speed, -speed))
        angle += 0.01 * rate
        # The tilt of a tip is the sum of the object's angle and the joint angle.
        turning = max(angle - lag * rate, 0.0) - speed * min(lag, 0.01 * (tick + 1))
    assert angle - held.pose.angle < 0.7 * lag * rate
    held.run(0.5, turned=[angle] * 2)
    assert held.pose.angle == pytest.approx(angle, abs=5e-3)


@pytest.mark.parametrize(("jump", "rejected"), [(1.6e-3, False), (2.8e-3, True)])
def test_a_jump_of_a_noisy_sensor_is_an_outlier_only_beyond_five_standard_deviations(
    jump, rejected
):
    held = Held(d_std=4e-4)
    held.run(3.0)
    held.run(0.01, d=(D + jump, D))
    assert held.is_rejected == rejected


@pytest.mark.parametrize(
    ("state", "bias", "is_fault"),
    [
        (D_BIAS, 0.07 * D, False),
        (D_BIAS, 0.15 * D, True),
        (ANGLE_BIAS, 0.045, False),
        (ANGLE_BIAS, 0.09, True),
    ],
)
def test_a_known_bias_is_a_fault_beyond_its_limit(state, bias, is_fault):
    held = Held()
    held.run(0.5)
    for uncertain in (D_BIAS, ANGLE_BIAS):  # A bias within five standard deviations is no fault.
        held.state.covariance[uncertain, uncertain] = 0.02**2
        held.state.mean[uncertain] = 0.07
    held.state.covariance[state, state] = 1e-12
    held.state.mean[state] = bias
    held.estimator.write_contacts(held.t, held.contacts, held.pose)
    found = {D_BIAS: held.grasp.has_d_bias, ANGLE_BIAS: held.grasp.has_angle_bias}
    assert {each: found[each].tolist() for each in found} == {
        each: [float(is_fault and each == state), 0.0] for each in found
    }


@pytest.mark.parametrize(
    ("goal", "off", "is_wrong"),
    [(1.0, 0.2, False), (1.0, 0.4, True), (0.04, 0.022, False), (0.04, 0.042, True)],
)
def test_a_current_may_differ_from_its_goal_by_a_quarter_and_20_ma(goal, off, is_wrong):
    held = Held()
    held.run(0.5, current=(goal, goal + off), goal=goal)
    assert held.grasp.has_wrong_current.tolist() == [0.0, float(is_wrong)]


@pytest.mark.parametrize(("distance", "torque"), [(0.2, 0.5), (0.3, 0.8)])
def test_a_joint_far_from_its_goal_draws_the_goal_current(distance, torque):
    """Near its goal, a servo may draw less than the limit, so the measured current counts."""
    held = Held()
    held.run(0.5)
    reading = Reading(t=held.t + DT, q=held.q, current=[0.5 / TORQUE_CONSTANT] * 2, valid=True)
    goal = Goal(q=[CLOSED + distance] * 2, current=[0.8 / TORQUE_CONSTANT] * 2)
    held.estimator.predict(reading, goal)
    assert held.state.tip[0].torque == pytest.approx(torque / SETTINGS.control.driving)


@pytest.mark.parametrize(("pause", "measures"), [(0.2, True), (0.45, False)])
def test_torques_are_measured_only_in_the_first_closing_motion(pause, measures):
    held, current = Held(), (1.0, 1.0)
    held.run(0.1, dq=0.1, current=current)
    held.run(pause, current=current)
    before = held.pose.nis_torque
    held.run(0.1, dq=0.1, current=current)
    assert (held.pose.nis_torque != before) == measures


def test_torque_before_the_approach_does_not_count_as_friction():
    """A blocked joint needs much torque, which must not remain after the obstacle is removed."""
    held = Held()
    for gripping, torque in ((False, 0.3), (True, 0.06)):
        amps = torque / TORQUE_CONSTANT * SETTINGS.control.driving
        held.run(0.5, current=(amps, amps), touches=False, gripping=gripping)
        assert held.grasp.free_torque == pytest.approx([torque, torque], rel=0.01)


def test_a_closing_finger_does_not_move_an_object_that_only_the_other_finger_touches():
    held = Held()
    held.run(0.2, fingers=(0,))
    held.run(0.3, fingers=(0,), dq=(0.0, 0.3))
    assert held.contacts[0].d == pytest.approx(D, abs=2e-5)
    assert held.pose.angle == 0.0


def test_short_torque_peaks_do_not_count_as_friction():
    held = Held()
    for current, seconds in ((0.0, 0.3), (0.3, 0.01), (0.0, 0.5)):
        amps = current / TORQUE_CONSTANT * SETTINGS.control.driving
        held.run(seconds, current=(amps, amps), touches=False)
    assert held.grasp.free_torque[0] == pytest.approx(0.12, abs=0.04)


def test_the_slope_of_the_force_follows_d_within_ten_frames():
    held = Held(gain_variance=0.0)
    held.run(0.5)
    first = held.state.tip[0].log_slope
    held.run(0.01, dq=1.5)
    moved = held.contacts[0].d
    assert moved > 1.3 * D
    held.run(0.09, d=(moved, moved))
    # For springs, F ∝ d² for a constant modulus, so ∂ ln F/∂d is nearly proportional to 1/d.
    expected = first * D / moved
    reached = (first - held.state.tip[0].log_slope) / (first - expected)
    assert reached == pytest.approx(1.0 - math.exp(-1.0), abs=0.15)


@pytest.mark.parametrize(
    ("weights", "seconds", "growth", "gain_variance", "gripping"),
    [
        (APART, 1.0, 0.3e-3, 1e-4, True),
        (APART, 25.0, 0.15e-3, 0.0, True),  # Without a known gain, d is known less precisely.
        ({"D_BIAS0": 1.0}, 25.0, 0.5e-3, 1e-4, True),
        ({"ANGLE0": 1.0}, 100.0, 2e-3, 1e-4, True),
        ({"ANGLE_BIAS0": 1.0}, 25.0, 5e-3, 1e-4, True),
        ({"GAIN0": 1.0}, 1.0, 0.05, 1e-4, True),
        ({"FRICTION0": 1.0}, 1.0, 0.05, 1e-4, True),
        (APART, 0.04, 1e-3, 1e-4, False),
        ({"ANGLE0": 1.0}, 1.0, 0.02, 1e-4, False),
    ],
)
def test_the_uncertainty_of_a_state_grows_while_no_frames_arrive(
    weights, seconds, growth, gain_variance, gripping
):
    held = Held(gain_variance=gain_variance)
    held.run(1.0)
    before = held.std(**weights)
    held.run(seconds, fingers=(), touches=gripping)
    grown = math.sqrt(held.std(**weights) ** 2 - before**2)
    assert grown == pytest.approx(growth, rel=0.3)


def test_a_predicted_motion_of_5_mm_within_half_a_second_is_uncertain_by_a_tenth_of_a_mm():
    held = Held()
    held.run(1.0)
    together = {"D0": 0.5, "D1": 0.5}
    before, start = held.std(**together), held.contacts[0].d
    held.run(0.5, dq=0.128, fingers=())
    assert held.contacts[0].d - start == pytest.approx(5e-3, rel=0.02)
    grown = math.sqrt(held.std(**together) ** 2 - before**2)
    assert grown == pytest.approx(0.11e-3, rel=0.2)


def test_a_frame_beyond_three_standard_deviations_is_given_less_weight():
    shifts = []
    for deviations in (2.5, 4.0):
        held = Held(d_std=2e-4)
        held.run(3.0)
        before = held.contacts[0].d + held.state.mean[D_BIAS]
        std = math.hypot(held.std(D0=1.0, D_BIAS0=1.0), 2e-4)
        held.run(0.01, d=(D + deviations * std, D))
        shifts.append(held.contacts[0].d + held.state.mean[D_BIAS] - before)
    # With equal weights, the ratio would be 4.0/2.5. The second frame's weight is 9/16.
    assert shifts[1] / shifts[0] == pytest.approx(4.0 / 2.5 * 9.0 / 16.0, rel=0.1)


def test_the_amplitude_of_the_frames_is_known_to_one_percent_in_a_hold():
    held = Held(gain_variance=1e-8)
    held.run(2.0)
    assert held.std(MODULUS0=1.0, GAIN0=1.0) == pytest.approx(0.01, rel=0.2)


def test_friction_of_the_support_limits_what_the_balance_of_the_tips_shows():
    held = Held()
    held.run(1.0, d=(0.5 * D, 0.5 * D))
    assert held.grasp.normal == pytest.approx([0.96, 0.96], rel=0.05)
    # Friction of 0.4 N may explain 40 % of this force.
    assert held.std(MODULUS0=1.0, MODULUS1=-1.0) == pytest.approx(0.134, rel=0.2)


def test_one_contact_leaves_half_of_the_taper_in_the_angle_of_the_object():
    held = Held()
    held.run(0.02, fingers=(0,))
    assert held.grasp.angle_std == pytest.approx(0.5 * 0.1, rel=0.2)


def test_the_age_of_the_frames_is_uncertain_by_30_ms_until_the_joints_close():
    held = Held()
    held.run(0.1)
    assert held.std(LATENCY0=1.0) == pytest.approx(0.03, rel=0.2)
    held.run(0.1, dq=0.1, d=(D + 0.8e-3, D + 0.8e-3))
    assert held.std(LATENCY0=1.0) < 0.02
