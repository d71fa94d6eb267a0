"""Test each limit, and the conditions under which a violation is reported or latched."""

import math
from copy import copy
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import SafetySettings as Limits
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.limits import LIMITS, View
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Contact, State
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid
from tests.harness.safety import (
    BOUNDS,
    SETTINGS,
    Sensor,
    judged,
    later,
    safety,
    sound,
)

Changes = dict[str, Any]  # Maps paths to values; "reading.q.0" is the left joint's angle.
OLD = 5.0 - 11.0 / SETTINGS.tactile.rate  # s
STALLED = {"goal.q": [0.0, 0.3], "goal.current": [0.4] * 2, "reading.current": [0.0, 0.39]}
TOWARDS = {"goal.q": [0.3, 0.0], "goal.current": [0.4] * 2}
FAULTS: dict[str, tuple[Changes, str, str]] = {
    "stale": ({"reading.t": 4.9}, "servos.silent", "no valid reading for 0.100 s"),
    "never read": ({"reading.t": -math.inf}, "servos.silent", "no valid reading yet"),
    "alert": ({"reading.alert": 2, "reading.hardware.1": 4}, "servos.alert", "right (overheating)"),
    "past": ({"reading.q.0": 1.2}, "joint.angle", "the left joint is at 1.200 rad, expected"),
    "no angle": ({"reading.q.0": math.nan}, "joint.angle", "the left joint is at nan rad"),
    "fast": ({"reading.dq.1": -7.0}, "joint.velocity", "at -7.00 rad/s, above 6 rad/s"),
    "current": ({"reading.current.1": -1.9}, "joint.current", "the right joint draws -1.90 A"),
    "stalled": ({"mode": Mode.MOVING} | STALLED, "joint.stall", "17.2° from its goal at 0.39 A"),
    "dead": (TOWARDS, "joint.dead", "the left joint is stationary 17.2° from its goal and draws"),
    "pulled away": (
        TOWARDS | {"reading.current.0": -0.4},
        "joint.dead",
        "only -0.40 A (maximum 0.40 A)",
    ),
    "frozen": (
        {"reading.frozen": 0b01},
        "servos.frozen",
        "servos: outdated readings from the left servo",
    ),
    "deaf": ({"reading.lost": 0b11}, "goal.lost", "goals do not reach the left and right servo"),
    "hot": (
        {"reading.temperature.0": 70.0},
        "servos.temperature",
        "the left servo is at 70 °C, expected below 70 °C",
    ),
    "brown-out": ({"reading.voltage.1": 9.2}, "servos.voltage", "9.2 V, expected 9.5 to 16.0 V"),
    "no frames": (
        {"contacts.0.t_arrival": OLD, "contacts.0.t_valid": OLD},
        "tactile.silent",
        "no frame from the left sensor for 0.1",
    ),
    "no estimates": (
        {"contacts.0.t_valid": OLD},
        "tactile.silent",
        "no valid estimate from the left sensor for 0.1",
    ),
    "never an estimate": (
        {"contacts.0": Contact(t_arrival=5.0)},
        "tactile.silent",
        "no valid estimate from the left sensor yet",
    ),
    "never a frame": (
        {"contacts.1": Contact()},
        "tactile.silent",
        "no frame from the right sensor yet",
    ),
    "force": ({"contacts.1.force": 31.0}, "tip.force", "the right tip force is 31.0 N, above 30 N"),
    "depth": ({"contacts.1.d": 0.013}, "tip.displacement", "displacement is 13.00 mm, above 12"),
    "rim": (
        {"contacts.0.theta": -math.asin(0.8) + 0.04},
        "tip.tilt",
        "the left tip tilt is -50.8°, expected at most 5",
    ),
    "late": ({"timing.late_in_row": 100}, "loop.overruns", "loop: 100 consecutive ticks were late"),
    "outside": (
        {"contacts.0.inside": False},
        "tip.tilt",
        "the left tip tilt is 5.7°, expected at most",
    ),
}
THINNER: Changes = {"object.width": 0.0355}


def put(state: State, changes: Changes) -> None:
    for path, value in changes.items():
        *way, last = path.split(".")
        place: Any = state
        for part in way:
            place = place[int(part)] if part.isdigit() else getattr(place, part)
        if last.isdigit():
            place[int(last)] = copy(value)
        else:
            setattr(place, last, copy(value))


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_detected_and_named(fault):
    judge, state = safety(), sound()
    changes, name, text = FAULTS[fault]
    put(state, changes)
    found = judged(judge, state, 2.5)
    assert found[0] == name
    assert text in found[1]
    assert judge.cause(state), "commands must be refused during the fault"


