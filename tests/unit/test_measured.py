"""Test the interpolation, the table and the estimator for a tip that no model fits."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from softfinger import ContactEstimator, ContactTable, Fingertip, Material, SensorGrid
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CalibrationFileError,
    load_calibration,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.perception.finger_model import make_estimator, make_models
from softfinger.daemon.profile.load import load
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.measured_fit import PressSums, fit_measured
from softfinger.kinematics.contact.tip_curves import TipCurves
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.estimation.measured import MeasuredEstimator

A = 0.020
HIL = Path(__file__).parents[2] / "config" / "hil.toml"
GRID = SensorGrid(32, 32, 0.058 / 32)
TRUE = replace(GRID, centre=(0.7e-3, -0.4e-3), rotation=0.2)  # true position of the tip
NOISE = 600.0
D = 1e-3 * np.array([0.7, 1.5, 3, 5, 6, 2, 4, 5, 3, 6, 4])
THETA = np.radians([0, 0, 0, 0, 0, 10, -10, 10, 20, -25, 25])
WEIRD = 1e6  # stiffness [N/m²] of the force WEIRD d^1.8 A^0.2 cos θ, which no model predicts


def weird(d: float, theta: float) -> np.ndarray:
    """Return the pressures of a tip that no model fits. The pressures have a blunt peak.

    When the tip tilts, the peak moves half as far as the peak of a spring tip.
    """
    x, y = np.meshgrid(*(pitch * (np.arange(32) - 15.5) for pitch in TRUE.pitches))
    x, y = x - TRUE.centre[0], y - TRUE.centre[1]
    c, s = math.cos(TRUE.rotation), math.sin(TRUE.rotation)
    along, across = c * x - s * y - 0.5 * A * math.sin(theta), s * x + c * y
    shape = np.exp(-((along**2 + across**2) ** 2) / (7e-3) ** 4)
    return shape * force(d, theta) / (shape.sum() * math.prod(TRUE.pitches))


def force(d: float, theta: float) -> float:
    return WEIRD * d**1.8 * A**0.2 * math.cos(theta)


def presses(seed: int = 1, count: int = len(D)) -> PressSums:
    rng = np.random.default_rng(seed)
    true = [weird(d, theta) for d, theta in zip(D[:count], THETA[:count], strict=True)]
    frames = [each + NOISE * rng.standard_normal((40, 32, 32)) for each in true]
    means = np.stack([each.mean(axis=0) for each in frames])
    live = np.ones((32, 32), np.bool_)
    return PressSums(D[:count], THETA[:count], frames, means, np.zeros((32, 32)), live)


@pytest.fixture(scope="module")
def law() -> TipCurves:
    return fit_measured(presses(), A, GRID)


def estimator_of(law: TipCurves, known: Uncertainty | None = None) -> MeasuredEstimator:
    placed = replace(GRID, centre=law.centre, rotation=law.rotation)
    return MeasuredEstimator(Fingertip(A, "measured", law=law), placed, known=known)


@pytest.mark.parametrize("push", [0.5, 2.0, 5.0])
def test_an_undetected_contact_is_within_the_reported_uncertainty(law, push):
    estimator = estimator_of(law, Uncertainty(baseline=1e3))
    d = (push / (WEIRD * A**0.2)) ** (1 / 1.8)
    found = estimator(weird(d, 0.0))
    assert found.valid
    assert not found.contact
    assert d < found.d_std < 1.5 * d * (5.0 / push) ** 0.6


@pytest.mark.parametrize("name", ["gain", "slope"])
@pytest.mark.parametrize("d", [1.5e-3, 4e-3])
def test_declared_cell_uncertainties_are_part_of_the_errors(law, name, d):
    known = {"gain": Uncertainty(gain=0.12), "slope": Uncertainty(slope=500.0)}[name]
    estimator = estimator_of(law, known)
    off_by, theta = [], math.radians(10.0)
    x = GRID.pitches[0] * (np.arange(32) - 15.5)
    for sign in (-1.0, 1.0):
        frame = weird(d, theta)
        frame = frame * (1.0 + 0.12 * sign) if name == "gain" else frame + 500.0 * sign * x / A
        found = estimator(frame)
        assert found.valid
        off = np.array([found.d - d, found.tilt_x - theta, found.tilt_y])
        off_by.append(np.abs(off) / np.sqrt(found.covariance.diagonal()[:3]))
    # With other random seeds, the maximum ranges from 1.1 to 1.65 and occurs at the smallest
    # depths.
    assert 0.5 < np.max(off_by) < 2.0


def test_the_estimator_of_a_model_refers_to_that_of_a_measured_tip(law):
    with pytest.raises(ValueError, match="MeasuredEstimator"):
        ContactEstimator(Fingertip(A, "measured", law=law), Material.constant(1.0), GRID, NOISE)


def test_the_curves_equal_those_of_the_tip(law):
    assert (law.deepest, law.tilt, law.presses) == (0.006, pytest.approx(math.radians(25.0)), 11)
    assert law.centre == pytest.approx(TRUE.centre, abs=1e-4)
    assert law.rotation == pytest.approx(TRUE.rotation, abs=0.01)
    assert law.force_error < 0.01
    assert law.at(law.lever, 0.004, 0.2) == pytest.approx(0.5 * A, rel=0.02)
    table = ContactTable.build(Fingertip(A, "measured", law=law), Material.constant(1.0))
    d, theta = np.meshgrid(np.linspace(1e-3, 5.9e-3, 8), np.radians([0.0, 8.0, -20.0]))
    found, step = table(d, theta), 1e-6
    true = np.vectorize(force)(d, theta)
    assert found.force == pytest.approx(true, rel=0.02)
    assert found.energy_d == pytest.approx(found.force / np.cos(theta))
    slope = (table(d + step, theta).energy - table(d - step, theta).energy) / (2 * step)
    assert found.energy_d == pytest.approx(slope, rel=1e-5)
    turned = (table(d, theta + step).energy - table(d, theta - step).energy) / (2 * step)
    assert found.energy_theta == pytest.approx(turned, rel=1e-3, abs=1e-9)
    assert found.inside.all()
    with pytest.warns(RuntimeWarning, match="outside the contact table"):
        assert not table(0.0062, 0.0).inside
    with pytest.warns(RuntimeWarning, match="outside the contact table"):
        assert not table(0.003, math.radians(26.0)).inside


@pytest.mark.parametrize(("d", "degrees"), [(1e-3, 0.0), (2.5e-3, 14.0), (5.5e-3, -5.0)])
def test_frames_are_estimated_with_consistent_errors(law, d, degrees):
    estimator = estimator_of(law)
    rng, squares = np.random.default_rng(2), []
    for _ in range(60):
        frame = weird(d, math.radians(degrees)) + NOISE * rng.standard_normal((32, 32))
        found = estimator(frame)
        assert found.contact
        assert found.valid
        assert found.d == pytest.approx(d, rel=0.15 if d < 2e-3 else 0.03)
        off = np.array([found.d - d, found.tilt_x - math.radians(degrees), found.tilt_y])
        squares.append(off**2 / found.covariance.diagonal()[:3])
    assert (np.mean(squares, axis=0) < 2.0).all()
    assert not estimator(NOISE * rng.standard_normal((32, 32))).contact
    assert estimator(weird(0.008, 0.0)).invalid == Invalid.OUT_OF_RANGE
    two = weird(d, 0.0) + np.roll(weird(d, 0.0), 8, axis=0)
    assert not estimator(two).valid
    assert estimator(np.full((32, 32), 20e3)).invalid == Invalid.ABOVE_ZERO
    frame[16, 16] = np.nan
    assert estimator(frame).invalid == Invalid.NOT_FINITE


def test_unsuitable_contacts_are_refused():
    with pytest.raises(CalibrationError, match="found 5 presses at 5 depths, 0 of them tilted"):
        fit_measured(presses(count=5), A, GRID)
    falls = presses()
    softer = [each / (1.0 + (d / 2e-3) ** 3) for each, d in zip(falls.frames, D, strict=True)]
    with pytest.raises(CalibrationError, match="the best-fitting smooth, increasing curves differ"):
        fit_measured(replace(falls, frames=softer), A, GRID)
    single = replace(falls, frames=[each[:1] for each in falls.frames])
    with pytest.raises(CalibrationError, match="five frames for each press"):
        fit_measured(single, A, GRID)


def test_a_finger_uses_the_curves_of_its_file(law, tmp_path):
    file, other = tmp_path / "left.json", tmp_path / "other.json"
    settings = load(HIL, tmp_path, [])
    empty = Calibration(sensor=sensor_of(settings, 0), date="")
    save_calibration(file, empty.model_copy(update={"law": law}))
    assert load_calibration(file).law == law

    def profile(name: Path, *more: str) -> list[str]:
        return [
            'scene.fingers=["left"]', "tip.physics=measured", *more,
            f'tactile.calibration=["{name}", ""]',
        ]  # fmt: skip

    settings = load(HIL, tmp_path, profile(file, "safety.d_max=0.006"))
    left, _ = make_models(settings)
    assert left.table(0.004, 0.1).force == pytest.approx(force(0.004, 0.1), rel=0.02)
    assert left.grid.centre == law.centre
    estimator = make_estimator(settings, left.material, 0, None, left.calibration)
    assert estimator(weird(0.004, 0.1)).d == pytest.approx(0.004, rel=0.01)

    with pytest.raises(SettingsError, match=r"safety.d_max: found 0.012 m, expected at most 0.006"):
        make_models(load(HIL, tmp_path, profile(file)))
    save_calibration(other, empty)
    with pytest.raises(SettingsError, match=r"other.json does not contain curves for the left tip"):
        make_models(load(HIL, tmp_path, profile(other)))
    with pytest.raises(SettingsError, match=r'tactile.calibration: found "" for left'):
        load(HIL, tmp_path, ["tip.physics=measured", "safety.d_max=0.006"])
    with pytest.raises(
        SettingsError, match="measured curves require the frames of a physical board"
    ):
        load(None, tmp_path, ["tip.physics=measured"])
    falling = asdict(law) | {"push": [[-value for value in row] for row in law.push]}
    text = json.loads(file.read_text()) | {"law": falling}
    other.write_text(json.dumps(text))
    with pytest.raises(CalibrationFileError, match="push must increase with d"):
        load_calibration(other)
