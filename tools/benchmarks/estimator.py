"""The estimator's run time and error a frame, beside what a user would otherwise take.

All of one run, in turns, over the same frames: 44 × 44 cells on 58 mm, d = 4 mm, a tilt of 12°,
0.2 % of the modulus as noise. "kernel" is the compiled entry called by compiled code, "call" the
Python call of the control loop. Errors are RMS over these frames. Then the errors over the envelope
against the Cramér-Rao bound, in the short form of `bench campaign accuracy`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.daemon.tactile.decoder import Decoder
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.tactile.glove import GloveDecoder
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.estimation.frame_pipeline import estimate_frame
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import EstimatorState
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.campaigns import accuracy_envelope
from softfinger.tools.benchmarks.campaigns.accuracy_trials import (
    LINEAR,
    MODULUS,
    SIZE,
    TIP,
    Place,
    bound,
    jacobian,
    tilts,
)
from softfinger.tools.benchmarks.estimator_rivals import rivals
from softfinger.tools.benchmarks.framework.interleaved import Subject, interleave
from softfinger.tools.benchmarks.framework.report import Report, figure

FloatArray = NDArray[np.float64]
Truth: TypeAlias = tuple[float, float, float]  # d [m], tilt_x, tilt_y [rad]

TITLE = "estimator, 44 × 44 cells, 4 mm, 12°"
D_ERROR, TILT_ERROR = "d RMS µm", "tilt RMS °"
PAGE = {
    TITLE: (
        *("moments: warm", "ml, gain free: warm", "no contact: activity", "decode: cobs"),
        *("NumPy", "SciPy", "OpenCV", "scikit"),
    )
}
_FRAMES = 32
_SHARE = 0.002  # of the modulus
_NOISE = _SHARE * MODULUS
_PASCAL_PER_COUNT = 4.0
_PLACE = Place(0.004, math.radians(12.0), 0.7, (0.31, -0.17))
_TRUTH: Truth = _PLACE.truth[:3]
GRID = _PLACE.grid
_DECODERS: dict[str, Callable[[int, int], Decoder]] = {
    "cobs": CobsDecoder,
    "flexitac": FlexiTacDecoder,
    "glove": GloveDecoder,
}


@dataclass
class _Timed:
    subject: Subject
    found: Callable[[], FloatArray] | None = None  # estimates [n, 3]
    aim_us: float | None = None
    truth: Truth = _TRUTH


def measure(brief: bool = False, rounds: int = 25, frames: int = 500) -> list[Report]:
    """Times with errors; unless ``brief`` the errors over the envelope, ``frames`` a contact."""
    random = np.random.default_rng(4)
    noise = random.standard_normal((_FRAMES, SIZE, SIZE))
    pressed = GRID.pressure(TIP, LINEAR, *_TRUTH) + _NOISE * noise
    cases = {**_methods(pressed), **_steps(pressed, _NOISE * noise)}
    if not brief:
        cases |= _elsewhere(noise)
    for framing in ("cobs",) if brief else _DECODERS:
        cases[f"decode: {framing} frame, call"] = _decode(framing, pressed)
    cases |= _rivals(pressed, brief)
    subjects = {name: case.subject for name, case in cases.items()}
    times = interleave(subjects, 10 if brief else rounds)
    rows = [
        figure(name, "µs", 1e-3 * times[name], case.aim_us) | _errors(case)
        for name, case in cases.items()
    ]
    sigma = np.sqrt(np.diag(bound(jacobian(_PLACE), _NOISE, True)))
    limit = {D_ERROR: 1e6 * float(sigma[0]), TILT_ERROR: math.degrees(math.hypot(*sigma[1:3]))}
    rows.append({"name": "Cramér-Rao bound, gain free"} | limit)
    tables = [Report(TITLE, rows, D_ERROR)]
    if brief:
        return tables
    sweep = accuracy_envelope.Sweep(1, frames, 3, 4 * frames, degrees=(0.0, 10.0, 20.0, 30.0))
    return tables + accuracy_envelope.against_the_bound(sweep)


def _errors(case: _Timed) -> dict[str, float]:
    if case.found is None:
        return {}
    off = case.found()[:, :3] - np.array(case.truth)
    rms = np.sqrt(np.mean(off**2, axis=0))
    return {D_ERROR: 1e6 * float(rms[0]), TILT_ERROR: math.degrees(math.hypot(*rms[1:]))}


def _estimator(**options: Any) -> ContactEstimator:
    return ContactEstimator(TIP, LINEAR, GRID, _NOISE, **options)


@kernel
def _loop(
    repeat: int,
    frames: FloatArray,
    cold: bool,
    states: Records[EstimatorState],
    arena: FloatArray,
    places: NDArray[np.int64] | None,
    solids: Records[SolidFit] | None,
    out: FloatArray,
) -> None:
    estimate = states[0].estimate
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            if cold:
                estimate.warm = False
            estimate_frame(states, frames[k], 1.0, 0.0, arena, places, solids)
            out[k, 0] = estimate.d
            out[k, 1] = estimate.tilt_x
            out[k, 2] = estimate.tilt_y


def _kernel(estimator: ContactEstimator, frames: FloatArray, cold: bool = False) -> _Timed:
    """The compiled entry, from the last estimate or from each frame alone."""
    out = np.zeros((len(frames), 3))

    def run(repeat: int) -> None:
        _loop(repeat, frames, cold, estimator.state.array, *estimator.arena, out)

    return _Timed(Subject(run, len(frames)), lambda: out)


def _methods(frames: FloatArray) -> dict[str, _Timed]:
    """Each method, from the last estimate and from the frame alone."""
    cases = {}
    for name, options, warm, cold in (
        ("moments", {"method": "moments"}, 1.0, None),
        ("ml, gain free", {}, 15.0, 30.0),
        ("ml, gain known", {"free_gain": False}, 15.0, 30.0),
    ):
        for words, is_cold, aim in (("warm", False, warm), ("cold", True, cold)):
            case = _kernel(_estimator(**options), frames, is_cold)
            cases[f"{name}: {words}, kernel"] = replace(case, aim_us=aim)
        cases[f"{name}: warm, call"] = _call(_estimator(**options), frames)
    return cases


def _call(estimator: ContactEstimator, frames: FloatArray) -> _Timed:
    def run(repeat: int) -> None:
        for _ in range(repeat):
            for frame in frames:
                estimator.update(frame)

    def found() -> FloatArray:
        estimates = (estimator.update(frame) for frame in frames)
        return np.array([(e.d, e.tilt_x, e.tilt_y) for e in estimates])

    return _Timed(Subject(run, len(frames)), found)


def _steps(frames: FloatArray, empty: FloatArray) -> dict[str, _Timed]:
    """What is skipped, on and off."""
    always, exact = _estimator(), _estimator()
    always.state.options.peak_level = always.state.options.patch_level = -1e9
    exact.state.options.tolerance = 1e-9
    seen = _estimator()

    def again(repeat: int) -> None:
        for _ in range(repeat):
            seen.update(frames[0], seq=1)

    return {
        "no contact: activity test, kernel": replace(
            _kernel(_estimator(), empty), found=None, aim_us=0.3
        ),
        "no contact: fitted all the same, kernel": replace(_kernel(always, empty), found=None),
        "frame already seen: call": _Timed(Subject(again)),
        "ml, gain free: warm, no early stop, kernel": _kernel(exact, frames),
    }


def _elsewhere(noise: FloatArray) -> dict[str, _Timed]:
    """The same at the envelope's costliest corner, with Table I's law, and with a blur."""
    cases: dict[str, _Timed] = {}

    def add(name: str, truth: Truth, material: Material, grid: SensorGrid, **options: Any) -> None:
        deviation = _SHARE * material.reference_modulus
        frames = grid.pressure(TIP, material, *truth) + deviation * noise
        moments = "method" in options
        for words, cold in (("warm", False),) if moments else (("warm", False), ("cold", True)):
            estimator = ContactEstimator(TIP, material, grid, deviation, **options)
            aim = None if grid.blur else 1.0 if moments else 30.0 if cold else 15.0
            case = replace(_kernel(estimator, frames, cold), aim_us=aim, truth=truth)
            cases[f"{name}: {words}, kernel"] = case

    deep = (0.008, *tilts(math.radians(30.0), 0.7))
    add("moments at (8 mm, 30°)", deep, LINEAR, GRID, method="moments")
    add("ml, gain free, at (8 mm, 30°)", deep, LINEAR, GRID)
    add("ml, gain known, at (8 mm, 30°)", deep, LINEAR, GRID, free_gain=False)
    add("ml, gain free, at (8 mm, 30°), Table I's law", deep, Material.table_i(), GRID)
    for blur in (0.5e-3, 1e-3):
        blurred = replace(GRID, blur=blur)
        add(f"moments, blur {blur * 1e3:g} mm", _TRUTH, LINEAR, blurred, method="moments")
        add(f"ml, gain free, blur {blur * 1e3:g} mm", _TRUTH, LINEAR, blurred)
    return cases


def _decode(framing: str, frames: FloatArray) -> _Timed:
    """A framing's bytes, as a board sends them, to counts."""
    encode = ENCODERS[framing].encode
    counts = np.maximum(frames / _PASCAL_PER_COUNT, 0.0).astype(np.uint16)
    packets = [encode(each, number, 0.01 * number) for number, each in enumerate(counts)]
    decoder = _DECODERS[framing](SIZE, SIZE)

    def run(repeat: int) -> None:
        for _ in range(repeat):
            for packet in packets:
                decoder.feed(packet, 0.0)

    return _Timed(Subject(run, len(packets)), aim_us=20.0)


def _rivals(frames: FloatArray, brief: bool) -> dict[str, _Timed]:
    cases = {}
    methods, missing = rivals(TIP, LINEAR, GRID, _NOISE)
    if missing:
        print(f"for more rows: pip install {' '.join(missing)}", file=sys.stderr)
    for name, method in methods.items():
        slow = "least_squares" in name  # milliseconds a frame
        if slow and brief:
            continue
        chosen = frames[:4] if slow else frames

        def found(method: Any = method, chosen: FloatArray = chosen) -> FloatArray:
            return np.array([method(frame) for frame in chosen])

        def run(repeat: int, found: Callable[[], FloatArray] = found) -> None:
            for _ in range(repeat):
                found()

        cases[name] = _Timed(Subject(run, len(chosen)), found)
    return cases
