"""The estimator's run time and error a frame, beside what a user would otherwise take.

All of one run, in turns, over the same frames: 44 × 44 cells on 58 mm, d = 4 mm, a tilt of 12°,
0.2 % of the modulus as noise. "kernel" is the compiled entry called by compiled code, "call" the
Python call of the control loop. Errors are RMS over these frames. Then the errors over the whole
envelope against the Cramér-Rao bound, and what frames of other contact models do.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.emulator.encoders import ENCODERS
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.daemon.tactile.decoder import Decoder
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.tactile.glove import GloveDecoder
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.estimator_bounds import (
    LINEAR,
    MODULUS,
    PITCH,
    SIZE,
    TIP,
    BoundRow,
    MismatchRow,
    against_the_bound,
    bound,
    mismatches,
    tilts,
)
from softfinger.tools.benchmarks.estimator_kernels import (
    OUTPUTS,
    run_frames,
    run_moments,
    whole_grid,
)
from softfinger.tools.benchmarks.estimator_rivals import Method, rivals
from softfinger.tools.benchmarks.interleaved import Subject, interleave

FloatArray = NDArray[np.float64]
Truth: TypeAlias = tuple[float, float, float]  # d, tilt_x, tilt_y

_FRAMES = 32
_SLOW_FRAMES = 4  # of methods that take milliseconds
_SHARE = 0.002  # of the modulus
_NOISE = _SHARE * MODULUS
_PASCAL_PER_COUNT = 4.0
_TRUTH: Truth = (0.004, *tilts(math.radians(12.0), 0.7))
_DECODERS: dict[str, type[CobsDecoder | FlexiTacDecoder | GloveDecoder]] = {
    "cobs": CobsDecoder,
    "flexitac": FlexiTacDecoder,
    "glove": GloveDecoder,
}
_CENTRE = (0.31 * PITCH, -0.17 * PITCH)
GRID = SensorGrid(SIZE, SIZE, PITCH, _CENTRE)


@dataclass(frozen=True)
class Effort:
    """How much is measured; the default is the full bench."""

    rounds: int = 25
    frames: int = 1000  # a contact of the sweep against the bound
    slow: bool = True  # least_squares too


@dataclass(frozen=True)
class TimeRow:
    """Time and error of one way from a frame to d and tilt; NaN errors where none is meant."""

    name: str
    median_us: float
    p99_us: float
    d_rms: float  # m
    tilt_rms: float  # rad, both axes
    aim_us: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


@dataclass
class _Case:
    subject: Subject
    error: Callable[[], tuple[float, float]] | None
    aim_us: float | None = None


def measure(effort: Effort | None = None) -> list[Any]:
    """Time rows, bound rows and mismatch rows."""
    effort = effort or Effort()
    random = np.random.default_rng(4)
    clean = GRID.pressure(TIP, LINEAR, *_TRUTH)
    frames = clean + _NOISE * random.standard_normal((_FRAMES, SIZE, SIZE))
    empty = _NOISE * random.standard_normal((_FRAMES, SIZE, SIZE))
    cases = {**_rungs(frames), **_steps(frames, empty), **_elsewhere(random)}
    for framing in _DECODERS:
        cases[f"decode of a {framing} frame: call"] = _decode(framing, _counts(frames))
    outside, missing = rivals(TIP, LINEAR, GRID, _NOISE)
    for name, method in outside.items():
        slow = "least_squares" in name
        if slow and not effort.slow:
            continue
        cases[name] = _outside(method, frames[: _SLOW_FRAMES if slow else _FRAMES])
    times = interleave({name: case.subject for name, case in cases.items()}, effort.rounds)
    rows: list[Any] = []
    for name, case in cases.items():
        d, tilt = case.error() if case.error else (math.nan, math.nan)
        median, p99 = np.percentile(times[name] * 1e-3, [50.0, 99.0])
        rows.append(TimeRow(name, float(median), float(p99), d, tilt, case.aim_us))
    sigma = np.sqrt(np.diag(bound(GRID, LINEAR, _TRUTH, _NOISE, True)))
    rows.append(
        TimeRow("the bound, gain free", math.nan, math.nan, sigma[0], math.hypot(*sigma[1:3]))
    )
    if missing:
        print(f"for more rows: pip install {' '.join(missing)}", file=sys.stderr)
    return [*rows, *against_the_bound(effort.frames), *mismatches()]


def _estimator(**options: Any) -> ContactEstimator:
    return ContactEstimator(TIP, LINEAR, GRID, _NOISE, **options)


def _rms(found: FloatArray, truth: Truth = _TRUTH) -> tuple[float, float]:
    error = np.sqrt(np.mean((found[:, :3] - np.array(truth)) ** 2, axis=0))
    return float(error[0]), math.hypot(*error[1:])


def _kernel(
    estimator: ContactEstimator, frames: FloatArray, cold: bool, truth: Truth = _TRUTH
) -> _Case:
    out = np.zeros((len(frames), OUTPUTS))

    def run(repeat: int) -> None:
        run_frames(estimator, frames, out, cold, repeat)

    return _Case(Subject(run, len(frames)), lambda: _rms(out, truth))


def _rungs(frames: FloatArray) -> dict[str, _Case]:
    """Each rung, from the last estimate and from the frame alone."""
    cases = {}
    for name, options, warm, cold in (
        ("moments", {"method": "moments"}, 1.0, None),
        ("ml, gain free", {}, 15.0, 30.0),
        ("ml, gain known", {"free_gain": False}, 15.0, 30.0),
    ):
        for words, is_cold, aim in (("warm", False, warm), ("cold", True, cold)):
            case = _kernel(_estimator(**options), frames, is_cold)
            case.aim_us = aim
            cases[f"{name}, {words}: kernel"] = case
        estimator = _estimator(**options)
        cases[f"{name}, warm: call"] = _call(estimator, frames)
    return cases


def _call(estimator: ContactEstimator, frames: FloatArray) -> _Case:
    def run(repeat: int) -> None:
        for _ in range(repeat):
            for frame in frames:
                estimator.update(frame)

    def error() -> tuple[float, float]:
        found = []
        for frame in frames:
            e = estimator.update(frame)
            found.append((e.d, e.tilt_x, e.tilt_y))
        return _rms(np.array(found))

    return _Case(Subject(run, len(frames)), error)


def _steps(frames: FloatArray, empty: FloatArray) -> dict[str, _Case]:
    """What is skipped, on and off. Cells off the footprint are in no fit in either case.

    A frame already seen goes with the calls of the rungs, the early stop with their warm kernels.
    """
    cases: dict[str, _Case] = {}

    def add(name: str, case: _Case, error: bool = True, aim: float | None = None) -> None:
        cases[name] = _Case(case.subject, case.error if error else None, aim)

    add("no contact, activity test: kernel", _kernel(_estimator(), empty, False), False, 0.3)
    always = _estimator(peak_level=-1e9, patch_level=-1e9)
    add("no contact, fitted all the same: kernel", _kernel(always, empty, False), False)
    seen = _estimator()

    def again(repeat: int) -> None:
        for _ in range(repeat):
            seen.update(frames[0], seq=1)

    add("frame already seen: call", _Case(Subject(again), None), False)
    normal = (_TRUTH[0], math.sin(_TRUTH[1]), math.sin(_TRUTH[2]))
    for words, boxed in (("of the footprint's box", True), ("of the tip's disc", False)):
        case = _sums(frames, normal, boxed)
        add(f"moments' sums over the rows {words}: kernel", case, False)
    add(
        "no contact, the whole grid looked at: kernel",
        _kernel(whole_grid(_estimator()), empty, False),
        False,
    )
    add(
        "ml, gain free, warm, the whole grid looked at: kernel",
        _kernel(whole_grid(_estimator()), frames, False),
    )
    add(
        "ml, gain free, warm, no early stop: kernel",
        _kernel(_estimator(tolerance=1e-9), frames, False),
    )
    return cases


def _sums(frames: FloatArray, normal: Truth, boxed: bool) -> _Case:
    estimator = _estimator()
    out = np.zeros((len(frames), 1))
    return _Case(
        Subject(lambda n: run_moments(estimator, frames, normal, boxed, out, n), len(frames)), None
    )


def _elsewhere(random: np.random.Generator) -> dict[str, _Case]:
    """The same at the envelope's costliest corner, with Table I's law, and with a blur."""
    cases: dict[str, _Case] = {}
    noise = random.standard_normal((_FRAMES, SIZE, SIZE))

    def add(name: str, truth: Truth, material: Material, grid: SensorGrid, **options: Any) -> None:
        deviation = _SHARE * material.reference_modulus
        frames = grid.pressure(TIP, material, *truth) + deviation * noise
        for words, cold in (("warm", False), ("cold", True)):
            estimator = ContactEstimator(TIP, material, grid, deviation, **options)
            case = _kernel(estimator, frames, cold, truth)
            if grid.blur == 0.0:
                case.aim_us = 1.0 if options.get("method") else 30.0 if cold else 15.0
            if not (cold and options.get("method")):
                cases[f"{name}, {words}: kernel"] = case

    deep = (0.008, *tilts(math.radians(30.0), 0.7))
    measured = Material.table_i()
    add("moments at (8 mm, 30°)", deep, LINEAR, GRID, method="moments")
    add("ml, gain free, at (8 mm, 30°)", deep, LINEAR, GRID)
    add("ml, gain known, at (8 mm, 30°)", deep, LINEAR, GRID, free_gain=False)
    add("ml, gain free, at (8 mm, 30°), Table I's law", deep, measured, GRID)
    for blur in (0.5e-3, 1e-3):
        blurred = replace(GRID, blur=blur)
        add(f"moments, blur {blur * 1e3:g} mm", _TRUTH, LINEAR, blurred, method="moments")
        add(f"ml, gain free, blur {blur * 1e3:g} mm", _TRUTH, LINEAR, blurred)
    return cases


def _counts(frames: FloatArray) -> list[NDArray[np.uint16]]:
    """The frames as a board counts them."""
    return [np.maximum(frame / _PASCAL_PER_COUNT, 0.0).astype(np.uint16) for frame in frames]


def _decode(framing: str, counts: list[NDArray[np.uint16]]) -> _Case:
    """A framing's bytes, as a board sends them, to counts."""
    encode = ENCODERS[framing].encode
    packets = [encode(each, number, 0.01 * number) for number, each in enumerate(counts)]
    decoder: Decoder = _DECODERS[framing](SIZE, SIZE)

    def run(repeat: int) -> None:
        for _ in range(repeat):
            for packet in packets:
                decoder.feed(packet, 0.0)

    return _Case(Subject(run, len(packets)), None, 20.0)