@pytest.mark.parametrize("fault", ["hot", "brown-out", "stalled", "dead"])
def test_a_limit_that_is_checked_in_turn_is_no_fault_once_its_cause_has_ended(fault):
    judge, state = safety(), sound()
    put(state, FAULTS[fault][0])
    assert judged(judge, state, 2.5)[0] == FAULTS[fault][1]
    well = sound()
    later(well, state.t - well.t)
    assert judge.judge(well) is None


def test_limits_of_missing_servos_or_sensors_are_ignored():
    for missing, faults in (
        ("servos", ("stale", "alert", "past", "fast", "hot", "brown-out")),
        ("tactile", ("no frames", "force", "rim")),
    ):
        state = sound()
        for fault in faults:
            put(state, FAULTS[fault][0])
        settings = Settings.model_validate({missing: {"backend": "none"}})
        assert judged(safety(settings), state, 1.0) == ("", "")


def test_a_short_spike_of_a_condition_that_must_last_is_not_a_fault():
    judge, state = safety(), sound()
    put(state, FAULTS["current"][0])
    for _ in range(20):
        assert judge.judge(state) is None
        later(state, 0.002)
    state.reading.current = [0.0, 0.0]
    judge.judge(state)
    put(state, FAULTS["current"][0])
    assert judge.judge(state) is None, "the duration must restart"


@pytest.mark.parametrize(
    "changes",
    [THINNER, *(FAULTS[each][0] for each in ("current", "stalled", "dead", "brown-out"))],
)
def test_checking_for_a_cause_does_not_change_the_result(changes):
    """When a command checks for the cause of a fault, this check must not delay the fault."""
    asked, alone, state = safety(), safety(), sound()
    for k in range(1500):
        if k == 100:
            put(state, changes)
        for gripping in (False, True):
            asked.cause(state, gripping)
        assert asked.judge(state) == alone.judge(state)
        later(state, 0.002)
    assert asked.judge(state) is not None
    assert asked.warnings == alone.warnings


def test_late_frames_freeze_the_goals_before_they_are_a_fault():
    state = sound()
    state.contacts[0].t_valid = 5.0 - 4.0 / SETTINGS.tactile.rate
    judge = safety()
    assert judge.judge(state) is None
    assert judge.must_hold
    assert judge.limited["tactile.late"] == 1
    assert judge.cause(state) == ""
    state.mode = Mode.ARMED
    assert judge.judge(state) is None
    assert not judge.must_hold


def felt(finger: int, theta: float) -> Sensor:
    sensor = Sensor(finger)
    sensor.estimate = ContactEstimate(contact=True, invalid=Invalid.NONE, tilt_x=theta)
    sensor.estimate.covariance[1, 1] = 1e-3**2
    return sensor


def test_fingers_that_disagree_on_the_object_angle_warn_and_then_fault() -> None:
    # θ1 = φ + q1 and θ2 = φ − q2 both give φ = 0.1 rad.
    left, right = felt(0, 0.1 + 0.3), felt(1, 0.1 - 0.25)
    judge, state = safety(sensors=[left, right]), sound()
    state.reading.q = [0.3, 0.25]
    state.goal.q = [0.3, 0.25]
    assert judged(judge, state, 0.5) == ("", "")
    right.estimate.tilt_x += 0.11
    assert judged(judge, state, 0.5) == ("", "")
    assert [warning.name for warning in judge.warnings] == ["hand.angle"]
    right.estimate.tilt_x += 0.1
    name, text = judged(judge, state, 0.5)
    assert name == "hand.angle"
    assert "differ by 12.0°: check the joints' zeros" in text
    right.estimate.covariance[1, 1] = 0.06**2  # With this uncertainty, 12° is not a fault.
    assert judged(judge, state, 0.5) == ("", "")


def test_a_change_of_width_of_a_held_object_is_a_fault():
    judge, state = safety(), sound()
    judged(judge, state)
    put(state, THINNER)
    name, text = judged(judge, state, 0.5)
    assert name == "hand.width"
    assert "changed by -4.5 mm" in text
    state.mode = Mode.ARMED  # The hand has released the object.
    assert judged(judge, state) == ("", "")
    state.mode = Mode.HOLDING
    assert judged(judge, state, 0.5) == ("", "")


def test_a_force_estimate_that_is_too_high_for_one_frame_is_no_fault():
    judge, state = safety(), sound()
    put(state, {"contacts.1.force": 31.0})
    for _ in range(20):  # 0.04 s
        assert judge.judge(state) is None
        later(state, 0.002)
    assert judged(judge, state)[0] == "tip.force"


