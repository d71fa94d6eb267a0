"""Test the contact table, frames and estimates of solid rubber tips, and a hand with such tips."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger import ContactEstimator, ContactTable, Fingertip, Material, SensorGrid
from softfinger.daemon.loop.build import hand_info
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.estimation.estimator import Readings
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.sensing.solid_pressure import SolidPressure
from tests.harness.loop import command, grasped

TIPS = [
    Fingertip(0.020, "solid", 0.49, "bonded"),
    Fingertip(0.020, "solid", 0.45, "lying"),
    Fingertip(0.020, "solid", 0.47, "bonded", "sticking"),
]
RUBBER = Material.constant(0.304e6)
GRID = SensorGrid(44, 44, 0.058 / 44)
AREA = GRID.pitches[0] ** 2
NOISE = 608.0  # Pa

every = pytest.mark.parametrize("tip", TIPS, ids=lambda tip: f"{tip.base}-{tip.face}")


@every
def test_partial_derivatives_belong_to_one_energy(tip):
    table = ContactTable.build(tip, RUBBER)
    d, theta = np.meshgrid([0.4e-3, 3e-3, 7.5e-3], [-0.6, -0.1, 0.0, 0.3])
    c, h = table(d, theta), 1e-6
    assert c.inside.all()
    if tip.face == "sticking":
        # On a tilted face, the shear force increases the force on the base. A larger tilt causes a
        # larger increase.
        held = c.force / (np.cos(theta) * c.energy_d) - 1.0
        assert held[2] == pytest.approx(0.0, abs=1e-12)
        assert (held[0] < 0.2).all()
        assert (held[0] > held[3]).all()
        assert (held[3] > held[1]).all()
    else:
        assert c.force == pytest.approx(np.cos(theta) * c.energy_d, rel=1e-12)
    for field, up, down in (
        ("d", table(d + h, theta), table(d - h, theta)),
        ("theta", table(d, theta + h), table(d, theta - h)),
    ):
        for name in ("energy", "force"):
            slope = (getattr(up, name) - getattr(down, name)) / (2.0 * h)
            size = np.abs(slope).max()
            assert getattr(c, f"{name}_{field}") == pytest.approx(slope, rel=1e-5, abs=1e-6 * size)
    one = table(float(d[1, 1]), float(theta[1, 1]))
    # In a loop, the compiler may fuse other multiplications and additions.
    assert one[:6] == pytest.approx([float(each[1, 1]) for each in c[:6]], rel=1e-12)


@every
def test_small_contacts_are_hertzian_and_large_ones_end_with_the_data(tip):
    table = ContactTable.build(tip, RUBBER)
    stiffness = 4.0 / 3.0 * 0.304e6 / (1.0 - tip.poisson**2) * math.sqrt(tip.radius)
    # The base confines the rubber and increases the force. The increase depends on √(d/a), which is
    # the ratio of the contact radius to a.
    ratios = [float(table(d, 0.0).force) / (stiffness * d**1.5) for d in (1e-8, 1e-7)]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.01)
    end = table(0.008, 0.0)
    assert end.inside
    with pytest.warns(RuntimeWarning, match="outside the contact table"):
        beyond = table(0.0081, 0.0)
    assert not beyond.inside
    assert beyond.force == end.force
    with pytest.warns(RuntimeWarning, match=r"d = 4 mm, θ = 40\.1°"):
        assert not table(0.004, 0.7).inside
    assert table(-1e-3, 0.1).force == 0.0
    assert math.isnan(table(math.nan, 0.1).force)


def test_cells_sum_to_the_force_for_any_grid_and_azimuth():
    tip, d, theta = TIPS[0], 0.005, 0.35
    force = float(ContactTable.build(tip, RUBBER)(d, theta).force)
    shifted = SensorGrid(50, 40, (0.0014, 0.0011), centre=(7e-4, -3e-4))
    for grid in (GRID, shifted, SensorGrid(44, 44, 0.058 / 44, blur=1.2e-3)):
        for azimuth in (0.0, 1.0, 4.0):
            tilt_x = math.asin(math.sin(theta) * math.cos(azimuth))
            tilt_y = math.asin(math.sin(theta) * math.sin(azimuth))
            pressure = grid.pressure(tip, RUBBER, d, tilt_x, tilt_y)
            assert pressure.sum() * math.prod(grid.pitches) == pytest.approx(force, rel=5e-3)
    along_x = GRID.pressure(tip, RUBBER, d, theta, 0.0)
    along_y = GRID.pressure(tip, RUBBER, d, 0.0, theta)
    assert along_y == pytest.approx(along_x.T, abs=1e-6 * along_x.max())
    turned = SensorGrid(44, 44, 0.058 / 44, rotation=0.5 * math.pi)
    assert turned.pressure(tip, RUBBER, d, theta, 0.0)[::-1] == pytest.approx(
        along_y, abs=1e-6 * along_x.max()
    )


@pytest.mark.usefixtures("exact_solid_data")
@every
@pytest.mark.parametrize("counts", [False, True])
def test_the_estimate_reaches_its_bound_for_any_shear(tip, counts):
    rng = np.random.default_rng(3)
    estimator = ContactEstimator(tip, RUBBER, GRID, NOISE)
    press, table = SolidPressure(tip, RUBBER, GRID.images(tip)), ContactTable.build(tip, RUBBER)
    frame = np.empty(GRID.shape)
    squares = []
    for d in (0.7e-3, 2e-3, 4e-3, 7e-3):
        for theta in (0.0, 0.25, 0.5):
            for azimuth in rng.uniform(0.0, 2.0 * math.pi, 8):
                tilt_x = math.asin(math.sin(theta) * math.cos(azimuth))
                tilt_y = math.asin(math.sin(theta) * math.sin(azimuth))
                shear = 0.2 * float(table(d, 0.0).force) * rng.uniform(-1.0, 1.0, 2)
                press((d, math.sin(tilt_x), math.sin(tilt_y)), 1.0, frame, tuple(shear))
                frame += NOISE * rng.standard_normal(GRID.shape)
                if counts:
                    found = estimator(np.maximum(frame / 4.0 + 0.5, 0.0).astype(np.uint16), 4.0)
                else:
                    found = estimator(frame)
                assert found.valid
                assert found.contact
                assert [found.shear_x, found.shear_y] == pytest.approx(shear, rel=0.01, abs=0.1)
                error = [found.d - d, found.tilt_x - tilt_x, found.tilt_y - tilt_y]
                squares.append(error @ np.linalg.solve(found.covariance[:3, :3], error) / 3.0)
    # With 96 frames of three values, the mean is 1 ± 0.08. The mean is larger if some cells are
    # under tension and therefore measure nothing.
    assert 0.7 < np.mean(squares) < 1.4


@every
@pytest.mark.parametrize("theta", [0.15, 0.3, 0.5])
def test_a_fit_with_a_free_gain_converges_from_a_single_frame(tip, theta):
    estimator = ContactEstimator(tip, RUBBER, GRID, NOISE, free_gain=True)
    for d, gain, azimuth in ((2e-3, 1.0, 0.5), (2e-3, 1.6, 3), (3e-3, 0.6, 4.1), (5e-3, 0.6, 2)):
        tilt_x = math.asin(math.sin(theta) * math.cos(azimuth))
        tilt_y = math.asin(math.sin(theta) * math.sin(azimuth))
        found = estimator(GRID.pressure(tip, RUBBER, d, tilt_x, tilt_y, gain))
        assert found.valid
        assert abs(found.d - d) < 0.5 * found.d_std
        assert (found.tilt_x, found.tilt_y) == pytest.approx((tilt_x, tilt_y), abs=0.01)


def test_a_sensor_smaller_than_the_tip_estimates_the_contact():
    tip, grid = TIPS[0], SensorGrid(16, 16, 1.5e-3)
    found = ContactEstimator(tip, RUBBER, grid, NOISE)(grid.pressure(tip, RUBBER, 3e-3, 0.1))
    assert found.valid
    assert (found.d, found.tilt_x) == pytest.approx((3e-3, 0.1), rel=0.02)


def test_frames_of_other_elements_are_estimated_correctly():
    rng = np.random.default_rng(6)
    with np.load(Path(__file__).parents[1] / "golden" / "solid_frames.npz") as file:
        known = {name: file[name] for name in file.files}
    modulus, squares, upright = 0.304e6, [], []
    for k, block in enumerate(known["base"]):
        base, _, face = str(block).partition("-")
        kind: Any = (base, face or "frictionless")
        tip = Fingertip(0.020, "solid", float(known["nu"][k]), *kind)
        table = ContactTable.build(tip, RUBBER)
        estimator = ContactEstimator(tip, RUBBER, GRID, NOISE)
        d, theta = known["d"][k] * tip.radius, float(known["theta"][k])
        force = known["force"][k] * modulus * tip.radius**2
        frame = np.maximum(known["frame"][k] * modulus, 0.0)
        for _ in range(4):
            found = estimator(frame + NOISE * rng.standard_normal(GRID.shape))
            assert found.contact
            assert found.valid
            error = [found.d - d, found.tilt_x - theta, found.tilt_y]
            squares.append(error @ np.linalg.solve(found.covariance[:3, :3], error) / 3.0)
            upright += [squares[-1]] if theta == 0.0 else []
            # The tolerance includes three standard deviations, because noise dominates at small d.
            turned = math.radians(1.5) + 3.0 * found.tilt_x_std
            assert found.d == pytest.approx(d, rel=0.05, abs=3.0 * found.d_std)
            assert math.hypot(*error[1:]) < turned
            tilt = math.asin(math.hypot(math.sin(found.tilt_x), math.sin(found.tilt_y)))
            assert float(table(found.d, tilt).force) == pytest.approx(force, rel=0.03)
    assert 0.5 < np.mean(squares) < 1.5
    assert 0.5 < np.mean(upright) < 1.5


def test_noise_at_the_end_of_the_data_keeps_estimates_in_range():
    rng = np.random.default_rng(9)
    for tip in TIPS:
        estimator = ContactEstimator(tip, RUBBER, GRID, NOISE)
        for tilt in (0.0, 0.2, 0.4):
            frame = GRID.pressure(tip, RUBBER, 0.008, tilt)
            for _ in range(10):
                found = estimator.update(frame + NOISE * rng.standard_normal(GRID.shape))
                assert found.valid
                assert found.d == pytest.approx(0.008, rel=0.005)
                assert found.d <= 0.008


def test_noise_and_shifted_zero_offsets_are_not_a_contact():
    rng = np.random.default_rng(4)
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    for _ in range(300):
        noise = NOISE * rng.standard_normal(GRID.shape)
        assert not estimator(noise).contact
        assert not estimator(noise + 2.0 * NOISE).contact
        assert not estimator(np.maximum(noise / 4.0, 0.0).astype(np.uint16), 4.0).contact
    assert estimator(GRID.pressure(TIPS[0], RUBBER, 0.4e-3) + noise).contact


def test_dead_saturated_and_isolated_cells_are_excluded():
    rng = np.random.default_rng(5)
    active = rng.random(GRID.shape) > 0.1
    active[8, 20] = True
    truth = (0.005, 0.2, -0.1)
    frame = GRID.pressure(TIPS[0], RUBBER, *truth) + NOISE * rng.standard_normal(GRID.shape)
    frame[~active] = 0.0
    frame[active & (frame > 45e3)] = 45e3  # Clip 60 cells.
    frame[8, 20] = 200e3
    readings = Readings(saturation=45e3)
    found = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE, active=active, readings=readings)(frame)
    assert found.valid
    assert found.rejected_count == 1
    error = np.array([found.d, found.tilt_x, found.tilt_y]) - truth
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(found.covariance)[:3])).all()


def test_a_frame_of_another_tip_is_a_misfit():
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    springs = GRID.pressure(Fingertip(0.020), RUBBER, 0.004, 0.2)
    found = estimator(springs)
    assert found.contact
    assert found.misfit or not found.valid


def test_a_smooth_misfit_increases_the_uncertainty():
    rng, squares = np.random.default_rng(8), []
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    frame = GRID.pressure(replace(TIPS[0], base="lying"), RUBBER, 0.006, 0.2)
    for _ in range(20):
        found = estimator(frame + NOISE * rng.standard_normal(GRID.shape))
        assert found.misfit
        assert found.d < 0.97 * 0.006
        error = [found.d - 0.006, found.tilt_x - 0.2, found.tilt_y]
        squares.append(error @ np.linalg.solve(found.covariance[:3, :3], error) / 3.0)
    assert 0.5 < np.mean(squares) < 2.0


def test_a_hand_with_solid_tips_grasps_turns_and_releases(make):
    profile = load(Path("solid")).model_dump(exclude={"loop"})
    daemon = make(**profile)
    grasped(daemon, 10.0)
    daemon.loop.advance(1.0)
    hand, state = daemon.hand, daemon.loop.state
    for angle in (0.1, -0.1):
        command(daemon, "rotate", angle=angle)
        daemon.loop.advance(3.0)
        assert hand.object_pose[2] == pytest.approx(angle, abs=math.radians(0.5))
        for finger, contact in enumerate(state.contacts):
            assert contact.valid
            assert not contact.misfit
            assert contact.d == pytest.approx(hand.d[finger], abs=5.0 * contact.d_std)
            assert contact.theta == pytest.approx(hand.theta[finger], abs=math.radians(0.3))
            assert contact.force == pytest.approx(hand.force[finger], rel=0.06)
            # The base measures the moment of the shear force on the face, whose moment arm is about
            # the height a.
            shear = hand.tangential[finger] * (1.0 - hand.d[finger] / 0.020)
            assert abs(shear) > 0.2
            assert contact.shear_x == pytest.approx(shear, abs=0.15)
    assert state.fault == ""
    assert json.loads(hand_info(daemon.settings, daemon.models).table_left)["form"] == "solid"
    command(daemon, "release")
    daemon.loop.advance(1.5)
    assert state.mode == "armed"
    assert not any(contact.contact for contact in state.contacts)


@pytest.mark.extended
def test_turning_back_and_forth_does_not_change_the_force_of_a_solid_tip(make):
    """When a tip rolls, d changes without joint motion. The estimated gain must not change."""
    daemon = make(**load(Path("solid")).model_dump(exclude={"loop"}))
    grasped(daemon, 10.0)
    daemon.loop.advance(1.0)
    before = float(np.mean(daemon.hand.force))
    assert before == pytest.approx(10.0, rel=0.05)
    for angle in (0.1, -0.1) * 4:
        command(daemon, "rotate", angle=angle)
        daemon.loop.advance(2.0)
        assert float(np.mean(daemon.hand.force)) == pytest.approx(before, rel=0.05)


def test_unsuitable_profiles_of_a_solid_tip_are_refused():
    from softfinger.daemon.profile.validation import problems

    def wrong(**sections: dict[str, object]) -> list[str]:
        settings = Settings.model_validate({"tip": {"physics": "solid"}, **sections})
        return [each.partition(":")[0] for each in problems(settings)]

    assert wrong() == ["material.law", "safety.d_max"]
    sound = {"material": {"law": "constant"}, "safety": {"d_max": 0.008}}
    assert wrong(**sound) == []
    assert wrong(**sound, tactile={"blur": 0.008}) == ["tactile.blur"]
    for tactile in ({"pitch": 0.01}, {"centre_error": 0.01}, {"centre": (0.06, 0.0)}):
        assert wrong(**sound, tactile=tactile) == ["tactile.pitch, tactile.centre"]
    with pytest.raises(ValueError, match="9 active cells within its rim, got 4"):
        ContactEstimator(TIPS[0], RUBBER, SensorGrid(44, 44, 0.01), NOISE)


def _odd_frames() -> dict[str, np.ndarray]:
    """Return frames with strong signals that a solid tip's contact cannot cause."""
    (pitch, _), shape = GRID.pitches, GRID.shape
    y, x = (np.indices(shape) - 0.5 * (np.array(shape)[:, None, None] - 1.0)) * pitch
    radius = np.hypot(x, y)
    frames = {"uniform pressure": np.full(shape, 1e5)}
    for at in (0.008, 0.012, 0.016):
        frames[f"a ring of {at * 1e3:g} mm"] = np.where(np.abs(radius - at) < 0.0025, 3e4, 0.0)
    for at in (0.007, 0.010, 0.014):
        for height in (1e4, 1e5):
            blobs = [np.exp(-((x - side * at) ** 2 + y**2) / 1.25e-5) for side in (1.0, -1.0)]
            frames[f"two of {height:g} Pa at {at * 1e3:g} mm"] = height * (blobs[0] + blobs[1])
    return frames


