"""The estimator's run time and error a frame, beside what a user would otherwise take.

All of one run, in turns, over the same frames: 44 × 44 cells on 58 mm, d = 4 mm, a tilt of 15°,
0.2 % of the modulus as noise. "kernel" is the compiled entry called by compiled code, "call" the
Python call of the control loop. Errors are RMS over these frames, beside the Cramér-Rao bound.
"alone" is a part of the row before, which bounds it: the sums and the contact that they make,
without the one step of the likelihood that judges them; reading the cells; unstuffing and CRC.

The other packages keep what is above three times the noise, and turn the moments that they give
into d and the tilts by the model's own closed forms.
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
from softfinger.daemon.tactile.cobs import CobsDecoder, crc16, unstuff
from softfinger.daemon.tactile.decoder import Decoder
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.tactile.glove import GloveDecoder
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.compiled.simd import address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import totals
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.estimation.frame_pipeline import estimate_frame
from softfinger.kinematics.estimation.moments import refine
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import EstimatorState
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.measuring import Report, Subject, each, figure, interleave

FloatArray = NDArray[np.float64]
Truth: TypeAlias = tuple[float, float, float]  # d [m], tilt_x, tilt_y [rad]
Method = Callable[[FloatArray], Truth]
Moments = Callable[[FloatArray], tuple[float, float, float, float]]

ERROR = "RMS of d [µm]"
TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LINEAR = Material.constant(MODULUS)
SIZE, WIDTH = 44, 0.058  # cells a side, m
NOISE = 0.002 * MODULUS
_PASCAL_PER_COUNT = 4.0
_FRAMES = 32
_DECODERS: dict[str, Callable[[int, int], Decoder]] = {
    "cobs": CobsDecoder,
    "flexitac": FlexiTacDecoder,
    "glove": GloveDecoder,
}
_STEPS = (1e-7, 1e-5, 1e-5, 1e-4)


@dataclass
class Timed:
    """A way to estimate: what is timed, and what it finds in the frames [n, 3]."""

    subject: Subject
    found: Callable[[], FloatArray] | None = None
    aim_us: float | None = None
    truth: Truth = (0.0, 0.0, 0.0)

    @property
    def errors(self) -> dict[str, float]:
        """RMS of d and of the tilts."""
        if self.found is None:
            return {}
        rms = np.sqrt(np.mean((self.found()[:, :3] - np.array(self.truth)) ** 2, axis=0))
        return {ERROR: 1e6 * float(rms[0]), "of tilts [°]": math.degrees(math.hypot(*rms[1:]))}


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """(tilt_x, tilt_y) of a total tilt towards ``azimuth`` [rad]."""
    s = math.sin(theta)
    return math.asin(s * math.cos(azimuth)), math.asin(s * math.sin(azimuth))


GRID = SensorGrid(SIZE, SIZE, WIDTH / SIZE, (0.31 * WIDTH / SIZE, -0.17 * WIDTH / SIZE))
TRUTH: Truth = (0.004, *tilts(math.radians(15.0), 0.7))
_CORNER: Truth = (0.008, *tilts(math.radians(30.0), 0.7))


def measure(brief: bool = False, rounds: int = 25) -> list[Report]:
    """Times with errors, and the bound."""
    noise = np.random.default_rng(4).standard_normal((_FRAMES, SIZE, SIZE))
    frames = GRID.pressure(TIP, LINEAR, *TRUTH) + NOISE * noise
    empty, deep = NOISE * noise, GRID.pressure(TIP, LINEAR, *_CORNER) + NOISE * noise
    cases = {
        "moments: warm, kernel": kernel_case(frames, TRUTH, 1.0, method="moments"),
        "moments: alone": _part(_moments_alone, frames, 1.0),
        "ml: warm, kernel": kernel_case(frames, TRUTH, 15.0),
        "ml: cold, kernel": kernel_case(frames, TRUTH, 30.0, cold=True),
        "ml: warm, call": _calls(ContactEstimator(TIP, LINEAR, GRID, NOISE).update, frames),
        "ml: at (8 mm, 30°), warm, kernel": kernel_case(deep, _CORNER, 15.0),
        "no contact: kernel": replace(kernel_case(empty, TRUTH, 0.3), found=None),
        "no contact: reading alone": _part(_reading_alone, empty),
    }
    if not brief:
        cases |= {
            "ml, gain known: warm, kernel": kernel_case(frames, TRUTH, 15.0, free_gain=False),
            "ml: at (8 mm, 30°), cold, kernel": kernel_case(deep, _CORNER, 30.0, cold=True),
        }
    cases["decode: cobs"] = Timed(decode("cobs", frames), aim_us=10.0)
    cases["decode: cobs, kernels alone"] = Timed(_cobs_alone(frames))
    for framing in ("flexitac", "glove"):
        cases[f"decode: {framing}"] = Timed(decode(framing, frames), aim_us=10.0)
    cases |= {name: _calls(method, frames) for name, method in _rivals().items()}
    times = interleave(
        {name: case.subject for name, case in cases.items()}, 10 if brief else rounds
    )
    rows = [
        figure(name, "µs", 1e-3 * times[name], case.aim_us, **case.errors)
        for name, case in cases.items()
    ]
    sigma = np.sqrt(np.diag(bound(jacobian(GRID, (*TRUTH, 1.0)), NOISE)))
    rows.append({"name": "Cramér-Rao bound", ERROR: 1e6 * float(sigma[0])})
    page = ("moments", "ml", "no contact", "decode: cobs")
    others = ("NumPy", "SciPy", "OpenCV", "scikit")
    return [Report("frame to contact", rows, ERROR, (*page, *others))]


def jacobian(grid: SensorGrid, truth: tuple[float, float, float, float]) -> FloatArray:
    """∂ pressure/∂(d, tilt_x, tilt_y, gain) [cells, 4], by central differences."""
    columns = []
    for k, step in enumerate(_STEPS):
        ends = []
        for sign in (1.0, -1.0):
            at = list(truth)
            at[k] += sign * step
            ends.append(grid.pressure(TIP, LINEAR, at[0], at[1], at[2], at[3]))
        columns.append(((ends[0] - ends[1]) / (2.0 * step)).ravel())
    return np.stack(columns, axis=1)


def bound(
    slopes: FloatArray, noise: float, free: bool = True, live: NDArray[np.bool_] | None = None
) -> FloatArray:
    """The Cramér-Rao covariance of (d, tilt_x, tilt_y[, gain]) from the ``live`` cells."""
    used = slopes if live is None else slopes[live.ravel()]
    used = used[:, : 4 if free else 3]
    return np.asarray(np.linalg.inv(used.T @ used) * noise**2)


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


def kernel_case(
    frames: FloatArray,
    truth: Truth,
    aim_us: float | None = None,
    cold: bool = False,
    grid: SensorGrid = GRID,
    **options: Any,
) -> Timed:
    """The compiled entry, from the last estimate or from each frame alone."""
    estimator = ContactEstimator(TIP, LINEAR, grid, NOISE, **options)
    out = np.zeros((len(frames), 3))

    def run(repeat: int) -> None:
        _loop(repeat, frames, cold, estimator.state.array, *estimator.arena, out)

    return Timed(Subject(run, len(frames)), lambda: out, aim_us, truth)


def _calls(method: Callable[[FloatArray], Any], frames: FloatArray) -> Timed:
    """Calls from Python, of an estimator or of another's way."""

    def answer(frame: FloatArray) -> Truth:
        e = method(frame)
        return e if isinstance(e, tuple) else (e.d, e.tilt_x, e.tilt_y)

    def found() -> FloatArray:
        return np.array([answer(frame) for frame in frames])

    return Timed(each(method, [(frame,) for frame in frames]), found, truth=TRUTH)


