"""Read, check, write and apply a sensor's calibration file.

Each sensor has one JSON file. If a calibration step has not been run, its entry is null, and the
values come from the settings. `kinematics.calibration` explains the numbers.
"""

from __future__ import annotations

import json
import math
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from softfinger.daemon.errors import TactileError
from softfinger.daemon.own_files import read_file
from softfinger.daemon.profile.fields import Finite, NonNegative, Positive
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.compiled.own_folder import write_whole
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.tip_curves import TipCurves

FloatArray = NDArray[np.float64]
_NAMES: tuple[Literal["left"], Literal["right"]] = ("left", "right")
_STEPS = ("tare", "equilibrate", "curve", "centre", "modulus", "law", "scales")
_FAULTY = 0.2  # minimum range of a working cell, as a fraction of the median range


class CalibrationFileError(TactileError):
    """The calibration file is unusable or belongs to another sensor."""


class _StepModel(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Sensor(_StepModel):
    """Identity of a sensor: its finger, its label or serial number, and its cell grid."""

    finger: Literal["left", "right"]
    label: str
    rows: Annotated[int, Field(ge=1, le=256)]
    cols: Annotated[int, Field(ge=1, le=256)]
    pitch: tuple[Positive, Positive]  # x, y [m]
    full_count: Annotated[int, Field(ge=1, le=65535)]


class TareStep(_StepModel):
    """Zero offset of each cell, and typical standard deviation of the cell noise [counts].

    ``correlation[i][j]`` is the noise correlation between two cells that are i rows and j columns
    apart. ``correlation`` is empty if the noise is not correlated. ``drift`` is the standard
    deviation of the drift that all cells share. The mean of max(reading − zero, 0) is stored as
    ``excess`` [counts].
    """

    date: str
    zero: list[list[Finite]]
    noise: Finite
    frames: int
    correlation: list[list[Finite]] = []
    drift: NonNegative = 0.0
    excess: NonNegative = 0.0


class EquilibrateStep(_StepModel):
    """Gain of each cell, or 0 for a dead cell."""

    date: str
    gain: list[list[Finite]]
    dead: int
    spread: Finite  # relative spread of the cells before the correction
    residual: Finite  # relative spread of the cells after the correction


class CurveStep(_StepModel):
    """Curve p = c_1 x^b + c_2 x² + c_3 x³ [Pa], stored as (b, c_1, c_2, c_3)."""

    date: str
    kind: Literal["power", "cubic"]
    coefficients: tuple[Positive, Finite, Finite, Finite]
    residual: Finite


class CentreStep(_StepModel):
    """Position of the tip centre on the sensor [m], and rotation of the sensor [rad]."""

    date: str
    centre: tuple[Finite, Finite]
    rotation: Finite | None  # null if the rotation was not measured
    scale: Finite = 1.0
    residual: Finite  # change in the centre during the last iteration of the fit [m]
    std: NonNegative = 0.0  # standard deviation of the centre [m]


class ModulusStep(_StepModel):
    """Measured modulus [Pa], or points of a measured stress-strain law."""

    date: str
    modulus: Positive
    strain: list[Finite] = []
    stress: list[Finite] = []
    offset: Finite
    residual: Finite  # relative residual of the fit

    def material(self) -> Material:
        """Return the tip's stress-strain law. Raises ValueError if the points are unsuitable."""
        if self.strain:
            return Material.from_points(self.strain, self.stress)
        return Material.constant(self.modulus)


class ScalesStep(_StepModel):
    """A finger's calibration factors, each stored as (mean, relative standard deviation).

    The factors are measured while the hand grips an object. ``modulus`` is relative to the modulus
    in this file. If the file contains no modulus, ``modulus`` is relative to the settings.
    """

    date: str
    modulus: tuple[Positive, Positive]
    gain: tuple[Positive, Positive]
    torque: tuple[Positive, Positive]


class Calibration(_StepModel):
    """All calibration steps of one sensor. Add a step with ``model_copy(update=…)``.

    ``wants`` maps names of ``[tip]`` settings to the values that `calibrate law` found.
    """

    format: Literal[1] = 1
    sensor: Sensor
    date: str
    tare: TareStep | None = None
    equilibrate: EquilibrateStep | None = None
    curve: CurveStep | None = None
    centre: CentreStep | None = None
    modulus: ModulusStep | None = None
    law: TipCurves | None = None
    scales: ScalesStep | None = None
    wants: dict[Literal["physics", "base", "face", "poisson"], str | float] = {}

    @property
    def identity(self) -> str:
        """Label and date of the calibration; the finger's name replaces a missing label."""
        return f"{self.sensor.label or self.sensor.finger} {self.date}"

    def summary(self) -> str:
        """Return the identity and the completed calibration steps as one line of text."""
        steps = [name for name in _STEPS if getattr(self, name) is not None]
        return f"{self.identity}: {', '.join(steps) or 'no step'}"


def now() -> str:
    """Return the current UTC date and time in ISO 8601 format."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def sensor_of(settings: Settings, finger: int) -> Sensor:
    """Return the identity of a finger's sensor. The USB serial number replaces a missing label."""
    tactile = settings.tactile
    return Sensor(
        finger=_NAMES[finger],
        label=tactile.sensor[finger] or _usb_serial(settings, finger),
        rows=tactile.rows,
        cols=tactile.cols,
        pitch=tactile.pitches,
        full_count=tactile.full_count,
    )


def load_calibration(path: Path) -> Calibration:
    """Read and check a calibration file. Raises CalibrationFileError."""
    try:
        calibration = Calibration.model_validate_json(read_file(path).decode())
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise CalibrationFileError(f"{path}: can't be read: {reason}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise CalibrationFileError(
            f"{path}: not a calibration file for this version: {where}: {first['msg']}"
        ) from None
    wrong = _contradiction(calibration)
    if wrong:
        raise CalibrationFileError(f"{path}: {wrong}")
    return calibration


def calibration_of(sensor: Sensor, path: Path) -> Calibration:
    """Read the calibration file of ``sensor``.

    Raises CalibrationFileError if the file can't be read or belongs to another sensor.
    """
    calibration = load_calibration(path)
    if wrong := _difference(calibration.sensor, sensor):
        raise CalibrationFileError(f"{path}: the calibration belongs to another sensor: {wrong}")
    return calibration


def calibration_for(settings: Settings, finger: int) -> Calibration | None:
    """Return the calibration of a finger's sensor, or None if the settings contain no file name.

    Raises CalibrationFileError as `calibration_of` does.
    """
    name = settings.tactile.calibration[finger]
    return calibration_of(sensor_of(settings, finger), Path(name)) if name else None


def _difference(file: Sensor, there: Sensor) -> str:
    """Describe the differences between two sensors; return "" if the sensors are identical."""
    pairs = [
        ("finger", file.finger, there.finger),
        ("sensor", file.label or "unnamed", there.label or "unnamed"),
        ("grid", f"{file.rows} × {file.cols}", f"{there.rows} × {there.cols}"),
        ("full_count", str(file.full_count), str(there.full_count)),
        ("pitch", _millimetres(file.pitch), _millimetres(there.pitch)),
    ]
    return "; ".join(
        f"{name}: found {theirs}, expected {ours}" for name, theirs, ours in pairs if theirs != ours
    )


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write the file atomically.

    If writing fails, the old file is kept and CalibrationFileError is raised.
    """
    text = json.dumps(calibration.model_dump(mode="json"), ensure_ascii=False) + "\n"
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise CalibrationFileError(f"{path}: can't be written: {error.strerror}") from None


class Converter:
    """Converter from one sensor's counts to pressures [Pa]."""

    def __init__(
        self, calibration: Calibration, pascal_per_count: float, full_count: int | None = None
    ) -> None:
        """Create a converter.

        Parameters
        ----------
        calibration
            Calibration of the sensor.
        pascal_per_count
            Scale factor [Pa per count] to use if no curve has been measured.
        full_count
            Reading of a saturated cell; None selects the value in the calibration.
        """
        sensor = calibration.sensor
        shape = (sensor.rows, sensor.cols)
        tare, gain, curve = calibration.tare, calibration.equilibrate, calibration.curve
        self.zero: FloatArray = np.array(tare.zero) if tare else np.zeros(shape)
        self.gain: FloatArray = np.array(gain.gain) if gain else np.ones(shape)
        self._curve = np.array(curve.coefficients if curve else (1.0, pascal_per_count, 0.0, 0.0))
        self._full = sensor.full_count if full_count is None else full_count
        self.live: NDArray[np.bool_] = self.gain > 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            finite = math.isfinite(self.largest)
        if not finite:
            raise CalibrationFileError(
                f"calibration: the curve {self._curve[1]:g}·x^{self._curve[0]:g} does not give a "
                "finite pressure for a saturated cell"
            )

    def __call__(self, counts: NDArray[np.uint16]) -> FloatArray:
        """Convert counts [rows, cols] to pressures [Pa].

        The argument of the calibration curve is x = max(counts − zero, 0)·gain.
        """
        return self.pressure(np.maximum(counts - self.zero, 0.0) * self.gain)

    def pressure(self, readings: FloatArray) -> FloatArray:
        """Convert readings to pressure [Pa].

        Noise may make readings negative, so the curve is extended to negative readings as an odd
        function.
        """
        exponent, c1, c2, c3 = self._curve.tolist()
        x = np.abs(readings)
        return np.asarray(np.sign(readings) * (c1 * x**exponent + c2 * x**2 + c3 * x**3))

    def _ends(self) -> FloatArray:
        """Return each cell's pressure [Pa] at saturation."""
        return self(np.full(self.zero.shape, self._full, np.uint16))

    @property
    def saturation(self) -> float:
        """Lowest pressure [Pa] at which a live cell saturates; see :func:`least_end`."""
        pressure = self._ends()[self.live]
        return least_end(pressure) if pressure.size else np.inf

    @property
    def largest(self) -> float:
        """Highest pressure [Pa] that any cell can measure."""
        return float(self._ends().max())

    @property
    def quantum(self) -> float:
        """Mean slope of the calibration curve [Pa per count], from zero offset to saturation."""
        counts = np.maximum(self._full - self.zero, 0.0)[self.live]
        return float(self._ends()[self.live].sum() / max(counts.sum(), 1.0))


def least_end(ends: FloatArray) -> float:
    """Return the smallest measuring range of all working cells.

    The range of a cell extends from its zero offset to saturation. Cells that are nearly saturated
    without a load are ignored. Otherwise, the small range of such a cell would make all other cells
    count as saturated.
    """
    return float(ends[ends >= _FAULTY * np.median(ends)].min())


def _contradiction(calibration: Calibration) -> str:
    """Describe the first contradiction between values in the file; return "" if there is none."""
    sensor = calibration.sensor
    tables = {}
    if calibration.tare:
        tables["tare.zero"] = calibration.tare.zero
    if calibration.equilibrate:
        tables["equilibrate.gain"] = calibration.equilibrate.gain
    for name, rows in tables.items():
        if len(rows) != sensor.rows or any(len(row) != sensor.cols for row in rows):
            return f"{name}: expected {sensor.rows} rows of {sensor.cols} numbers"
        if min(min(row) for row in rows) < 0.0:
            return f"{name}: expected numbers ≥ 0"
    rho = calibration.tare.correlation if calibration.tare else []
    if rho and (len({len(row) for row in rho}) > 1 or rho[0][:1] != [1.0]):
        return "tare.correlation: expected rows of equal length whose first number is 1"
    if calibration.equilibrate and not any(map(any, calibration.equilibrate.gain)):
        return "equilibrate.gain: found only dead cells (gain 0), expected at least one live cell"
    if not Converter(calibration.model_copy(update={"curve": None}), 1.0).saturation > 0.0:
        return f"tare.zero: most cells are saturated at {sensor.full_count} counts without a load"
    if calibration.curve:
        converter = Converter(Calibration(sensor=sensor, date="", curve=calibration.curve), 1.0)
        pressures = converter.pressure(np.arange(sensor.full_count + 1.0))
        if not np.isfinite(pressures).all() or (np.diff(pressures) <= 0.0).any():
            return "curve.coefficients: the pressure must increase with the count"
    if calibration.modulus:
        try:
            calibration.modulus.material()
        except ValueError as error:
            return f"modulus: {error}"
    return ""


def _usb_serial(settings: Settings, finger: int) -> str:
    """Return the serial number of a finger's USB adapter, or "" if there is no adapter."""
    tactile = settings.tactile
    if tactile.backend in ("simulated", "replay", "none"):
        return ""
    from serial.tools.list_ports import comports

    target = os.path.realpath(tactile.port[finger])
    for port in comports():
        if os.path.realpath(port.device) == target:
            return port.serial_number or ""
    return ""


def _millimetres(pitch: tuple[float, float]) -> str:
    return f"{pitch[0] * 1e3:.6g} × {pitch[1] * 1e3:.6g} mm"
