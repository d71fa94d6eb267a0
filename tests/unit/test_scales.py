"""Which scale is it: grips of wrong scales on the plant, and measurements that are wild."""

import itertools
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.perception import scales
from softfinger.daemon.perception.scales import UNKNOWN, Prior, Scales, set_prior
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Pair, Records
from softfinger.tools.benchmarks.rigs import SENSORS, SOLID, Sections, merged
from softfinger.tools.watched import Watched as Hand
from tests.unit.test_control import grasped

PRIORS = UNKNOWN, Prior(modulus=(1.3, 0.05))
HELD = 0.3  # of the tips' moment, by gears

# As identified (model M4 of Rhoban's BAM, arXiv 2410.08650): base, Stribeck's, load's, its speed.
SERVOS: dict[str, tuple[float, float, tuple[float, float], float, float]] = {
    "XL330": (0.002, 0.0004, (0.25, 0.05), 0.12, 0.018),
    "MX-64": (0.062, 0.024, (0.0, 0.23), 1.5, 0.015),
    "MX-106": (0.0, 0.105, (0.009, 0.222), 1.62, 0.051),
}
FRICTION = ("friction", "stribeck", "load_friction", "stribeck_speed", "damping")


@kernel
def begin(records: Records[Scales], slow: bool) -> None:
    scales.begin_grip(records[0], slow)


@kernel
def keep(records: Records[Scales]) -> None:
    scales.keep(records[0])


@kernel
def height(
    records: Records[Scales], finger: int, value: float, variance: float, known: float
) -> None:
    scales.update_height(records[0], finger, value, variance, known)


@kernel
def torques(records: Records[Scales], torque: Pair, moment: Pair, speed: float, t: float) -> None:
    scales.update_torque(records[0], torque, moment, speed, t)


@kernel
def balance(records: Records[Scales], force1: float, force2: float) -> None:
    scales.update_balance(records[0], force1, force2)


def test_no_measurement_however_wild_leaves_it_surer_than_numbers_can_be() -> None:
    rng = np.random.default_rng(8)
    ends = [0.0, 1e-310, np.inf, -np.inf, np.nan]

    def one(usual: float) -> float:
        if rng.random() < 0.9:
            return usual
        wild = rng.choice([-1, 1]) * 10.0 ** rng.uniform(-12, rng.choice([1, 20, 200]))
        return float(rng.choice([wild, wild, rng.choice(ends)]))

    for _ in range(100):
        found = Scales()
        set_prior(found, PRIORS, friction=0.05, inertia=0.01, held=HELD)
        found.product[:] = rng.integers(0, 2, 2)
        begin(found.array, False)
        for k in range(60):
            height(found.array, int(rng.integers(0, 2)), one(1.0), max(one(1e-2), 1e-12), one(0.0))
            moments = (one(0.2), one(0.2)), (one(0.2), one(0.2))
            torques(found.array, *moments, one(0.1), 0.002 * k)
            balance(found.array, one(6.0), one(6.0))
            assert np.isfinite(found.mean).all()
            assert (np.diag(found.covariance) > 0.0).all()
            assert (found.slopes == 0.0).all()