def decode(framing: str, frames: FloatArray) -> Subject:
    """A framing's bytes, as a board sends them, to counts."""
    packets = [(each, 0.0) for each in _packets(framing, frames)]
    return each(_DECODERS[framing](*frames.shape[1:]).feed, packets)


def _packets(framing: str, frames: FloatArray) -> list[bytes]:
    counts = np.maximum(frames / _PASCAL_PER_COUNT, 0.0).astype(np.uint16)
    return [ENCODERS[framing].encode(frame, k, 0.01 * k) for k, frame in enumerate(counts)]


# Parts, by which the whole is bounded.


def _cobs_alone(frames: FloatArray) -> Subject:
    packets = [np.frombuffer(bytearray(p[:-1]), np.uint8) for p in _packets("cobs", frames)]
    out = np.zeros(packets[0].size + 1000, np.uint8)
    return each(lambda packet: crc16(out, unstuff(packet, out)), [(each,) for each in packets])


def _part(part: Callable[..., Any], frames: FloatArray, aim_us: float | None = None) -> Timed:
    """A kernel over frames and the state that an estimator has after them."""
    estimator = ContactEstimator(TIP, LINEAR, GRID, NOISE)
    for frame in frames:
        estimator.update(frame)
    state, arena = estimator.state.array, estimator.arena[0]
    return Timed(Subject(lambda n: part(n, frames, state, arena), len(frames)), None, aim_us)


@kernel
def _moments_alone(
    repeat: int, frames: FloatArray, states: Records[EstimatorState], arena: FloatArray
) -> None:
    state = states[0]
    centres = further(address(arena), state.at.centres)
    m, estimate = state.moments, state.estimate
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            m.d, m.n_x, m.n_y = estimate.d, estimate.n_x, estimate.n_y
            refine(state, address(frames[k]), centres)


