"""Two tips that were calibrated to different materials: each finger's forces are by its own."""

import math
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CentreStep,
    ModulusStep,
    TareStep,
    load_calibration,
    now,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.perception.finger_model import make_models, uncertainty
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.hand.grasp_state import total_tilt

LEFT = 0.25e6  # Pa, a constant modulus
STRAIN = [0.0, 0.1, 0.2, 0.4, 0.6]
STRESS = [0.0, 14e3, 31e3, 75e3, 130e3]  # Pa, the right tip's law
TRUE = 0.28e6  # Pa, the simulated tips'


@pytest.fixture
def settings(tmp_path):
    base = Settings.model_validate(
        {
            "loop": {"clock": "virtual"},
            "material": {"law": "constant", "modulus": TRUE},
            "estimator": {"free_gain": False},
            "simulation": {"tactile_noise": 300.0},
            "tactile": {"noise": 300.0},
        }
    )
    files = []
    for finger, points in ((0, {}), (1, {"strain": STRAIN, "stress": STRESS})):
        step = ModulusStep(date=now(), modulus=LEFT, offset=0.0, residual=0.0, **points)
        sensor = sensor_of(base, finger)
        files.append(str(tmp_path / f"{sensor.finger}.json"))
        save_calibration(
            tmp_path / f"{sensor.finger}.json",
            Calibration(sensor=sensor, date=now(), modulus=step),
        )
    raw = base.model_dump()
    raw["tactile"]["calibration"] = tuple(files)
    return Settings.model_validate(raw)


def test_what_a_calibration_measured_of_its_errors_reaches_the_estimator():
    settings = Settings.model_validate({"tactile": {"baseline_error": 300.0, "pitch_error": 0.01}})
    zero = np.zeros((settings.tactile.rows, settings.tactile.cols)).tolist()
    calibration = Calibration(
        sensor=sensor_of(settings, 0),
        date=now(),
        tare=TareStep(
            date=now(), zero=zero, noise=1.0, frames=64, correlation=[[1.0, 0.5]], drift=100.0
        ),
        centre=CentreStep(
            date=now(), centre=(0.0, 0.0), rotation=0.0, scale=1.02, residual=0.0, std=1e-4
        ),
    )
    known = uncertainty(settings, calibration)
    assert known.baseline == pytest.approx(math.hypot(300.0, 100.0 * 4.0))
    assert (known.centre, known.pitch, known.modulus) == (1e-4, pytest.approx(0.02), 0.0)
    np.testing.assert_array_equal(known.correlation, [[1.0, 0.5]])
    assert uncertainty(Settings(), None) == Uncertainty(gain=0.25, smooth=0.035)


def test_a_calibrated_law_too_far_off_its_points_is_refused_by_file_and_key(settings):
    path = Path(settings.tactile.calibration[1])
    strain = np.linspace(0.05, 1.0, 20)
    kinked = 1e5 * np.where(strain < 0.3, strain, 3.0 * strain - 0.6)
    step = ModulusStep(
        date=now(),
        modulus=LEFT,
        offset=0.0,
        residual=0.0,
        strain=strain.tolist(),
        stress=kinked.tolist(),
    )
    save_calibration(path, load_calibration(path).model_copy(update={"modulus": step}))
    with pytest.raises(SettingsError, match=r"right\.json: modulus: .*material\.force_error_max"):
        make_models(settings)


def test_each_tips_material_reaches_estimate_table_and_prediction(settings):
    events = []
    with Daemon(settings, wire=False, on_event=lambda *event: events.append(event)) as daemon:
        told = [text for _, kind, text in events if kind == "calibration"]
        assert [text.split(":")[0] for text in told] == ["left", "right"]
        assert all(text.endswith(": modulus") for text in told)
        left, right = daemon.models
        assert left.material.reference_modulus == pytest.approx(LEFT)
        assert not right.material.is_linear
        loop = daemon.loop
        loop.advance(0.3)
        loop.command({"command": "arm"})
        loop.advance(0.1)
        loop.command({"command": "grasp", "force": 6.0})
        for _ in range(300):
            if loop.state.mode == "holding":
                break
            loop.advance(0.01)
        assert loop.state.mode == "holding"
        loop.advance(0.2)
        scales = loop.perception.filter.grasp.scales
        for model, contact in zip(daemon.models, loop.state.contacts, strict=True):
            assert contact.gain == 1.0
            expected = model.table(contact.d, total_tilt(contact.theta, contact.tilt_y))
            scale = scales.modulus[model.finger]
            assert scale == pytest.approx(1.0, abs=0.1)
            assert contact.force == pytest.approx(scale * expected.force, rel=1e-9)
            assert contact.energy == pytest.approx(scale * expected.energy, rel=1e-9)
        # The simulated tips stay the settings' own.
        d, theta = daemon.hand.d, daemon.hand.theta
        by_truth = math.pi * TRUE * d**2 / np.cos(theta)
        assert np.abs(daemon.hand.force / by_truth - 1.0).max() < 1e-3