CASES: dict[str, tuple[dict[str, Any], float, float]] = {
    "honest": ({}, 1.0, 0.06),
    "both read 1.4": ({"tactile_gain": (1.4, 1.4)}, 1.4, 0.15),
    "both read 0.6": ({"tactile_gain": (0.6, 0.6)}, 0.6, 0.15),
    "left reads 0.5": ({"tactile_gain": (0.5, 1.0)}, 0.5, 0.15),
    "soft": ({"modulus_scale": 0.6}, 1.0, 0.2),
    "stiff": ({"modulus_scale": 1.6}, 1.0, 0.2),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("force", [6.0, pytest.param(12.0, marks=pytest.mark.extended)])
def test_a_wrong_scale_is_told_from_the_tips_stiffness(case: str, force: float) -> None:
    simulation, gain, within = CASES[case]
    with Hand({"simulation": simulation}) as hand:
        grasped(hand, force)
        assert hand.plant.normal.mean() == pytest.approx(force, rel=within)
        found = hand.contact_filter.grasp.scales
        stiff = np.exp(found.mean[scales.MODULUS])
        assert np.exp(found.mean[scales.GAIN]) == pytest.approx(gain, rel=0.2)
        assert stiff == pytest.approx(simulation.get("modulus_scale", 1.0), rel=0.2)
        # What is told of the force's error is about what it is.
        contact = hand.contacts[0]
        off = contact.force - hand.plant.force[0]
        assert abs(off) < 2.5 * contact.force_std < 0.4 * force
        assert not [event for event in hand.events if event[1] == "slip"]


def with_friction(servo: str, tips: Sections) -> Hand:
    own = {f"joint_{name}": value for name, value in zip(FRICTION, SERVOS[servo], strict=True)}
    known = {"joint_load_friction": 0.23, "joint_friction": 0.06}
    return Hand(merged({"simulation": own, "control": known}, tips))


FRICTION_CASES = list(itertools.product(SERVOS, ("springs", "solid"), (6.0, 12.0)))
FIRST_TIER = [("XL330", "springs", 6.0), ("MX-64", "solid", 12.0), ("MX-106", "springs", 12.0)]


@pytest.mark.parametrize(
    ("servo", "physics", "force"),
    [
        pytest.param(*case, marks=[pytest.mark.extended] * (case not in FIRST_TIER))
        for case in FRICTION_CASES
    ],
)
def test_friction_that_grows_with_the_load_is_neither_force_nor_load(servo, physics, force):
    with with_friction(servo, SOLID if physics == "solid" else {}) as hand:
        grasped(hand, force)
        hand.watch(2.0)
        assert hand.plant.normal.mean() == pytest.approx(force, rel=0.2)
        assert not [event for event in hand.events if event[1].startswith(("slip", "witness"))]


@pytest.mark.parametrize("servo", SERVOS)
def test_gears_that_hold_are_driven_back_for_a_weaker_grip_and_a_turn(servo: str) -> None:
    with with_friction(servo, {}) as hand:
        grasped(hand, 12.0)
        hand.command("grasp", force=6.0)
        hand.watch(1.0)
        assert hand.plant.normal.mean() == pytest.approx(6.0, rel=0.2)
        hand.command("rotate", angle=0.15)
        hand.watch(2.0)
        assert hand.state.mode == "holding"
        assert hand.plant.object_pose[2] == pytest.approx(0.15, abs=0.01)
        assert not [event for event in hand.events if event[1].startswith(("slip", "witness"))]


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
def test_torques_and_closing_tell_a_solid_tips_gain(gain: float) -> None:
    simulation = {"tactile_gain": (gain, gain), "seed": 2}
    with Hand(merged({"simulation": simulation}, SOLID)) as hand:
        grasped(hand, 6.0, 3.0)
        assert hand.plant.normal.mean() == pytest.approx(6.0, rel=0.2)
        assert not [event for event in hand.events if event[1] == "slip"]


def test_no_torque_constant_is_learnt_that_no_servo_has() -> None:
    record = Scales()
    set_prior(record, PRIORS, 0.05, 0.01, 0.0)
    moment = np.full(2, 0.3)
    for k in range(1000):
        if k % 100 == 0:
            begin(record.array, False)
        torques(record.array, -moment, moment, 0.0, 0.01 * k)
    np.testing.assert_allclose(record.mean[scales.TORQUE : scales.OFFSET], -0.3)
    keep(record.array)
    scales.end_touch(record)  # nor is it kept, or what came with it
    np.testing.assert_array_equal(record.mean, record.expected)


@pytest.mark.parametrize(
    ("sections", "seconds"),
    [(SOLID, 1.2), pytest.param(SENSORS["velostat"], 3.0, marks=pytest.mark.extended)],
    ids=["solid", "velostat"],
)
def test_honest_grips_go_on_as_they_began(sections: Sections, seconds: float) -> None:
    with Hand(sections) as hand:
        hand.grasp(8.0)
        for _ in range(12):
            hand.run(seconds)
            assert hand.plant.normal.mean() == pytest.approx(8.0, rel=0.08)
            hand.command("release")
            hand.run(0.5)
            hand.command("grasp", force=8.0)
        assert not [event for event in hand.events if event[1].startswith("witness")]


@pytest.mark.parametrize(
    ("kind", "value", "fingers", "forces"),
    [
        ("gain", 0.3, (0, 1), (5.0,)),  # does not come to hold
        ("replay", 0.3, (1,), (15.0, 20.0)),  # teaches little, and ends in a fault
    ],
)
def test_what_a_grip_taught_that_did_not_hold_is_not_kept(kind, value, fingers, forces):
    with Hand({}) as hand:
        hand.grasp(forces[0])
        while hand.plant.normal.min() < 0.05:
            hand.run(0.002)
        if len(forces) > 1:
            hand.run(1.5)
            hand.command("grasp", force=forces[1])
            hand.run(0.1)
        for finger in fingers:
            hand.plant.measurement_faults[finger].begin(kind, value, hand.now)
        learnt, taught = hand.contact_filter.grasp.scales.mean[: scales.OFFSET], 0.0
        for _ in range(30):
            hand.run(0.01)
            taught = max(taught, np.abs(learnt).max())
        assert (taught > 0.2) == (kind == "gain")
        for each in hand.plant.measurement_faults:
            each.clear()
        hand.run(0.9)
        hand.command("stop")
        hand.command("clear" if hand.mode == "fault" else "status")
        hand.run(0.5)
        hand.plant.place_object()
        grasped(hand, forces[0])
        assert hand.mode == "holding"
        assert hand.plant.normal.mean() == pytest.approx(forces[0], rel=0.2)
        np.testing.assert_allclose(learnt, 0.0, atol=0.15)


def test_a_sensor_that_freezes_in_the_ramp_teaches_nothing() -> None:
    """Its frames repeat the last while the joints close: the joints carry the contact on."""
    with Hand({}) as hand:
        hand.grasp(8.0)
        while hand.plant.normal.min() < 2.0:
            hand.run(0.002)
        hand.plant.measurement_faults[0].begin("replay", 0.01, hand.now)
        frozen = hand.watch(0.3)
        hand.plant.measurement_faults[0].clear()
        assert frozen.force.max() < 1.2 * 8.0
        learnt = hand.contact_filter.grasp.scales.mean[: scales.OFFSET]
        np.testing.assert_allclose(learnt, 0.0, atol=0.08)
        hand.run(1.5)
        assert hand.mode == "holding"
        assert hand.plant.normal.mean() == pytest.approx(8.0, rel=0.1)


def test_grips_that_come_to_no_hold_and_a_tare_lead_back_to_what_is_set() -> None:
    """What was once kept wrongly can't make each later grip fail for ever."""
    with Hand({}) as hand:
        found = hand.contact_filter.grasp.scales
        found.kept_mean[:6] += (0.5, -0.3, 0.4, 0.2, -0.3, 0.3)
        for _ in range(8):
            begin(found.array, False)
            scales.end_touch(found)
        np.testing.assert_allclose(found.mean, 0.0, atol=0.003)
        np.testing.assert_allclose(np.diag(found.covariance), found.prior, rtol=0.01)
        found.mean[:6] += 0.3
        hand.command("tare")
        np.testing.assert_array_equal(found.mean, 0.0)
        np.testing.assert_array_equal(found.covariance, np.diag(found.prior))


def test_tips_that_close_on_nothing_teach_nothing() -> None:
    with Hand({}) as hand:
        hand.plant.object_pose[:] = 0.0, 0.25, 0.0  # out of reach
        hand.grasp(3.0)
        for force in (5.0, 7.0, 9.0, 8.0):
            seen = hand.watch(3.5)
            assert seen.force.max() > 0.3
            assert hand.mode == "armed"
            np.testing.assert_array_equal(hand.contact_filter.grasp.scales.mean, 0.0)
            hand.command("grasp", force=force)
        hand.plant.place_object()
        hand.run(2.0)
        assert hand.mode == "holding"
        assert hand.plant.normal.mean() == pytest.approx(8.0, rel=0.1)


def test_what_is_known_of_scales_does_not_fade_while_nothing_is_held() -> None:
    with Hand({}) as hand:
        hand.run(3.0)
        found = hand.contact_filter.grasp.scales
        np.testing.assert_array_equal(found.covariance, np.diag(found.prior))
        np.testing.assert_array_equal(found.mean, 0.0)


def test_a_gain_that_changes_in_the_grip_is_the_sensors() -> None:
    with Hand({}) as hand:
        grasped(hand, 6.0)
        before = hand.plant.normal.mean()
        for finger in hand.plant.measurement_faults:
            finger.begin("gain", 0.5, hand.plant.t, 1.0)
        hand.watch(3.0)
        assert hand.plant.normal.mean() == pytest.approx(before, rel=0.03)
        found = hand.contact_filter.grasp.scales
        assert np.exp(found.mean[scales.GAIN]) == pytest.approx(0.5, rel=0.25)
        named = {event[1] for event in hand.events if event[1].startswith("witness")}
        assert named == {"witness.left_sensor", "witness.right_sensor"}


def test_a_wrong_torque_constant_is_no_load() -> None:
    for wrong in (0.9, 1.1):
        with Hand({}) as hand:
            hand.plant.plant.parameters.torque_constant *= wrong
            grasped(hand)
            hand.watch(2.0)
            assert hand.plant.normal.mean() == pytest.approx(10.0, rel=0.12)
            assert not [event for event in hand.events if event[1] == "slip"]


def test_a_force_asked_for_in_a_turn_shows_what_a_ramp_would() -> None:
    """A torque constant that a light grip did not tell is no load of a firm one."""
    with Hand({}) as hand:
        hand.plant.plant.parameters.torque_constant *= 0.9
        grasped(hand, 5.0)
        hand.command("grasp", force=15.0)
        hand.run(0.1)
        hand.command("rotate", angle=-0.2)
        hand.run(0.04)
        hand.command("grasp", force=18.0)
        hand.watch(2.5)
        assert hand.mode == "holding"
        assert hand.plant.normal.mean() == pytest.approx(18.0, rel=0.15)
        assert not [event for event in hand.events if event[1] == "slip"]