@kernel
def _reading_alone(
    repeat: int, frames: FloatArray, states: Records[EstimatorState], arena: FloatArray
) -> float:
    state = states[0]
    height = further(address(arena), state.at.centres)
    total = 0.0
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            total += sum(totals(address(frames[k]), height, state.reach.first, state.reach.last))
    return total


# What a user would otherwise take: each gives centroid and variances in cells, (x, y, v_x, v_y),
# the middle of the grid at 0.


def _rivals() -> dict[str, Method]:
    """The methods that can run here, by name; a line names what to install for the others."""
    found, missing = {"NumPy moments over a threshold": contact_of(_numpy())}, []
    for name, package, make in (
        ("SciPy ndimage center_of_mass, label", "scipy", _ndimage),
        ("OpenCV moments", "opencv-python-headless", _opencv),
        ("scikit-image regionprops", "scikit-image", _skimage),
    ):
        try:
            found[name] = contact_of(make())
        except ImportError:
            missing.append(package)
    if missing:
        print(f"bench estimator: for more rows: pip install {' '.join(missing)}", file=sys.stderr)
    return found


def contact_of(moments: Moments) -> Method:
    """d and the tilts from centroid and variances, by the closed forms of a constant modulus."""
    pitch, a = GRID.pitches[0], TIP.radius

    def method(frame: FloatArray) -> Truth:
        x, y, variance_x, variance_y = moments(frame)
        x, y = x * pitch - GRID.centre[0], y * pitch - GRID.centre[1]
        trace = (variance_x + variance_y - 1 / 6) * pitch**2
        d = 2 * a - 2 * math.sqrt(max(a * a - 1.5 * max(trace, 0.0), 0.0))
        for _ in range(6):  # the trace falls with the tilt
            s2 = min((x * x + y * y) / (a - d / 3) ** 2, 0.9)
            full = trace + s2 * d * (12 * a - 5 * d) / 36
            d = 2 * a - 2 * math.sqrt(max(a * a - 1.5 * max(full, 0.0), 0.0))
        sines = (min(max(each / (a - d / 3), -0.95), 0.95) for each in (x, y))
        tilt_x, tilt_y = map(math.asin, sines)
        return d, tilt_x, tilt_y

    return method


_LEVEL = 3.0 * NOISE
_AXIS = np.arange(SIZE) - 0.5 * (SIZE - 1)


def _numpy() -> Moments:
    def moments(frame: FloatArray) -> tuple[float, float, float, float]:
        kept = np.where(frame > _LEVEL, frame, 0.0)
        by_col, by_row = kept.sum(axis=0), kept.sum(axis=1)
        total = by_col.sum()
        x, y, square = by_col @ _AXIS / total, by_row @ _AXIS / total, _AXIS**2
        return x, y, by_col @ square / total - x * x, by_row @ square / total - y * y

    return moments


def _ndimage() -> Moments:
    from scipy import ndimage

    def moments(frame: FloatArray) -> tuple[float, float, float, float]:
        labels, count = ndimage.label(frame > _LEVEL)
        index = 1 + int(np.argmax(ndimage.sum_labels(frame, labels, np.arange(1, count + 1))))
        y, x = (at + _AXIS[0] for at in ndimage.center_of_mass(frame, labels, index))
        total = ndimage.sum_labels(frame, labels, index)
        v_y = ndimage.sum_labels(frame * (_AXIS[:, None] - y) ** 2, labels, index) / total
        v_x = ndimage.sum_labels(frame * (_AXIS - x) ** 2, labels, index) / total
        return x, y, v_x, v_y

    return moments


def _opencv() -> Moments:
    import cv2

    def moments(frame: FloatArray) -> tuple[float, float, float, float]:
        _, kept = cv2.threshold(frame.astype(np.float32), _LEVEL, 0.0, cv2.THRESH_TOZERO)
        m = cv2.moments(kept)
        total = m["m00"]
        x, y = m["m10"] / total + _AXIS[0], m["m01"] / total + _AXIS[0]
        return x, y, m["mu20"] / total, m["mu02"] / total

    return moments


def _skimage() -> Moments:
    from skimage.measure import label, regionprops

    def moments(frame: FloatArray) -> tuple[float, float, float, float]:
        regions = regionprops(label(frame > _LEVEL), intensity_image=frame)
        region = max(regions, key=lambda each: each.area)
        central = region.moments_weighted_central
        y, x = region.centroid_weighted
        total = central[0, 0]
        return x + _AXIS[0], y + _AXIS[0], central[0, 2] / total, central[2, 0] / total

    return moments
