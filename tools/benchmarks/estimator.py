"""The estimator's run time and error a frame, beside the Cramér-Rao bound.

All of one run, in turns, over the same frames: 44 × 44 cells on 58 mm, d = 4 mm, a tilt of 15°,
0.2 % of the modulus as noise. "kernel" is the compiled entry called by compiled code, "call" the
Python call of the control loop. Errors are RMS over these frames; "sensor" rows have those of a
profile's own cells, pressed so for a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS
from softfinger.daemon.simulation.sensor.simulated_tactile import make_sensor_model
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.estimation.frame_pipeline import estimate_frame
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import EstimatorState
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.measuring import Report, Subject, each, figure, interleave
from softfinger.tools.benchmarks.rigs import SENSORS

FloatArray = NDArray[np.float64]
Truth: TypeAlias = tuple[float, float, float]  # d [m], tilt_x, tilt_y [rad]

ERROR = "RMS of d [µm]"
TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LINEAR = Material.constant(MODULUS)
SIZE, WIDTH = 44, 0.058  # cells a side, m
NOISE = 0.002 * MODULUS
_PASCAL_PER_COUNT = 4.0
_FRAMES = 32
_STEPS = (1e-7, 1e-5, 1e-5, 1e-4)


@dataclass
class Timed:
    """A function to time, and the array for what it finds in the frames [n, 3]."""

    subject: Subject
    aim_us: float | None = None
    found: FloatArray | None = None
    truth: Truth = (0.0, 0.0, 0.0)

    @property
    def errors(self) -> dict[str, float]:
        """RMS of d and of the tilts."""
        return {} if self.found is None else _errors(self.found, self.truth)


def _errors(found: FloatArray, truth: Truth) -> dict[str, float]:
    rms = np.sqrt(np.mean((found - np.array(truth)) ** 2, axis=0))
    return {ERROR: 1e6 * float(rms[0]), "of tilts [°]": math.degrees(math.hypot(*rms[1:]))}


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """Return (tilt_x, tilt_y) of a total tilt towards ``azimuth`` [rad]."""
    s = math.sin(theta)
    return math.asin(s * math.cos(azimuth)), math.asin(s * math.sin(azimuth))


GRID = SensorGrid(SIZE, SIZE, WIDTH / SIZE, (0.31 * WIDTH / SIZE, -0.17 * WIDTH / SIZE))
TRUTH: Truth = (0.004, *tilts(math.radians(15.0), 0.7))
_CORNER: Truth = (0.008, *tilts(math.radians(30.0), 0.7))


def measure(brief: bool = False, rounds: int = 25) -> list[Report]:
    """Return times with errors, and the bound."""
    noise = np.random.default_rng(4).standard_normal((_FRAMES, SIZE, SIZE))
    frames = GRID.pressure(TIP, LINEAR, *TRUTH) + NOISE * noise
    empty, deep = NOISE * noise, GRID.pressure(TIP, LINEAR, *_CORNER) + NOISE * noise
    call = ContactEstimator(TIP, LINEAR, GRID, NOISE).update
    cases = {
        "moments: warm, kernel": kernel_case(frames, TRUTH, 1.0, method="moments"),
        "ml: warm, kernel": kernel_case(frames, TRUTH, 15.0),
        "ml: cold, kernel": kernel_case(frames, TRUTH, 30.0, cold=True),
        "ml: warm, call": Timed(each(call, [(frame,) for frame in frames])),
        "ml: at (8 mm, 30°), warm, kernel": kernel_case(deep, _CORNER, 15.0),
        "no contact: kernel": replace(kernel_case(empty, TRUTH, 0.3), found=None),
        "decode: cobs": Timed(decode(frames), aim_us=10.0),
    }
    times = interleave(
        {name: case.subject for name, case in cases.items()}, 10 if brief else rounds
    )
    rows = [
        figure(name, "µs", 1e-3 * times[name], case.aim_us, **case.errors)
        for name, case in cases.items()
    ]
    sigma = np.sqrt(np.diag(bound(jacobian(GRID, (*TRUTH, 1.0)), NOISE)))
    rows.append({"name": "Cramér-Rao bound", ERROR: 1e6 * float(sigma[0])})
    for sensor, flaws in {"ideal": {}, **SENSORS}.items():
        errors = _errors_of(Settings.model_validate(flaws))
        rows.append({"name": f"ml: sensor {sensor}", **errors})
    return [Report("frame to contact", rows, ERROR)]


def _errors_of(settings: Settings) -> dict[str, float]:
    """Errors on the frames of a profile's sensor."""
    model = make_sensor_model(settings, 0)
    estimator = make_estimator(settings, make_material(settings.material))
    counts = np.zeros(model.grid.shape, np.uint16)
    found = []
    for k in range(round(settings.tactile.rate) + _FRAMES):
        model.frame(*TRUTH, counts, k / settings.tactile.rate)
        estimate = estimator.update(counts, settings.tactile.pascal_per_count)
        found.append((estimate.d, estimate.tilt_x, estimate.tilt_y))
    return _errors(np.array(found[-_FRAMES:]), TRUTH)


def jacobian(grid: SensorGrid, truth: tuple[float, float, float, float]) -> FloatArray:
    """Return ∂ pressure/∂(d, tilt_x, tilt_y, gain) [cells, 4], by central differences."""
    columns = []
    for k, step in enumerate(_STEPS):
        ends = []
        for sign in (1.0, -1.0):
            at = list(truth)
            at[k] += sign * step
            ends.append(grid.pressure(TIP, LINEAR, at[0], at[1], at[2], at[3]))
        columns.append(((ends[0] - ends[1]) / (2.0 * step)).ravel())
    return np.stack(columns, axis=1)


def bound(slopes: FloatArray, noise: float, free: bool = True) -> FloatArray:
    """Return the Cramér-Rao covariance of (d, tilt_x, tilt_y[, gain]) from all cells."""
    used = slopes[:, : 4 if free else 3]
    return np.asarray(np.linalg.inv(used.T @ used) * noise**2)


@kernel
def _loop(
    repeat: int,
    frames: FloatArray,
    cold: bool,
    states: Records[EstimatorState],
    scratch: FloatArray,
    places: NDArray[np.int64] | None,
    solids: Records[SolidFit] | None,
    out: FloatArray,
) -> None:
    estimate = states[0].estimate
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            if cold:
                estimate.warm = False
            estimate_frame(states, frames[k], 1.0, 0.0, scratch, places, solids)
            out[k, 0] = estimate.d
            out[k, 1] = estimate.tilt_x
            out[k, 2] = estimate.tilt_y


def kernel_case(
    frames: FloatArray,
    truth: Truth,
    aim_us: float | None = None,
    cold: bool = False,
    grid: SensorGrid = GRID,
    **options: Any,
) -> Timed:
    """Return the compiled entry, from the last estimate or from each frame alone."""
    estimator = ContactEstimator(TIP, LINEAR, grid, NOISE, **options)
    out = np.zeros((len(frames), 3))

    def run(repeat: int) -> None:
        _loop(repeat, frames, cold, estimator.state.array, *estimator.scratch, out)

    return Timed(Subject(run, len(frames)), aim_us, out, truth)


def decode(frames: FloatArray) -> Subject:
    """Return a cobs board's bytes to counts."""
    counts = np.maximum(frames / _PASCAL_PER_COUNT, 0.0).astype(np.uint16)
    packets = [ENCODERS["cobs"].encode(frame, k, 0.01 * k) for k, frame in enumerate(counts)]
    return each(CobsDecoder(*frames.shape[1:]).feed, [(packet, 0.0) for packet in packets])