def _outside(method: Method, frames: FloatArray) -> _Case:
    def run(repeat: int) -> None:
        for _ in range(repeat):
            for frame in frames:
                method(frame)

    return _Case(
        Subject(run, len(frames)), lambda: _rms(np.array([method(frame) for frame in frames]))
    )


def table(rows: list[Any]) -> str:
    """All rows as aligned tables."""
    lines = [
        f"estimator, 44 × 44, d = 4 mm, 12°, 0.2 % noise{'':19}{'µs':>10}{'p99':>10}{'aim':>7}"
        f"{'d RMS µm':>11}{'tilt RMS °':>12}"
    ]
    for each in (row for row in rows if isinstance(row, TimeRow)):
        aim = "" if each.aim_us is None else f"≤ {each.aim_us:g}"
        lines.append(
            f"{each.name:65}{_number(each.median_us, 2):>10}{_number(each.p99_us, 2):>10}{aim:>7}"
            f"{_number(each.d_rms * 1e6, 2):>11}{_number(math.degrees(each.tilt_rms), 4):>12}"
        )
    lines += [
        "",
        f"{'RMS error over the Cramér-Rao bound':37}{'contacts':>9}{'d median':>10}{'worst':>8}"
        f"{'tilt median':>13}{'worst':>8}{'aim':>8}{'honest':>8}{'lost':>7}",
    ]
    for bounded in (row for row in rows if isinstance(row, BoundRow)):
        lines.append(
            f"{bounded.name:37}{bounded.contacts:9d}{bounded.d_median:10.3f}{bounded.d_worst:8.3f}"
            f"{bounded.tilt_median:13.3f}{bounded.tilt_worst:8.3f}{f'≤ {bounded.aim:g}':>8}"
            f"{bounded.honest:8.3f}{bounded.lost:7d}"
        )
    lines += [
        "",
        f"{'estimated as linear, no noise':30}{'d mm':>7}{'θ °':>7}{'d off mm':>10}{'θ off °':>9}"
        f"{'gain':>7}{'explained':>11}",
    ]
    for other in (row for row in rows if isinstance(row, MismatchRow)):
        lines.append(
            f"{other.name:30}{other.d * 1e3:7.1f}{math.degrees(other.theta):7.1f}"
            f"{other.d_error * 1e3:10.3f}{math.degrees(other.theta_error):9.2f}{other.gain:7.3f}"
            f"{other.explained:11.5f}{'' if other.valid else '  flagged'}"
        )
    return "\n".join(lines)


def _number(value: float, decimals: int) -> str:
    return "" if math.isnan(value) else f"{value:.{decimals}f}"