STRONG = {"contacts.0.force": 27.5, "contacts.1.force": 27.5}
WARNINGS: dict[str, tuple[Changes, str]] = {
    "hand.force": ({"contacts.0.force": 12.0}, "left 12.0 N, right 5.0 N"),
    "joint.strained": ({"reading.current": [1.19, 0.3]}, "requires the maximum current of 1.2 A"),
    "tactile.misfit": ({"contacts.0.misfit": True}, "left sensor's frames do not match"),
    "servos.heat": ({"heat.1.time_to_limit": 42.0}, "the right servo will reach 70 °C in 42 s"),
    "tip.force": (STRONG, "the left tip force is 27.5 N, above 27 N"),
}


@pytest.mark.parametrize("name", WARNINGS)
def test_a_warning_is_reported_once_until_it_has_ended(name):
    judge, state = safety(), sound()
    changes, text = WARNINGS[name]
    put(state, changes)
    assert judged(judge, state, 2.0) == ("", "")
    (told,) = (each.text for each in judge.warnings if each.name == name)
    assert text in told
    judge.warnings.clear()
    for wait, times in ((0.3, 0), (1.5, 1)):
        well = sound()
        well.t = well.reading.t = state.t
        for contact in well.contacts:
            contact.t_valid = state.t
        judged(judge, well, wait)
        state = well
        put(state, changes)
        judged(judge, state, 2.0)
        assert [each.name for each in judge.warnings].count(name) == times


@pytest.mark.parametrize(("good", "told"), [(1000, True), (20, True), (3, False)])
def test_readings_that_fail_for_a_second_are_reported_even_while_disarmed(good, told):
    """One out of every ``good`` readings is valid."""
    watch, state = safety(), sound(Mode.DISARMED)
    state.torque = False
    first = math.inf
    for k in range(1, 1000):
        state.t = 5.0 + 0.002 * k
        state.reading.valid = k % good == 0
        watch.judge(state)
        if watch.warnings:
            first = min(first, state.t - 5.0)
    warnings = [each.text for each in watch.warnings if each.name == "servos.silent"]
    assert len(warnings) == told
    if told:
        assert "of the readings in the last second failed: no valid reply within" in warnings[0]
        assert "servos.reply_timeout = 4 ms; run `softfinger doctor`" in warnings[0]
        assert 0.9 < first < 1.5


