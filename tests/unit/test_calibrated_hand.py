"""Test that each finger uses the tip and the zero offsets in its own calibration file."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger import Fingertip, SensorGrid
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CentreStep,
    Converter,
    ModulusStep,
    TareStep,
    load_calibration,
    now,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.perception.finger_model import make_estimator, make_models, uncertainty
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Frame, State
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.hand.grasp_state import total_tilt

LEFT = 0.25e6  # constant modulus of the left tip [Pa]
STRAIN = [0.0, 0.1, 0.2, 0.4, 0.6]
STRESS = [0.0, 14e3, 31e3, 75e3, 130e3]  # stresses of the right tip's material law [Pa]
TRUE = 0.28e6  # modulus of the simulated tips [Pa]


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


def test_measured_calibration_errors_reach_the_estimator():
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


def test_a_calibrated_law_far_from_its_points_is_refused_by_file_and_key(settings):
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


def test_the_material_of_each_tip_reaches_estimate_table_and_prediction(settings):
    events = []
    with Daemon(settings, wire=False, on_event=lambda *event: events.append(event)) as daemon:
        told = [text for _, kind, text in events if kind == "calibration"]
        assert [text.split(":")[0] for text in told] == ["left", "right"]
        assert all(text.endswith(": modulus") for text in told)
        left, right = daemon.models
        assert left.material.reference_modulus == pytest.approx(LEFT)
        assert not right.material.is_linear
        assert left.prior.modulus == (pytest.approx(1.0), pytest.approx(0.05, rel=0.2))
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
        for model, contact in zip(daemon.models, loop.state.contacts, strict=True):
            assert contact.gain == 1.0
            expected = model.table(contact.d, total_tilt(contact.theta, contact.tilt_y))
            scale = contact.modulus_scale
            assert scale == pytest.approx(1.0, abs=0.1)
            assert contact.force == pytest.approx(scale * expected.force, rel=1e-9)
            assert contact.energy == pytest.approx(scale * expected.energy, rel=1e-9)
        # The simulated tips use the material in the settings.
        d, theta = daemon.hand.d, daemon.hand.theta
        by_truth = math.pi * TRUE * d**2 / np.cos(theta)
        assert np.abs(daemon.hand.force / by_truth - 1.0).max() < 1e-3


PASCAL_PER_COUNT = 150.0
FULL = 255  # full count, which is 38 kPa; the peak pressure is 46 kPa


def counting(**tactile: object) -> Settings:
    made = Settings.model_validate(
        {
            "tactile": {
                "full_count": FULL,
                "pascal_per_count": PASCAL_PER_COUNT,
                "smooth_error": 0.0,
                **tactile,
            },
            "stream": {"tactile_unit": "Pa"},
        }
    )
    assert (made.tactile.rows, made.tactile.cols) == (44, 44)
    return made


def calibrated(path: Path, zero: NDArray[np.float64]) -> Calibration:
    """Write a calibration file that contains only a tare."""
    step = TareStep(date="today", zero=zero.tolist(), noise=1.0, frames=16)
    made = Calibration(sensor=sensor_of(counting(), 0), date="today", tare=step)
    save_calibration(path, made)
    return made


class Bench:
    """Perception of one finger, for frames whose cells read ``base`` counts without contact."""

    def __init__(self, given: Settings) -> None:
        self.sensor = GivenFrames()
        self._hand = Perception(given, {0: self.sensor}, make_models(given))
        (self.perception,) = self._hand.fingers
        self._state = State()
        self.contact = self._state.contacts[0]
        self.noise = np.random.default_rng(3)
        self.given = given
        self.seq = 0

    def feel(self, pressure: NDArray[np.float64], base: float) -> Frame:
        cells = pressure + self.noise.normal(0.0, self.given.tactile.noise, pressure.shape)
        counts = np.clip(np.round(cells / PASCAL_PER_COUNT + base), 0, FULL).astype(np.uint16)
        self.seq += 1
        self.sensor.frame = Frame(self.seq, 0.01 * self.seq, 0.01 * self.seq, True, counts)
        self._state.t = 0.01 * self.seq
        self._hand.update(self._state)
        return self.sensor.frame

    def tare(self, base: float) -> None:
        self.perception.tare()
        for _ in range(100):
            self.feel(np.zeros((44, 44)), base)
            if not self.perception.is_taring:
                return
        raise AssertionError("the tare does not end")


@pytest.mark.parametrize("with_file", [False, True], ids=["counts", "calibrated"])
def test_saturated_cells_are_detected_after_a_new_zero_offset(with_file, tmp_path):
    given = counting()
    if with_file:
        calibrated(tmp_path / "left.json", np.zeros((44, 44)))
        given = counting(calibration=(str(tmp_path / "left.json"), ""))
    grid = SensorGrid(rows=44, cols=44, pitch=0.058 / 44)
    pressure = grid.pressure(Fingertip(0.020), make_material(given.material), 0.006, 0.2)
    bench = Bench(given)
    for base in (0.0, 10.0, 30.0, 0.0):
        bench.tare(base)
        for _ in range(3):
            frame = bench.feel(pressure, base)
        assert np.count_nonzero(frame.data == FULL) > 50
        contact = bench.contact
        assert contact.valid
        assert not contact.misfit
        assert abs(contact.d - 0.006) < 5.0 * contact.d_std < 2e-4


def test_a_zero_offset_below_the_calibrated_one_does_not_clip_the_pressure(tmp_path):
    calibrated(tmp_path / "left.json", np.full((44, 44), 40.0))
    bench = Bench(counting(calibration=(str(tmp_path / "left.json"), "")))
    bench.tare(0.0)
    pressure = np.zeros((44, 44))
    pressure[20:24, 20:24] = 1e6
    bench.feel(pressure, 0.0)
    shown = bench.perception.published()
    assert (shown[20:24, 20:24] == 65535).all()


@pytest.mark.parametrize("stuck", [FULL - 5.0, float(FULL)])
def test_a_cell_with_a_large_zero_offset_does_not_saturate_the_others(stuck, tmp_path):
    zero = np.full((44, 44), 3.0)
    zero[22, 30] = stuck
    calibration = calibrated(tmp_path / "left.json", zero)
    expected = pytest.approx((FULL - 3.0) * PASCAL_PER_COUNT)
    assert Converter(calibration, PASCAL_PER_COUNT).saturation == expected
    given = counting()
    made = make_estimator(given, make_material(given.material), 0, None, calibration)
    assert made.saturation == expected


def test_a_tare_reduces_the_noise_of_the_zero_offsets_to_a_quarter(tmp_path):
    calibrated(tmp_path / "left.json", np.zeros((44, 44)))
    given = counting(calibration=(str(tmp_path / "left.json"), ""), noise=6.0 * PASCAL_PER_COUNT)
    bench = Bench(given)
    bench.tare(60.0)
    zero = bench.perception._converter.zero
    assert zero.mean() == pytest.approx(60.0, abs=0.2)
    assert zero.std() == pytest.approx(6.0 / 4.0, rel=0.2)
