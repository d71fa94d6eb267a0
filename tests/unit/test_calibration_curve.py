"""A calibration's curve that makes no numbers of its counts is refused where it is read."""

from __future__ import annotations

import warnings

import pytest

from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CalibrationFileError,
    Converter,
    CurveStep,
    Sensor,
)


def calibration(exponent: float) -> Calibration:
    sensor = Sensor(finger="left", label="", rows=4, cols=5, pitch=(1e-3, 1e-3), full_count=65535)
    curve = CurveStep(
        date="2026-01-01",
        kind="power",
        coefficients=(exponent, 2.0, 0.0, 0.0),
        residual=0.0,
    )
    return Calibration(sensor=sensor, date="2026-01-01", curve=curve)


def test_a_power_beyond_all_numbers_is_refused_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(CalibrationFileError, match=r"2·x\^100 has no number of Pa"):
            Converter(calibration(100.0), 4.0)
        assert Converter(calibration(1.2), 4.0).largest > 0.0
