"""A zero learnt while running: what cells read over it, at their full end and for subscribers."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger import Fingertip, SensorGrid
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    Converter,
    TareStep,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.perception.finger_model import make_estimator, make_models
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Frame, State

PASCAL_PER_COUNT = 150.0
FULL = 255  # 38 kPa, less than the contact's peak of 46 kPa


def settings(**tactile: object) -> Settings:
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
    """A file of a tare alone, written to ``path``."""
    step = TareStep(date="today", zero=zero.tolist(), noise=1.0, frames=16)
    made = Calibration(sensor=sensor_of(settings(), 0), date="today", tare=step)
    save_calibration(path, made)
    return made


class Bench:
    """One finger's perception and a board whose cells rest at ``base`` counts."""

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
        while self.perception.taring:
            self.feel(np.zeros((44, 44)), base)


@pytest.mark.parametrize("with_file", [False, True], ids=["counts", "calibrated"])
def test_cells_full_over_a_new_zero_are_known_to_be_full(with_file, tmp_path):
    given = settings()
    if with_file:
        calibrated(tmp_path / "left.json", np.zeros((44, 44)))
        given = settings(calibration=(str(tmp_path / "left.json"), ""))
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


def test_a_zero_below_the_calibrations_leaves_the_published_pressure_whole(tmp_path):
    calibrated(tmp_path / "left.json", np.full((44, 44), 40.0))
    bench = Bench(settings(calibration=(str(tmp_path / "left.json"), "")))
    bench.tare(0.0)
    pressure = np.zeros((44, 44))
    pressure[20:24, 20:24] = 1e6
    bench.feel(pressure, 0.0)
    shown = bench.perception.published()
    assert (shown[20:24, 20:24] == 65535).all()


@pytest.mark.parametrize("stuck", [FULL - 5.0, float(FULL)])
def test_a_cell_that_rests_all_but_full_does_not_make_the_others_full(stuck, tmp_path):
    zero = np.full((44, 44), 3.0)
    zero[22, 30] = stuck
    calibration = calibrated(tmp_path / "left.json", zero)
    expected = pytest.approx((FULL - 3.0) * PASCAL_PER_COUNT)
    assert Converter(calibration, PASCAL_PER_COUNT).saturation == expected
    given = settings()
    made = make_estimator(given, make_material(given.material), 0, None, calibration)
    assert made.saturation == expected
