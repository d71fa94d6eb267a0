"""Test that contacts at known depths and tilts determine the tip model, modulus, ν and position."""

import math
from pathlib import Path

import numpy as np
import pytest

from softfinger import ContactTable, Fingertip, Material, SensorGrid
from softfinger.daemon.perception.calibration_file import load_calibration, save_calibration
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.press_fit import (
    Presses,
    compare_tips,
    fit_centre,
    fit_modulus,
)
from softfinger.kinematics.contact.tip_curves import TipCurves
from softfinger.tools.cli import main

GRID = SensorGrid(32, 32, 0.058 / 32)
RUBBER = Material.constant(0.25e6)
TIP = Fingertip(0.020, "solid", 0.48)
STICKING = Fingertip(0.020, "solid", 0.48, face="sticking")
D = np.array([1e-3, 2e-3, 3e-3, 3e-3, 4e-3])
THETA = np.radians([0.0, 0.0, -10.0, 20.0, 15.0])
NOISE = 600.0
LATE = 2e-4  # zero offset of the recorded d [m]


def frames(tip: Fingertip, grid: SensorGrid = GRID) -> np.ndarray:
    rng = np.random.default_rng(1)
    pressed = [
        grid.pressure(tip, RUBBER, float(d), float(t)) for d, t in zip(D, THETA, strict=True)
    ]
    return np.stack(pressed) + NOISE * rng.standard_normal((len(D), *grid.shape))


@pytest.mark.parametrize(
    "tip",
    [STICKING, pytest.param(Fingertip(0.020), marks=pytest.mark.extended)],
    ids=lambda tip: tip.physics,
)
def test_the_true_tip_model_fits_best(tip):
    seen = frames(tip)
    presses = Presses(seen, D + LATE, THETA, NOISE, np.ones(seen.shape, np.bool_))
    best, *others = compare_tips(presses, 0.020, GRID, np.ones(GRID.shape, np.bool_))
    assert best.tip.physics == tip.physics
    assert best.chi2 == pytest.approx(1.0, abs=0.1)
    assert min(each.chi2 for each in others) > 1.7
    assert best.modulus == pytest.approx(0.25e6, rel=0.03)
    assert best.offset == pytest.approx(LATE, abs=3e-5)
    assert best.valid == 1.0
    assert best.d_error < 1e-4
    assert best.theta_error < math.radians(1.5)
    assert best.force_error < 0.12  # mostly noise of the summed pressure
    if tip.physics == "solid":
        assert (best.tip.base, best.tip.face) == ("bonded", "sticking")
        assert best.tip.poisson == pytest.approx(0.48, abs=0.01)


@pytest.mark.parametrize(
    ("d", "degrees"), [((2e-3, 4e-3, 6e-3), (0.0, 30.0, 60.0)), ((2e-3, 4e-3, 9e-3), (0.0,) * 3)]
)
def test_solid_models_are_omitted_outside_the_range_of_their_data(d, degrees):
    theta = np.radians(degrees).tolist()
    seen = np.stack(
        [GRID.pressure(Fingertip(0.020), RUBBER, *pose) for pose in zip(d, theta, strict=True)]
    )
    presses = Presses(seen, np.array(d), np.array(theta), NOISE, np.ones(seen.shape, np.bool_))
    (only,) = compare_tips(presses, 0.020, GRID, np.ones(GRID.shape, np.bool_))
    assert only.tip.physics == "springs"
    assert only.modulus == pytest.approx(0.25e6, rel=1e-3)


@pytest.mark.parametrize(("tip", "d"), [(TIP, 9e-3), (Fingertip(0.020), 18e-3)])
def test_a_modulus_is_not_fitted_outside_the_range_of_the_model(tip, d):
    depths = np.array([2e-3, 4e-3, 6e-3, d])
    load = ContactTable.build(tip, RUBBER)(depths, 0.0, edge=True).force
    told = f"d = {d * 1e3:g} mm at θ = 0° is outside the range of the model"
    with pytest.raises(CalibrationError, match=told):
        fit_modulus(depths, np.zeros(4), load, tip)
    inside = fit_modulus(depths[:-1], np.zeros(3), load[:-1], tip)
    assert inside.modulus == pytest.approx(0.25e6, rel=1e-6)


@pytest.mark.extended
def test_position_and_rotation_of_a_solid_tip_are_found_from_complete_frames():
    true = SensorGrid(32, 32, 0.058 / 32, centre=(1.3e-3, -0.8e-3), rotation=-2.0)
    found = fit_centre(frames(TIP, true), THETA, TIP, RUBBER, GRID, NOISE)
    assert found.centre == pytest.approx(true.centre, abs=6e-5)  # The noise is about 2e-5.
    assert 2e-5 < found.std < 1e-4
    assert found.rotation == pytest.approx(-2.0, abs=0.03)