ODD = _odd_frames()


@pytest.mark.parametrize("frame", ODD.values(), ids=ODD)
def test_a_strong_signal_is_never_reported_as_no_contact(frame):
    rng = np.random.default_rng(6)
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    for _ in range(20):
        found = estimator.update(frame + NOISE * rng.standard_normal(GRID.shape))
        assert found.contact
        assert found.invalid in (Invalid.MODEL_MISMATCH, Invalid.ABOVE_ZERO)


@pytest.mark.parametrize(("kind", "scale"), [(np.uint8, 300.0), (np.uint16, 4.0)])
def test_a_completely_saturated_sensor_is_reported_as_saturated(kind, scale):
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    found = estimator(np.full(GRID.shape, np.iinfo(kind).max, kind), scale)
    assert (found.contact, found.invalid) == (True, Invalid.SATURATED)


@pytest.mark.parametrize("times", [2.0, 2.6, 4.0, 6.0, 10.0])
def test_strong_noise_is_not_mistaken_for_no_contact(times):
    rng = np.random.default_rng(7)
    estimator = ContactEstimator(TIPS[0], RUBBER, GRID, NOISE)
    found = [estimator(times * NOISE * rng.standard_normal(GRID.shape)).invalid for _ in range(50)]
    assert set(found) <= {Invalid.MODEL_MISMATCH, Invalid.OUTLIERS}


def test_too_few_unsaturated_cells_give_no_estimate():
    """Of the 12 cells within the rim, 4 are unsaturated. The fit has 5 parameters."""
    grid, rng = SensorGrid(4, 4, 0.008), np.random.default_rng(5)
    readings = Readings(saturation=80e3)
    estimator = ContactEstimator(TIPS[0], RUBBER, grid, NOISE, readings=readings)
    frame = grid.pressure(TIPS[0], RUBBER, 7.9e-3, 0.0, 0.3)
    for _ in range(20):
        noisy = np.minimum(frame + NOISE * rng.standard_normal(frame.shape), 80e3)
        assert estimator(noisy).invalid is Invalid.SATURATED
