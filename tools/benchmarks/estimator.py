"""Measure the run time and the error of contact table lookups and frame estimates.

Within one run, calls to all measured functions alternate. All lookups use the same random points
with |θ| up to 30° and d up to 8 mm. Half of the displacements are uniformly distributed. The other
half are log-uniformly distributed, down to 1 µm. The reported error is the maximum relative
deviation from a quadrature with many nodes.

Each frame has 44 × 44 cells on a 58 mm square. The contact has d = 4 mm and a tilt of 15°, unless a
row gives other values. The noise is 0.2 % of the modulus. As in the control loop, the estimator is
called from Python. Both spring tips and solid tips are measured. The table lists the RMS errors
over these frames and the Cramér-Rao bound. The "sensor" rows show the errors for a profile's sensor
after one second of constant contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS
from softfinger.daemon.simulation.simulated_tactile import make_sensor_model
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.measuring import Report, figure, interleave
from softfinger.tools.benchmarks.rigs import SENSORS

FloatArray = NDArray[np.float64]
Truth: TypeAlias = tuple[float, float, float]  # d [m], tilt_x, tilt_y [rad]

ERROR = "RMS of d [µm]"
TIP = Fingertip(radius=0.020)
SOLID = Fingertip(0.020, "solid")
MODULUS = 0.304e6  # Pa
LINEAR = Material.constant(MODULUS)
SIZE, WIDTH = 44, 0.058  # number of cells per side, and width [m]
NOISE = 0.002 * MODULUS
_PASCAL_PER_COUNT = 4.0
_FRAME_COUNT = 32
_STEPS = (1e-7, 1e-5, 1e-5, 1e-4)

LOOKUP_ERROR = "relative error"
_LAW = Material.table_i()
_D_MAX, _TILT_MAX = 0.008, math.radians(30.0)  # [m], [rad]
_SINGLE_POINT_COUNT = 16  # number of points that are looked up in separate calls
_CALL_AIM_NS = 800.0  # target duration of one call [ns]


def rms_errors(found: FloatArray, truth: Truth) -> dict[str, float]:
    """Return the RMS errors of d and the tilts."""
    rms = np.sqrt(np.mean((found - np.array(truth)) ** 2, axis=0))
    return {ERROR: 1e6 * float(rms[0]), "of tilts [°]": math.degrees(math.hypot(*rms[1:]))}


def tilts(theta: float, azimuth: float) -> tuple[float, float]:
    """Return (tilt_x, tilt_y) for a total tilt ``theta`` towards ``azimuth`` [rad]."""
    s = math.sin(theta)
    return math.asin(s * math.cos(azimuth)), math.asin(s * math.sin(azimuth))


GRID = SensorGrid(SIZE, SIZE, WIDTH / SIZE, (0.31 * WIDTH / SIZE, -0.17 * WIDTH / SIZE))
TRUTH: Truth = (0.004, *tilts(math.radians(15.0), 0.7))
_CORNER: Truth = (0.008, *tilts(math.radians(30.0), 0.7))
_LIGHT: Truth = (0.001, 0.0, 0.0)


def measure(brief: bool = False) -> list[Report]:
    """Return run times and errors of lookups and frame estimates."""
    rounds = 10 if brief else 25
    return [lookups(rounds), frames_to_contacts(rounds)]


def lookups(rounds: int, count: int = 512) -> Report:
    """Measure the time per point [ns] and the error, for vectorised and for single lookups."""
    rng = np.random.default_rng(3)
    even = rng.uniform(0.0, _D_MAX, count)
    spread = 10.0 ** rng.uniform(-6.0, np.log10(_D_MAX), count)
    d = np.where(np.arange(count) % 2 == 0, even, spread)
    theta = rng.uniform(-_TILT_MAX, _TILT_MAX, count)
    exact = np.stack(integrate(TIP, _LAW, d, theta, 40))
    tables = {f"table to {each:g}": ContactTable.build(TIP, _LAW, each) for each in (1e-6, 1e-9)}
    errors = {
        name: float(np.max(np.abs(np.stack(table(d, theta)[: len(exact)]) / exact - 1.0)))
        for name, table in tables.items()
    }
    single = list(
        zip(d[:_SINGLE_POINT_COUNT].tolist(), theta[:_SINGLE_POINT_COUNT].tolist(), strict=True)
    )
    rows = []
    for way, chosen, points, aim in (
        ("", [(d, theta)], count, None),
        (", called", single, _SINGLE_POINT_COUNT, _CALL_AIM_NS),
    ):
        times = interleave(
            {name: partial(call_with_each, table, chosen) for name, table in tables.items()}, rounds
        )
        for name, taken in times.items():
            error = {LOOKUP_ERROR: errors[name]}
            rows.append(figure(f"{name}{way}", "ns", taken / points, aim, **error))
    if find_spec("scipy"):
        rows.append(_spline(d, theta, exact[0], rounds))
    return Report("lookup", rows)


def _spline(d: FloatArray, theta: FloatArray, force: FloatArray, rounds: int) -> dict[str, Any]:
    """Return the time per point and the error of SciPy's bicubic spline, which computes only F."""
    interpolate: Any = import_module("scipy.interpolate")
    at = np.linspace(0.0, _D_MAX, 129), np.linspace(-_TILT_MAX, _TILT_MAX, 65)
    spline = interpolate.RectBivariateSpline(*at, integrate(TIP, _LAW, *np.meshgrid(*at)).force.T)
    name = "SciPy's RectBivariateSpline, F alone"
    taken = interleave({name: partial(spline.ev, d, theta)}, rounds)[name]
    error = float(np.max(np.abs(spline.ev(d, theta) / force - 1.0)))
    return figure(name, "ns", taken / len(d), None, **{LOOKUP_ERROR: error})


