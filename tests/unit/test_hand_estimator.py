"""Test the estimator of the hand against NumPy, during start-up and with slow cells."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from softfinger.daemon.perception.hand_estimator import HandEstimator
from softfinger.daemon.perception.hand_state import (
    ANGLE,
    ENCODER,
    STATES,
    TAPER,
    HandFilter,
    correct,
)
from softfinger.daemon.perception.prior import Prior
from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import VELOCITY_UNIT
from softfinger.daemon.types import Contact, Frame, Goal, ObjectPose, Reading
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid

SETTINGS = Settings()


@kernel
def corrected(hands: Records[HandFilter], innovation: float, variance: float, gate: float) -> None:
    correct(hands[0], 0, innovation, variance, gate)


def some_hand(rng: np.random.Generator) -> HandFilter:
    hand = HandFilter()
    root = 1e-2 * rng.normal(size=(STATES, STATES))
    hand.covariance[:] = root @ root.T
    hand.mean[:] = 1e-3 * rng.normal(size=STATES)
    hand.prior_variance[:] = 1.0
    hand.latency = 1.0
    hand.frame_rate = 100.0
    return hand


@pytest.mark.parametrize("gate", [math.inf, 3.0])
def test_corrections_equal_a_kalman_filter_with_clipped_innovations(gate):
    rng = np.random.default_rng(1)
    for innovation in (1e-3, -0.02, 0.5):
        hand = some_hand(rng)
        mean, covariance = hand.mean.copy(), hand.covariance.copy()
        slopes = rng.normal(size=STATES) * (rng.random(STATES) < 0.3)
        hand.slopes[:] = slopes
        corrected(hand.array, innovation, 1e-4, gate)
        expected = slopes @ covariance @ slopes
        total = max(expected + 1e-4, (innovation / gate) ** 2)
        weights = covariance @ slopes / total
        np.testing.assert_allclose(hand.mean, mean + weights * innovation, atol=1e-12)
        left = covariance - np.outer(weights, weights) * total
        np.testing.assert_allclose(hand.covariance, left, atol=1e-12)
        assert (hand.slopes == 0.0).all()
        assert np.linalg.eigvalsh(hand.covariance).min() > -1e-12


@pytest.mark.parametrize("innovation", [math.nan, math.inf])
def test_a_non_finite_measurement_has_no_effect(innovation):
    hand = some_hand(np.random.default_rng(2))
    mean, covariance = hand.mean.copy(), hand.covariance.copy()
    hand.slopes[0] = 1.0
    corrected(hand.array, innovation, 1e-4, 3.0)
    np.testing.assert_array_equal(hand.mean, mean)
    np.testing.assert_array_equal(hand.covariance, covariance)
    assert (hand.slopes == 0.0).all()


def test_channel_consistency_is_one_for_modelled_noise_and_four_for_doubled_noise():
    rng = np.random.default_rng(3)
    for factor in (1.0, 2.0):
        hand, found = some_hand(rng), []
        covariance, slopes = hand.covariance.copy(), rng.normal(size=STATES)
        std = math.sqrt(slopes @ covariance @ slopes + 1e-4)
        for _ in range(4000):
            hand.covariance[:], hand.slopes[:] = covariance, slopes
            corrected(hand.array, factor * std * rng.normal(), 1e-4, math.inf)
            found.append(hand.grasp.nis[0])
        # The first 500 values are a transient. The mean of 4000 squares has a standard error of
        # 0.022.
        assert np.mean(found[500:]) == pytest.approx(factor**2, rel=0.15)
        assert not hand.grasp.nis[1:].any()


@pytest.fixture
def estimator() -> HandEstimator:
    table = make_table(SETTINGS)
    return HandEstimator(SETTINGS, (table, table))


ESTIMATE = ContactEstimate(
    contact=True,
    invalid=Invalid.NONE,
    d=0.003,
    tilt_x=0.1,
    covariance=np.diag([5e-5**2, 5e-3**2, 0.0, 1e6]),  # unknown gain
)


def test_systematic_errors_do_not_average_out():
    settings = Settings.model_validate({"scene": {"fingers": ("left",)}})
    table = make_table(settings)
    estimator = HandEstimator(settings, (table, table))
    contacts, pose = [Contact(), Contact()], ObjectPose()
    shared = np.diag([2e-5**2, 4e-3**2, 0.0, 0.0])
    estimate = replace(ESTIMATE, covariance=ESTIMATE.covariance + shared, systematic=shared)
    for k in range(100):
        t = 5.0 + 0.01 * k
        estimator.predict(Reading(t=t, q=[0.15, 0.15], valid=True))
        estimator.update(0, frame(t), estimate, contacts[0])
        estimator.write_contacts(t, contacts, pose)
        if k == 0:
            first = replace(contacts[0])
    contact = contacts[0]
    assert first.d_std == pytest.approx(math.hypot(5e-5, 2e-5), rel=1e-3)
    # The zero offset may drift, so the standard deviation is at least 2e-5 m.
    assert 2e-5 < contact.d_std < 1.2 * first.d_std
    assert 4e-3 < contact.theta_std < first.theta_std
    # The force error results from the errors of d, θ and the modulus. The derivatives are ∂F/∂d =
    # 2F/d and ∂F/∂θ = F tan θ, and the modulus error is 20 %.
    by_d, by_theta = 2.0 * contact.force / contact.d * contact.d_std, contact.force * 0.1 * 4e-3
    # The rubber may relax by 7 %.
    by_modulus, by_relaxation = 0.2 * contact.force, 0.07 * contact.force
    expected = math.hypot(by_d, by_theta, by_modulus, by_relaxation)
    assert contact.force_std == pytest.approx(expected, rel=0.02)


@pytest.mark.filterwarnings("ignore:the material law deviates")
def test_the_misfit_of_the_material_law_is_part_of_the_force_error(estimator):
    contacts, pose = [Contact(), Contact()], ObjectPose()
    strain = np.linspace(0.025, 1.0, 40)
    law = Material.from_points(strain, 1e5 * strain**0.7)
    known, unknown = (
        HandEstimator(SETTINGS, (make_table(SETTINGS, law),) * 2, materials)
        for materials in (None, (law, law))
    )
    found = []
    for each in (known, unknown):
        for read in (False, True):
            if read:
                each.predict(Reading(t=5.0, q=[0.15, 0.15], valid=True))
            each.update(0, frame(5.0), ESTIMATE, contacts[0])
            each.write_contacts(5.0, contacts, pose)
            found.append(contacts[0].force_std / contacts[0].force)
    by_law = law.force_error(0.003 / SETTINGS.tip.radius)
    np.testing.assert_allclose(found[2:], np.hypot(found[:2], by_law), rtol=0.05)


@pytest.mark.parametrize(("modulus_error", "gain_error"), [(0.2, 0.01), (0.05, 0.3)])
def test_a_frame_with_a_fixed_gain_measures_the_product_of_force_and_gain(
    modulus_error, gain_error
):
    table = make_table(SETTINGS)
    prior = Prior((1.1, modulus_error), (1.4, gain_error), (1.0, 0.1))
    estimator = HandEstimator(SETTINGS, (table, table), priors=(prior, prior))
    contact = Contact()
    fixed = replace(ESTIMATE, covariance=np.diag([1e-12, 1e-12, 0.0, 0.0]))
    estimator.update(0, frame(5.0), fixed, contact)
    assert contact.force == pytest.approx(table(0.003, 0.1).force / 1.4)
    # Without `tip.relaxation`, the rubber may relax by 7 %.
    assert contact.force_std / contact.force == pytest.approx(
        math.hypot(gain_error, 0.07), rel=0.01
    )


def test_the_prior_of_a_torque_constant_is_relative():
    table = make_table(SETTINGS)
    prior = Prior((1.0, 0.2), (1.0, 0.25), (0.8, 0.1))
    estimator = HandEstimator(SETTINGS, (table, table), priors=(prior, prior))
    contacts = [Contact(), Contact()]
    estimator.predict(Reading(t=5.0, q=[0.15, 0.15], valid=True))
    estimator.update(0, frame(5.0), ESTIMATE, contacts[0])
    estimator.write_contacts(5.0, contacts, ObjectPose())
    assert contacts[0].torque_scale == pytest.approx(0.8)
    assert contacts[0].torque_scale_std == pytest.approx(0.08)


def frame(t: float) -> Frame:
    return Frame(1, t, t, True, np.zeros((1, 1), np.uint16))


@pytest.mark.parametrize("read_first", [True, False])
def test_a_contact_at_start_up_is_reported_from_the_first_frame_on(estimator, read_first):
    contacts, pose = [Contact(), Contact()], ObjectPose()
    if read_first:
        estimator.predict(Reading(t=5.0, q=[0.15, 0.15], valid=True))
    # Both frames were sampled before the first reading of the joints.
    for k in range(2):
        estimator.update(0, frame(4.98 + 0.01 * k), ESTIMATE, contacts[0])
        estimator.write_contacts(5.0, contacts, pose)
        assert contacts[0].valid
        assert contacts[0].d == pytest.approx(0.003)
        assert contacts[0].theta == pytest.approx(0.1)
    for k in range(1, 30):
        t = 5.0 + 0.002 * k
        estimator.predict(Reading(t=t, q=[0.15, 0.15], valid=True))
        if k % 5 == 0:
            estimator.update(0, frame(t - 0.01), ESTIMATE, contacts[0])
        estimator.write_contacts(t, contacts, pose)
    contact = contacts[0]
    assert contact.d == pytest.approx(0.003, rel=0.02)
    assert contact.theta == pytest.approx(0.1, rel=0.02)
    assert contact.force > 1.0
    assert math.isfinite(contact.energy + contact.d_std + contact.theta_std)


@pytest.mark.parametrize("depths", [(3e-3, 3e-3), (3e-3, 1e-3)])
@pytest.mark.parametrize("gripping", [False, True])
def test_tips_are_independent_until_a_grip_begins(estimator, depths, gripping):
    """Press plates against both tips while the joints do not move."""
    contacts, pose = [Contact(), Contact()], ObjectPose()
    for k in range(100):
        t = 5.0 + 0.01 * k
        estimator.predict(Reading(t=t, q=[0.15, 0.15], valid=True), Goal() if gripping else None)
        for finger, depth in enumerate(depths):
            d = depth * min(0.1 + 0.015 * k, 1.0)
            estimator.update(finger, frame(t), replace(ESTIMATE, d=d), contacts[finger])
        estimator.write_contacts(t, contacts, pose)
    found = [contact.d for contact in contacts]
    if gripping:  # A gripped object cannot change its width, so the frames are wrong.
        assert sum(found) < 0.8 * sum(depths)
    else:
        assert found == pytest.approx(depths, rel=0.01)


def test_an_encoder_edge_at_the_expected_angle_changes_no_estimate(estimator):
    contacts, pose = [Contact(), Contact()], ObjectPose()
    state, q, error = estimator._state, 0.15, 3e-4
    for k in range(20):
        t = 5.0 + 0.01 * k
        estimator.predict(Reading(t=t, q=[q, q], valid=True), Goal())
        for finger in range(2):
            estimator.update(finger, frame(t), ESTIMATE, contacts[finger])
        estimator.write_contacts(t, contacts, pose)
    # The joint crosses the edge to the next count at the angle that the filter expects.
    state.mean[ENCODER] = error
    state.tip[0].q = q + 0.5 * state.encoder_resolution - error
    estimator.write_contacts(t, contacts, pose)
    before = contacts[0].theta, contacts[0].d, pose.angle
    t, q = t + 1e-6, q + state.encoder_resolution
    estimator.predict(Reading(t=t, q=[q, 0.15], valid=True), Goal())
    estimator.write_contacts(t, contacts, pose)
    assert (contacts[0].theta, contacts[0].d, pose.angle) == pytest.approx(before, abs=1e-8)


def test_one_finger_has_the_same_uncertainty_on_both_sides():
    found = []
    for finger, name in enumerate(("left", "right")):
        settings = Settings.model_validate({"scene": {"fingers": (name,)}})
        table = make_table(settings)
        estimator = HandEstimator(settings, (table, table))
        contacts, pose = [Contact(), Contact()], ObjectPose()
        for k in range(50):
            t, q, dq = 5.0 + 0.002 * k, [0.0, 0.0], [0.0, 0.0]
            dq[finger] = 0.2
            q[finger] = 0.15 + 0.0004 * k
            estimator.predict(Reading(t=t, q=q, dq=dq, valid=True), Goal())
            if k == 0:
                estimate = replace(ESTIMATE, tilt_x=0.1 - 0.2 * finger)
                estimator.update(finger, frame(t), estimate, contacts[finger])
        estimator.write_contacts(t, contacts, pose)
        found.append((contacts[finger].d, contacts[finger].d_std, contacts[finger].theta_std))
    assert found[0] == pytest.approx(found[1])


def test_the_tilt_uncertainty_includes_the_joint_angles(estimator):
    contacts, pose = [Contact(), Contact()], ObjectPose()
    covariance = estimator._state.covariance
    for k in range(40):
        t, q = 5.0 + 0.002 * k, [0.15 + 0.0004 * k] * 2
        estimator.predict(Reading(t=t, q=q, dq=[0.2, 0.2], valid=True), Goal())
        if k % 5 == 0:
            for finger in range(2):
                estimator.update(finger, frame(t), ESTIMATE, contacts[finger])
        estimator.write_contacts(t, contacts, pose)
    for finger, sense in enumerate((1.0, -1.0)):
        slopes = np.zeros(STATES)
        slopes[[ANGLE, TAPER, ENCODER + finger]] = 1.0, -0.5 * sense, sense
        expected = math.sqrt(slopes @ covariance @ slopes)
        assert contacts[finger].theta_std == pytest.approx(expected)


@pytest.mark.parametrize("speed", [0.3, 0.52, 1.4])
def test_d_follows_the_encoders_of_slow_joints(estimator, speed):
    """Open both joints by 8 counts at ``speed`` velocity units; readings are whole units."""
    contacts, pose = [Contact(), Contact()], ObjectPose()
    count, start, dt = estimator._state.encoder_resolution, 0.15, 0.002
    for k in range(20):
        estimator.predict(Reading(t=5.0 + dt * k, q=[start] * 2, valid=True), Goal())
        for finger in range(2):
            estimator.update(finger, frame(5.0 + dt * k), ESTIMATE, contacts[finger])
        estimator.write_contacts(5.0 + dt * k, contacts, pose)
    first, arm = contacts[0].d, estimator.grasp.moment_arm[0]
    dq = -round(speed) * VELOCITY_UNIT
    for k in range(round(8.0 * count / (speed * VELOCITY_UNIT * dt))):
        t, opened = 5.04 + dt * k, speed * VELOCITY_UNIT * dt * (k + 1)
        q = round((start - opened) / count) * count
        estimator.predict(Reading(t=t, q=[q, q], dq=[dq, dq], valid=True), Goal())
        estimator.write_contacts(t, contacts, pose)
        assert contacts[0].d == pytest.approx(first - arm * opened, abs=1.2 * arm * count)


NO_CONTACT = replace(ESTIMATE, contact=False, d=0.0)


@pytest.mark.parametrize(
    ("d", "d_std", "count", "gripping", "kept"),
    [
        (1e-3, 4e-4, 1, True, True),  # Noise may hide this contact.
        (1e-3, 4e-4, 7, True, True),
        (1e-3, 4e-4, 9, True, False),  # After 0.1 s without a usable frame, torque is switched off.
        (3e-3, 4e-4, 1, True, False),  # The frame would show this contact.
        (1e-3, 4e-4, 1, False, False),  # Without a grip, the object may move away.
    ],
)
def test_a_contact_that_a_frame_may_hide_is_kept(estimator, d, d_std, count, gripping, kept):
    contacts, pose = [Contact(), Contact()], ObjectPose()
    for k in range(20 + count):
        t = 5.0 + 0.01 * k
        estimator.predict(Reading(t=t, q=[0.15, 0.15], valid=True), Goal() if gripping else None)
        hidden = replace(NO_CONTACT, covariance=np.diag([d_std**2, 1.0, 1.0, 1.0]))
        seen = replace(ESTIMATE, d=d)
        estimator.update(0, frame(t), hidden if k >= 20 else seen, contacts[0])
        estimator.update(1, frame(t), seen, contacts[1])
        estimator.write_contacts(t, contacts, pose)
    assert contacts[0].contact == kept
    assert contacts[0].d == pytest.approx(d if kept else 0.0, rel=0.05)


@pytest.mark.parametrize(("gap", "kept"), [(0.02, True), (0.5, False)])
def test_friction_is_measured_again_only_after_a_longer_gap(estimator, gap, kept):
    """A light touch may be lost for one frame, which must not discard the measured friction."""
    contact, t = Contact(), 5.0
    for duration, torque, estimate in (
        (0.5, 0.12, NO_CONTACT),
        (0.02, 0.3, ESTIMATE),
        (gap, 0.06, NO_CONTACT),
        (0.02, 0.3, ESTIMATE),
    ):
        current = torque / SETTINGS.control.torque_constant
        for k in range(round(duration / 0.002)):
            t += 0.002
            estimator.predict(Reading(t=t, dq=[0.3, 0.3], current=[current] * 2, valid=True))
            if k % 5 == 0:
                estimator.update(0, frame(t), estimate, contact)
    assert estimator.grasp.free_torque[0] == pytest.approx(0.12 if kept else 0.06, rel=0.05)


@pytest.mark.parametrize("response", [0.04, 0.08])
def test_joint_motion_compensates_for_slow_cells(response):
    settings = Settings.model_validate({"tactile": {"response": response}})
    table = make_table(settings)
    estimator = HandEstimator(settings, (table, table))
    contacts, pose = [Contact(), Contact()], ObjectPose()
    d, q = 0.003, 0.15
    # Distances of the cells below the tip's apex [m]. All cells have the same area.
    below = np.linspace(0.0, 0.01, 400)
    pressure, shown, fitted = np.maximum(d - below, 0.0), q, (d, 1.0)
    follows = -math.expm1(-0.002 / response)
    off = []

    def model(at: np.ndarray, d: float, gain: float) -> np.ndarray:
        return np.asarray(gain * np.maximum(d - at, 0.0))

    def slopes(at: np.ndarray, d: float, gain: float) -> np.ndarray:
        return np.stack((gain * (at < d), np.maximum(d - at, 0.0)), axis=1)

    for k in range(300):
        t = 1.0 + 0.002 * k
        dq = 0.2 if 100 <= k < 200 else 0.0
        d += 0.002 * dq * float(np.mean(estimator.grasp.moment_arm))
        q += 0.002 * dq
        pressure += (model(below, d, 1.0) - pressure) * follows
        shown += (q - shown) * follows
        estimator.predict(Reading(t=t, q=[q] * 2, dq=[dq] * 2, valid=True))
        if k % 5 == 0:
            fitted = curve_fit(model, below, pressure, fitted, jac=slopes)[0]
            for finger, sense in enumerate((1.0, -1.0)):
                estimate = replace(ESTIMATE, d=fitted[0], gain=fitted[1], tilt_x=sense * shown)
                estimator.update(finger, frame(t), estimate, contacts[finger])
        estimator.write_contacts(t, contacts, pose)
        off.append(contacts[0].d - d)
    assert d > 5e-3
    # A growing footprint also appears flatter, which the filter does not correct.
    assert np.abs(off).max() < 3e-4