def test_the_modulus_of_a_solid_tip_is_found_with_its_own_force_law():
    force = frames(TIP).sum(axis=(1, 2)) * GRID.pitches[0] ** 2
    found = fit_modulus(D + LATE, THETA, force, tip=TIP)
    assert found.modulus == pytest.approx(0.25e6, rel=0.05)
    assert found.offset == pytest.approx(LATE, abs=5e-5)
    assert found.residual < 0.03


@pytest.mark.parametrize("base", ["bonded", "lying"])
def test_deep_contacts_of_other_elements_give_one_modulus(base):
    with np.load(Path(__file__).parents[1] / "golden" / "solid_frames.npz") as file:
        known = (file["base"] == base) & (file["theta"] == 0.0) & (file["d"] < 0.31)
        d, force = file["d"][known] * 0.020, file["force"][known] * 0.25e6 * 0.020**2
    tip = Fingertip(0.020, "solid", 0.49, base)
    found = fit_modulus(d, np.zeros(len(d)), force, tip=tip)
    assert found.modulus == pytest.approx(0.25e6, rel=0.01)
    assert not found.trend.drifts


@pytest.mark.parametrize(
    ("made", "fitted", "sign"),
    [
        (TIP, TIP, 0),
        (TIP, Fingertip(0.020, "solid", 0.48, "lying"), 1),
        (Fingertip(0.020, "solid", 0.48, "lying"), TIP, -1),
        (Fingertip(0.020), TIP, -1),
        (TIP, Fingertip(0.020), 1),
    ],
)
def test_a_modulus_fitted_with_the_wrong_law_varies_with_depth(made, fitted, sign):
    rng = np.random.default_rng(2)
    d = np.linspace(1e-3, 7e-3, 7)
    force = ContactTable.build(made, RUBBER)(d, 0.0).force * (1.0 + 0.01 * rng.standard_normal(7))
    found = fit_modulus(d, np.zeros(7), force, tip=fitted)
    assert found.trend.drifts == (sign != 0)
    if sign:
        assert np.sign(found.trend.drift) == sign
        assert ("more than" in found.trend.cause) == (sign > 0)
        assert fitted.physics not in found.trend.cause  # This physics has already been tried.
    assert found.trend.d == pytest.approx(d)
    assert found.trend.modulus == pytest.approx(found.modulus / (1.0 + found.errors), rel=1e-12)


def test_calibrate_law_names_the_tip_model(tmp_path, capsys):
    each = frames(TIP) / 20.0
    counts = np.clip(np.round(np.concatenate([1.1 * each[1:2], each])), 0, 4095).astype(np.uint16)
    d, theta = np.append(D[1], D) + LATE, np.append(THETA[1], THETA)
    np.savez(tmp_path / "run.npz", frames=counts, d=d, theta=theta)
    (tmp_path / "profile.toml").write_text(
        'tactile = { backend = "simulated", rows = 32, cols = 32, '
        f"pitch = {0.058 / 32}, pascal_per_count = 20.0, full_count = 4095 }}\n"
    )
    words = ["calibrate", "law", str(tmp_path / "left.json"), "--no-plot"]
    words += ["--config", str(tmp_path / "profile.toml"), "--recording", str(tmp_path / "run.npz")]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert told.startswith("law: solid, bonded, frictionless, ν 0.4")
    assert "springs: E = " in told
    assert "E fitted separately at 1.2, 3.2, 4.2 mm: 0.2" in told
    assert "drifts" not in told
    assert "readings of the first presses differ by +10" in told
    assert "the rubber softens" in told
    profile = (
        'tip.physics = "solid", tip.base = "bonded", tip.face = "frictionless", tip.poisson = 0.4'
    )
    assert f"for the profile: {profile}" in told
    found = load_calibration(tmp_path / "left.json")
    assert found.wants["physics"] == "solid"
    assert found.modulus.modulus == pytest.approx(0.25e6, rel=0.05)
    # Curves of an earlier run do not remain if the presses do not determine curves.
    cubic = ((0.0, 0.0, 0.0),) * 3 + ((1.0, 0.0, 0.0),) + ((0.0, 0.0, 0.0),) * 2
    square = ((0.0,) * 4,) * 4
    curves = TipCurves(
        0.02,
        4e-3,
        0.3,
        cubic,
        cubic,
        cubic,
        cubic,
        (0.0, 0.0),
        0.0,
        (0.0,) * 4,
        square,
        0.0,
        0.0,
        6,
    )
    save_calibration(tmp_path / "left.json", found.model_copy(update={"law": curves}))
    assert main(words) == 0
    assert load_calibration(tmp_path / "left.json").law is None