def frames_to_contacts(rounds: int) -> Report:
    """Return run times and errors of frame estimates, and the Cramér-Rao bound."""
    noise = np.random.default_rng(4).standard_normal((_FRAME_COUNT, SIZE, SIZE))
    frames = GRID.pressure(TIP, LINEAR, *TRUTH) + NOISE * noise
    empty, deep = NOISE * noise, GRID.pressure(TIP, LINEAR, *_CORNER) + NOISE * noise

    def solid(truth: Truth) -> tuple[Callable[[], FloatArray], Truth, None]:
        frames = GRID.pressure(SOLID, LINEAR, *truth) + NOISE * noise
        return estimates(frames, tip=SOLID), truth, None

    cases: dict[str, tuple[Callable[[], FloatArray], Truth | None, float | None]] = {
        "ml: warm": (estimates(frames), TRUTH, 20.0),
        "ml: cold": (estimates(frames, cold=True), TRUTH, 30.0),
        "ml: at (8 mm, 30°), warm": (estimates(deep), _CORNER, 45.0),
        "solid: at 1 mm, warm": solid(_LIGHT),
        "solid: warm": solid(TRUTH),
        "solid: at (8 mm, 30°), warm": solid(_CORNER),
        "centroid and extent, NumPy": (partial(centroid_and_extent, frames), TRUTH, None),
        "no contact": (estimates(empty), None, None),
    }
    subjects: dict[str, Callable[[], object]] = {name: run for name, (run, _, _) in cases.items()}
    subjects["decode: cobs"] = decode(frames)
    times = {name: taken / _FRAME_COUNT for name, taken in interleave(subjects, rounds).items()}
    # Other programs on the machine affect the minimum least.
    quickest = {name: float(np.min(taken)) for name, taken in times.items()}
    rows = []
    for name, (run, truth, aim) in cases.items():
        more = rms_errors(run(), truth) if truth else {}
        if "solid" in name:
            more["× ml: warm"] = quickest[name] / quickest["ml: warm"]
        rows.append(figure(name, "µs", 1e-3 * times[name], aim, **more))
    rows.append(figure("decode: cobs", "µs", 1e-3 * times["decode: cobs"], 20.0))
    rows.append({"name": "Cramér-Rao bound", ERROR: 1e6 * bound()})
    for sensor, flaws in {"ideal": {}, **SENSORS}.items():
        found = settled(Settings.model_validate(flaws), TRUTH)
        rows.append({"name": f"ml: sensor {sensor}", **rms_errors(found, TRUTH)})
    return Report("frame to contact", rows)