def test_a_warning_at_its_limit_does_not_repeat():
    judge, state = safety(), sound()
    for k in range(4000):
        state.heat[0].time_to_limit = 60.0 + (0.5 if k // 700 % 2 else -0.5)
        judge.judge(state)
        later(state, 0.002)
    assert len(judge.warnings) == 1


def test_each_faulty_channel_is_named():
    grasp = GraspState()
    grasp.gain_prior_std[:] = 0.25
    judge, state = safety(grasp=grasp), sound(Mode.RELEASING)
    grasp.gain_change[1], grasp.gain_std[1] = math.log(0.5), 0.1
    judged(judge, state, 0.5)
    assert judge.warnings == [], "must not warn during a release"
    state = sound()
    grasp.gain_std[1] = 0.4
    judged(judge, state, 0.5)
    assert judge.warnings == [], "must not warn about an uncertain gain"
    grasp.gain_std[1] = 0.1
    grasp.rejects_frames[0], grasp.angle_jump[0] = 1.0, -0.2
    grasp.has_wrong_current[1] = 1.0
    state.reading.current[1], state.goal.current[1] = 0.1, 0.2
    judged(judge, state, 0.5)
    told = {warning.name: warning.text for warning in judge.warnings}
    assert set(told) == {
        "consistency.left_sensor",
        "consistency.right_sensor",
        "consistency.right_current",
    }
    assert told["consistency.left_sensor"].startswith(
        "the left sensor reports a jump of 11° in the object's angle"
    )
    assert told["consistency.right_sensor"].startswith("the right sensor reads 50% of the pressure")
    assert "current is 0.10 A, but its goal current is 0.20 A" in told["consistency.right_current"]


@pytest.mark.parametrize("scene", [{}, {"fingers": ("left",)}, {"object_model": False}])
def test_a_force_that_does_not_increase_as_commanded_is_a_fault(scene):
    judge, state = safety(Settings.model_validate({"scene": scene})), sound()
    state.mode = "grasping"
    state.object.valid = not scene
    state.contacts[1].contact = "fingers" not in scene
    for force, felt, fault in ((5.0, 5.0, False), (10.0, 6.5, False), (20.0, 6.5, True)):
        state.goal.force = force
        state.contacts[0].force = state.contacts[1].force = felt
        judged(judge, state, 0.01)
        if felt == 6.5 and not fault:
            state.contacts[0].force = state.contacts[1].force = 10.0
        found = judged(judge, state, 0.5)
        assert (found[0] == "consistency.force") is fault
        state.contacts[0].force = state.contacts[1].force = felt
    assert "rose to 20.0 N, but the measured force stayed at 6.5 N" in found[1]


def test_shear_near_friction_is_reported():
    held = GraspState()
    judge, state = safety(grasp=held), sound()
    held.shear = 0.5
    judged(judge, state, 0.3)
    assert [each.name for each in judge.warnings if each.name == "grip.slip"] == ["grip.slip"]


def test_a_frozen_sensor_is_a_fault_during_contact():
    sensor = Sensor(1)
    judge, state = safety(sensors=[sensor]), sound()
    rng = np.random.default_rng(3)
    for frozen, fault in ((False, False), (True, True)):
        kept = rng.integers(0, 50, (4, 4))
        found = None
        for k in range(400):
            if k % 5 == 0:
                sensor.give(state.t, kept if frozen else rng.integers(0, 50, (4, 4)))
            found = judge.judge(state)
            later(state, 0.002)
        assert (found is not None) is fault
    assert found.name == "tactile.frozen"
    assert "the right sensor has sent the same frame" in found.text
    state.contacts[1].contact = False  # Without contact, repeated frames are normal.
    assert judged(judge, state) == ("", "")


def test_saturated_cells_are_reported():
    sensor = Sensor(0)
    judge, state = safety(sensors=[sensor]), sound()
    sensor.give(5.0, np.full((4, 4), 65535))
    judged(judge, state, 0.3)
    assert [each.text for each in judge.warnings] == [
        "tactile: 100% of the cells of the left sensor are saturated"
    ]


# For each limit, the path of the checked value and the value of the limit. Ages are relative to the
# current time.
PUSHES: dict[str, tuple[str, float]] = {
    "joint.angle": ("reading.q.{}", SETTINGS.hand.q_max[0] + 0.1),
    "joint.velocity": ("reading.dq.{}", BOUNDS.velocity_max),
    "joint.current": ("reading.current.{}", BOUNDS.current_fault),
    "servos.silent": ("reading.t", SETTINGS.servos.fault_after),
    "servos.temperature": ("reading.temperature.{}", BOUNDS.temperature_max),
    "tip.force": ("contacts.{}.force", BOUNDS.force_max),
    "tip.displacement": ("contacts.{}.d", BOUNDS.d_max),
    "tip.tilt": ("contacts.{}.theta", math.asin(0.8) - BOUNDS.theta_margin),
    "tactile.silent": ("contacts.{}.t_valid", BOUNDS.frame_age_fault / SETTINGS.tactile.rate),
}


@pytest.mark.parametrize("name", PUSHES)
@pytest.mark.parametrize("finger", [0, 1])
@pytest.mark.parametrize("share", [0.99, 1.01, math.nan])
def test_a_fault_starts_at_its_limit_and_nan_exceeds_it(name, finger, share):
    state = sound()
    path, bound = PUSHES[name]
    value = share * bound
    put(state, {path.format(finger): state.t - value if "silent" in name else value})
    (row,) = (row for row in LIMITS if row.name == name and row.level == "fault")
    assert bool(row.check(View(SETTINGS, GraspState(), ()), state, row.fraction)) != (share < 1.0)


def test_every_row_is_unique_per_level_and_its_settings_exist():
    seen = [(row.name, row.level) for row in LIMITS]
    assert len(seen) == len(set(seen))
    for row in LIMITS:
        for key in row.keys:
            section, _, name = key.partition(".")
            assert hasattr(getattr(SETTINGS, section), name), key
    told = {key for row in LIMITS for key in row.keys}
    missing = {f"safety.{name}" for name in Limits.model_fields} - told
    assert missing == {"safety.current_move"}, "the table must contain all configurable limits"


def test_a_sensor_without_valid_estimates_is_reported_with_reason_and_noise():
    sensor = Sensor(0)
    sensor.sensor = GivenFrames()
    sensor.estimate = ContactEstimate(invalid=Invalid.MODEL_MISMATCH)
    judge, state = safety(sensors=[sensor]), sound()
    state.contacts[0].t_valid = OLD
    sensor.noise = 1.2 * SETTINGS.tactile.noise
    _, text = judged(judge, state)
    assert text.endswith("s: the frame does not match the tip's contact model")
    sensor.noise = 2.6 * SETTINGS.tactile.noise
    judge = safety(sensors=[sensor])
    _, text = judged(judge, state)
    assert text.endswith("the measured cell noise is 3952 Pa, expected tactile.noise = 1520 Pa")
