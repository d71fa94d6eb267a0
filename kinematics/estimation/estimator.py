"""Pressure grid → displacement, tilt, gain and their covariance.

Holds `ContactEstimator` and its result. What happens to a frame, in one compiled call, is in
frame_pipeline.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.solid_data import solid_data
from softfinger.kinematics.estimation.cell_centres import cell_centres
from softfinger.kinematics.estimation.error_budget import NEIGHBOURS, Uncertainty, set_budget
from softfinger.kinematics.estimation.frame_pipeline import D_MAX, estimate_frame
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
from softfinger.kinematics.estimation.moments import set_start
from softfinger.kinematics.estimation.state import HEIGHT, PATTERN, ROWS, EstimatorState, Y
from softfinger.kinematics.sensing.footprint import FloatArray, Grid
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import Weights, padded, weights_of
from softfinger.kinematics.sensing.springs_pressure import count_for, points_of


@dataclass(slots=True)
class ContactEstimate:
    """Estimate of the contact in one frame; SI units, angles in rad.

    ``contact``: something presses. ``invalid`` says why the estimate can't be used; without a
    reason it is ``valid``, which promises one contact that the model describes: the
    fit settled at d below 3/4 of the radius and a gain of 1/20 to 20, it accounts for 80 % of the
    frame's squared pressure, nothing else presses, and what it leaves smoothly over the footprint
    could hide no more than 60 % of d (one standard deviation), or 3 % with a gain beyond 1/2 to 2,
    where both say that this is another tip. Such a misfit, as of a curved face, and the known
    uncertainties are in the covariance; where together they leave more than half of d uncertain
    (one standard deviation), that is not valid either. Without contact d and the tilts are 0 and
    that is valid; d_std is then the d of a contact that is only just felt, since a smaller one
    could hide. It can't promise what no frame shows: a wrong modulus with a fixed gain, a tip
    that stands elsewhere on the sensor.

    ``covariance`` is of (d, tilt_x, tilt_y, gain), ``systematic`` the part of it that all frames
    share and averaging does not lessen; a fixed gain has a zero row. ``chi2`` is the misfit's
    square a cell over the noise's, ``r_squared`` the fraction of the frame's squared pressure that
    the model accounts for; both are 0 where nothing was fitted.
    ``misfit``: χ² is beyond what the noise makes once in 3.5 million frames, so that the model does
    not describe the contact well, or the noise is larger than given.
    """

    contact: bool = False
    invalid: Invalid = Invalid.NO_FRAME
    d: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    gain: float = 1.0
    chi2: float = 0.0
    r_squared: float = 0.0
    peak: float = 0.0  # largest cell [Pa]
    cells: int = 0  # cells in the fit
    iterations: int = 0
    rejected: int = 0  # outliers left out
    second: bool = False  # something else presses too, off the footprint
    misfit: bool = False
    shear_x: float = 0.0  # force along the face [N], which a solid tip's base feels
    shear_y: float = 0.0
    cells_per_sample: float = 1.0  # cells for each whose noise is independent
    covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))
    systematic: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def valid(self) -> bool:
        """The estimate can be used; see the class."""
        return not self.invalid

    @property
    def d_std(self) -> float:
        """Standard deviation of d [m]."""
        return math.sqrt(self.covariance.item(0))

    @property
    def tilt_x_std(self) -> float:
        """Standard deviation of tilt_x [rad]."""
        return math.sqrt(self.covariance.item(5))

    @property
    def tilt_y_std(self) -> float:
        """Standard deviation of tilt_y [rad]."""
        return math.sqrt(self.covariance.item(10))


# Accepted frame types and the reading at which a cell is full.
_FULL = {
    np.dtype(np.uint8): 255.0,
    np.dtype(np.uint16): 65535.0,
    np.dtype(np.float32): math.inf,
    np.dtype(np.float64): math.inf,
}


@dataclass(frozen=True, slots=True)
class Readings:
    """Range of a board's readings. Raises ValueError for values out of their range.

    ``saturation`` is the reading [counts, or Pa for float frames] at which a cell is full; None: an
    integer type's largest value. ``threshold`` is the smallest count the board sends, 0 stands for
    all below; for integer frames. ``quantum`` [Pa] is the width of a count where float frames are
    made of counts, which end at 0; 0 where they are not.
    """

    saturation: float | None = None
    threshold: float = 0.0
    quantum: float = 0.0

    def __post_init__(self) -> None:
        for name in ("threshold", "quantum"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


_RESULTS = (
    "d", "gain", "chi2", "tilt_x", "tilt_y", "r_squared", "peak", "cells", "iterations", "rejected",
    "contact", "second", "shear_x", "shear_y", "invalid",
)  # fmt: skip

# Of the fit and the activity test; `ContactEstimator.state` has them, should others be tried.
_TOLERANCE = 16.0  # of the squared step, in noise floors, that ends the iteration
_ITERATIONS = 20
PEAK_LEVEL = 3.0  # noise, of a cell and of its neighbours: see `detection.activity`
PATCH_LEVEL = 4.9
_R_SQUARED_MIN = (
    0.8  # fraction of the frame's squared pressure below which an estimate is not valid
)
# Points of the model to the tip's radius, or more; and of a law that is no straight line. The bias
# that they leave is a quarter of the noise floor, at 0.2 % of the modulus, at most up to 25°;
# within 4° of the domain's limit it is up to four times that floor.
_FINENESS, _BENT = 22.0, 31.0
_DEEPEST, _SINE_MAX = 0.95, 3.0 / math.sqrt(10.0)  # of the radius; tan 3: ends of springs' fit
_OVER = 1.01  # of a solid tip's ends, in d and sin θ: so far noise may take a fit at them
_SHEAR_PRIOR = 0.1  # of a solid tip's normal force
_RIM = {"bonded": 0.03, "lying": 0.05}  # of the radius: nearer to a solid tip's rim none counts
CELLS_MIN = 9  # that a solid tip's contact and shear can be told from


def within_rim(grid: SensorGrid, tip: Fingertip, known: Uncertainty) -> NDArray[np.bool_]:
    """Return the cells [rows, cols] within a solid tip's rim, at which the model may be wrong.

    A bonded base's stress is singular there, which no two meshes have alike: from independent
    elements' frames the model's differ by 3 % rms with those cells, and 0.6 % without. Under a
    tilt a lying base pulls there, where real rubber lifts. And where the tip's place is uncertain,
    the rim may be elsewhere.
    """
    margin = max(_RIM[tip.base] * tip.radius, 2.0 * (known.centre + known.pitch * tip.radius))
    cells = grid.on(tip)
    x, y = (
        np.abs(start + pitch * (np.arange(count) + 0.5)) + 0.5 * pitch
        for start, pitch, count in (
            (cells.x, cells.pitch_x, cells.cols),
            (cells.y, cells.pitch_y, cells.rows),
        )
    )
    return np.asarray(np.hypot(x, y[:, None]) < tip.radius - margin - grid.blur)


class ContactEstimator:
    """Estimates the contact under one tip from frames of a pressure grid.

    Takes the tip, its material, the grid, and ``noise``, a cell's standard deviation [Pa].
    ``free_gain`` also estimates measured over modelled pressure, by default for a tip of springs
    alone: a solid tip's frame hardly changes its shape with d, which then shows in the force only.
    Otherwise it is 1. ``active`` [rows, cols] bool masks dead cells. ``readings`` says where the
    board's readings end. ``known`` are the sensor's other uncertainties, none by default: they
    widen the covariance, and make the activity test as much less sensitive. A material's own
    ``fit_error`` counts among them. The fit goes up to a tilt of 71.57° (tan 3), and no further.

    Raises ValueError for arguments out of their range.
    """

    def __init__(
        self,
        tip: Fingertip,
        material: Material,
        grid: SensorGrid,
        noise: float,
        *,
        free_gain: bool | None = None,
        active: NDArray[np.bool_] | None = None,
        readings: Readings | None = None,
        known: Uncertainty | None = None,
    ) -> None:
        if tip.physics == "measured":
            raise ValueError(
                "a measured tip has no model of its frames: expected a tip of springs or solid; "
                "softfinger.kinematics.estimation.measured.MeasuredEstimator is for a measured one"
            )
        if active is not None and np.shape(active) != grid.shape:
            raise ValueError(f"active must have shape {grid.shape}, got {np.shape(active)}")
        readings = readings or Readings()
        self.grid = grid
        self._full = math.nan  # of the last frame's type
        self.saturation = readings.saturation
        self._quantum = readings.quantum
        known = known or Uncertainty()
        alive = np.ones(grid.shape, np.bool_) if active is None else np.asarray(active, dtype=bool)
        is_solid = tip.physics == "solid"
        if is_solid:
            alive = alive & within_rim(grid, tip, known)
            if alive.sum() < CELLS_MIN:
                raise ValueError(
                    f"a solid tip needs {CELLS_MIN} active cells within its rim, got {alive.sum()}"
                )
        state = self.state = EstimatorState()
        options = self._options = state.options
        self.noise = noise
        options.saturation = math.inf
        # Counts are rounded, so the smallest one sent stands for half a count less and up.
        options.floor = max(readings.threshold - 0.5, 0.0)
        options.free_gain = not is_solid if free_gain is None else free_gain
        options.tolerance, options.iterations = _TOLERANCE, _ITERATIONS
        options.peak_level, options.patch_level = PEAK_LEVEL, PATCH_LEVEL
        options.r_squared_min = _R_SQUARED_MIN
        options.modulus = material.reference_modulus
        options.blur, options.rotation = grid.blur, grid.rotation
        options.is_solid, options.shear_prior = is_solid, _SHEAR_PRIOR
        self._lay_out(tip, material, alive)
        pattern = None
        if is_solid:
            pattern = self._pattern(tip, alive)
            known = _with_data_errors(known, tip, options.free_gain)
        set_budget(state, known, grid, tip, material, pattern)
        options.undetected = self._undetected(tip, material, pattern)
        set_start(state.moments, grid, tip, material, options.deepest)
        records: Any = state.estimate.array
        self._estimate = records
        self._results = self._estimate[list(_RESULTS)]  # a view
        self._seq: int | None = None
        self._last = ContactEstimate(
            cells_per_sample=state.budget.cells_per_sample,
            covariance=state.estimate.covariance,
            systematic=state.estimate.systematic,
        )

    def _lay_out(self, tip: Fingertip, material: Material, alive: NDArray[np.bool_]) -> None:
        """Set the window of the frame that a contact can press, its cells, and the model of it."""
        grid, state, options = self.grid, self.state, self.state.options
        reach = cell_centres(grid.on(tip), alive, tip.radius + 3.0 * grid.blur)[0] >= 0.0
        rows, cols = (np.flatnonzero(reach.reshape(grid.shape).any(axis=k)) for k in (1, 0))
        self._window = slice(0, 0), slice(0, 0)
        if len(rows):
            self._window = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
        alive = alive[self._window]
        cells = grid.on(tip)
        cells.x += cells.pitch_x * self._window[1].start
        cells.y += cells.pitch_y * self._window[0].start
        cells.rows, cells.cols = alive.shape
        state.grid.assign(cells)
        self._frame = np.zeros(alive.shape)
        self._flat = self._frame.reshape(-1)
        self._rows = np.zeros((ROWS, alive.size))
        self._rows[HEIGHT : Y + 1] = cell_centres(cells, alive, tip.radius + 3.0 * grid.blur)
        state.signal.number = int(np.count_nonzero(self._rows[HEIGHT] >= 0.0))
        fewest, pixels, weights = cells, np.zeros(0), Weights()
        if options.is_solid:
            fewest = Grid()  # no points
            fewest.assign(cells)
            fewest.rows = fewest.cols = 0
            images = grid.images(tip).reshape(-1, *grid.shape)[:, *self._window]
            pixels = padded(images.reshape(len(images), -1))
            weights = weights_of(tip, material)
            options.deepest, options.sine_max = weights.table.deepest, math.sin(weights.table.tilt)
            options.step_deepest = _OVER * options.deepest
            options.step_sine = _OVER * options.sine_max
        else:
            options.deepest = options.step_deepest = _DEEPEST * tip.radius
            options.sine_max = options.step_sine = _SINE_MAX

        fineness = _FINENESS if material.is_linear else _BENT
        points = points_of(fewest, material, grid.blur, count_for(cells, fineness))
        # What the kernel takes besides state and frame.
        self._arrays = self._rows, pixels, weights.array, *points

    def _pattern(self, tip: Fingertip, alive: NDArray[np.bool_]) -> FloatArray:
        """Set a solid tip's pattern of a contact: the image that any shows most; [rows, cols]."""
        pattern = self.grid.images(tip)[0].reshape(self.grid.shape) * alive
        pattern = np.where(alive, pattern - pattern.sum() / alive.sum(), 0.0)
        pattern /= math.sqrt((pattern**2).sum())
        self._rows[PATTERN] = pattern[self._window].ravel()
        return np.asarray(pattern)

    def _undetected(self, tip: Fingertip, material: Material, pattern: FloatArray | None) -> float:
        """Return the d [m] of an upright contact that the activity test only just feels.

        By the ``pattern`` that it compares with a frame; None: by the cells round the largest.
        """
        options = self._options
        whole = pattern is not None
        pattern = NEIGHBOURS if pattern is None else pattern
        noise = math.hypot(options.noise, self._quantum / math.sqrt(12.0))
        level = options.patch_level * noise * math.sqrt((pattern**2).sum())
        rows, cols = pattern.shape
        deepest = min(options.deepest, D_MAX * tip.radius)
        low, high = 1e-6 * deepest, deepest
        for _ in range(14):
            d = math.sqrt(low * high)
            frame = self.grid.pressure(tip, material, d)
            felt = True
            if not whole:
                felt = frame.max() > options.peak_level * noise
                row, col = np.unravel_index(frame.argmax(), frame.shape)
                frame = np.pad(frame, (rows // 2, cols // 2))[row : row + rows, col : col + cols]
            felt = felt and (pattern * frame).sum() > level
            low, high = (low, d) if felt else (d, high)
        return high

    @property
    def saturation(self) -> float | None:
        """The reading at which a cell is full; None for an integer type's largest value.

        Set it again where another zero is taken off the readings. Raises ValueError for one that is
        not positive.
        """
        return self._saturation

    @saturation.setter
    def saturation(self, reading: float | None) -> None:
        if reading is not None and not reading > 0.0:
            raise ValueError(f"saturation must be positive, got {reading}")
        self._saturation, self._full = reading, math.nan

    @property
    def noise(self) -> float:
        """Standard deviation of a cell [Pa]. Raises ValueError for one that is not positive."""
        return float(self._options.noise)

    @noise.setter
    def noise(self, noise: float) -> None:
        if not (math.isfinite(noise) and noise > 0.0):
            raise ValueError(f"noise must be a positive number of Pa, got {noise}")
        self._options.noise = noise

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """Estimate from this frame alone: a new result, whatever frames came before.

        Frames as for :meth:`update`. Raises ValueError for a wrong shape or type.
        """
        estimate = self.state.estimate
        before, seq, last = self._estimate.copy(), self._seq, self._last
        self._last = ContactEstimate(cells_per_sample=self.state.budget.cells_per_sample)
        try:
            estimate.warm = False
            found = self.update(frame, pascal_per_count)
            found.covariance[:] = estimate.covariance
            found.systematic[:] = estimate.systematic
            return found
        finally:
            self._estimate[:], self._seq, self._last = before, seq, last

    def update(
        self, frame: NDArray[Any], pascal_per_count: float = 1.0, seq: int | None = None
    ) -> ContactEstimate:
        """Estimate from this frame, starting from the last; the one result object is reused.

        ``frame`` [rows, cols] is uint8, uint16, float32 or float64; its values times
        ``pascal_per_count`` are Pa. The quantum's noise of integer frames is added to the cells'
        noise. A ``seq`` equal to the last frame's returns at once. Raises ValueError for a wrong
        shape or type, or a pascal_per_count that is not positive.
        """
        if seq is not None and seq == self._seq:
            return self._last
        full = _FULL.get(frame.dtype) if isinstance(frame, np.ndarray) else None
        if full is None:
            kind = getattr(frame, "dtype", type(frame).__name__)
            raise ValueError(f"a frame is uint8, uint16, float32 or float64, got {kind}")
        if frame.shape != self.grid.shape:
            raise ValueError(f"a frame must have shape {self.grid.shape}, got {frame.shape}")
        if not 0.0 < pascal_per_count < math.inf:
            raise ValueError(f"pascal_per_count must be positive, got {pascal_per_count}")
        if full != self._full:
            self._full = full
            self._options.saturation = full if self._saturation is None else self._saturation
        # One copy makes every type, layout and read-only frame the same to the compiled entry.
        self._frame[...] = frame[self._window]
        step = self._quantum if full == math.inf else pascal_per_count
        estimate_frame(
            self.state.array, self._flat, float(pascal_per_count), float(step),
            *self._arrays,
        )  # fmt: skip
        result = self._last
        for name, value in zip(_RESULTS, self._results.item(), strict=True):
            setattr(result, name, value)
        result.invalid = REASONS[result.invalid]
        # By Wilson-Hilferty, 5 σ.
        variance = 2.0 / (9.0 * max(result.cells / result.cells_per_sample - 4, 1))
        result.misfit = result.chi2 > (1.0 - variance + 5.0 * math.sqrt(variance)) ** 3
        self._seq = seq
        return result

    def reset(self) -> None:
        """Forget the last estimate: the next frame starts cold."""
        self.state.estimate.warm = False
        self._seq = None


def _with_data_errors(known: Uncertainty, tip: Fingertip, free_gain: bool) -> Uncertainty:
    """Return the uncertainties, with how far a solid tip's data are off other elements'.

    Upright an error of the pressure is as symmetric as the pressure is, and with a known gain it
    hardly moves d.
    """
    data = solid_data(tip)
    smooth = data.pressure_error if free_gain else 0.0
    modulus, smooth = math.hypot(known.modulus, data.error), math.hypot(known.smooth, smooth)
    return replace(known, modulus=modulus, smooth=smooth)