def centroid_and_extent(frames: FloatArray) -> FloatArray:
    """Compute d and the tilts [n, 3] from each footprint's centroid and extent, using NumPy.

    For a constant modulus, the centroid is (a − d/3)(n_x, n_y), and the trace of the covariance is
    d (4a − d)/6 − sin² θ d (12a − 5d)/36. The initial footprint contains all cells above a
    threshold. The footprint is then recomputed from the latest d and tilts.
    """
    cells, a = GRID.on(TIP), TIP.radius
    x = cells.x + cells.pitch_x * (np.arange(SIZE) + 0.5)
    y = (cells.y + cells.pitch_y * (np.arange(SIZE) + 0.5))[:, None]
    found = np.empty((len(frames), 3))
    for k, frame in enumerate(frames):
        inside = frame > max(4.0 * NOISE, 0.15 * float(frame.max()))
        d = s_x = s_y = 0.0
        for _ in range(3):
            pressure = np.where(inside, frame, 0.0)
            total = pressure.sum()
            m_x, m_y = (pressure * x).sum() / total, (pressure * y).sum() / total
            trace = (pressure * (x * x + y * y)).sum() / total - m_x * m_x - m_y * m_y
            trace -= (cells.pitch_x**2 + cells.pitch_y**2) / 12.0
            for _ in range(4):
                square = (m_x * m_x + m_y * m_y) / (a - d / 3.0) ** 2
                # The trace of the pressure covariance is (24a − 12a s²) d/36 − (6 − 5 s²) d²/36.
                b, c = a * (24.0 - 12.0 * square), 6.0 - 5.0 * square
                d = float((b - math.sqrt(max(b * b - 144.0 * c * trace, 0.0))) / (2.0 * c))
            s_x, s_y = m_x / (a - d / 3.0), m_y / (a - d / 3.0)
            radius = math.sqrt(d * (2.0 * a - d)) + 0.75 * math.hypot(cells.pitch_x, cells.pitch_y)
            h, c_z = math.sqrt(max(a * a - radius * radius, 0.0)), math.sqrt(1 - s_x**2 - s_y**2)
            height = np.sqrt(np.maximum(a * a - x * x - y * y, 0.0))
            inside = height * c_z > h - s_x * x - s_y * y
        found[k] = d, math.asin(s_x), math.asin(s_y)
    return found


def settled(settings: Settings, truth: Truth, count: int = _FRAME_COUNT) -> FloatArray:
    """Estimate d and tilts [count, 3] with a profile's sensor, after 1 s of constant contact."""
    model = make_sensor_model(settings, 0)
    estimator = make_estimator(settings, make_material(settings.material))
    counts = np.zeros(model.grid.shape, np.uint16)
    found = []
    for k in range(round(settings.tactile.rate) + count):
        model.frame(*truth, counts, k / settings.tactile.rate)
        estimate = estimator.update(counts, settings.tactile.pascal_per_count)
        found.append((estimate.d, estimate.tilt_x, estimate.tilt_y))
    return np.array(found[-count:])


def bound() -> float:
    """Return the Cramér-Rao bound for d [m] if the tilts and the gain are also estimated.

    The derivatives of pressure with respect to (d, tilt_x, tilt_y, gain) are central differences.
    """
    at, slopes = np.array([*TRUTH, 1.0]), []
    for step in np.diag(_STEPS):
        above, below = (GRID.pressure(TIP, LINEAR, *(at + by)) for by in (step, -step))
        slopes.append(((above - below) / (2.0 * step.max())).ravel())
    covariance = np.linalg.inv(np.array(slopes) @ np.transpose(slopes)) * NOISE**2
    return float(np.sqrt(covariance[0, 0]))


def estimates(
    frames: FloatArray, cold: bool = False, tip: Fingertip = TIP
) -> Callable[[], FloatArray]:
    """Return a function that estimates d and tilts [n, 3].

    If ``cold`` is set, the estimator is reset before each frame.
    """
    estimator = ContactEstimator(tip, LINEAR, GRID, NOISE)

    def run() -> FloatArray:
        found = np.empty((len(frames), 3))
        for k, frame in enumerate(frames):
            if cold:
                estimator.reset()
            estimate = estimator.update(frame)
            found[k] = estimate.d, estimate.tilt_x, estimate.tilt_y
        return found

    return run


def call_with_each(call: Callable[..., object], arguments: Sequence[tuple[Any, ...]]) -> None:
    """Call the function once with each argument tuple."""
    for one in arguments:
        call(*one)


def decode(frames: FloatArray) -> Callable[[], object]:
    """Return a function that decodes all frames from COBS packets."""
    counts = np.maximum(frames / _PASCAL_PER_COUNT, 0.0).astype(np.uint16)
    packets = [ENCODERS["cobs"].encode(frame, k, 0.01 * k) for k, frame in enumerate(counts)]
    feed = CobsDecoder(*frames.shape[1:]).feed
    return partial(call_with_each, feed, [(packet, 0.0) for packet in packets])
