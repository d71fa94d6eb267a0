"""Pressure grid → displacement, tilt, gain and their covariance.

Holds `ContactEstimator` and its result. What happens to a frame, in one compiled call, is in
frame_pipeline.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.blurred_cells import pieces_to_fit, weights
from softfinger.kinematics.estimation.cell_centres import HEIGHT, cell_centres
from softfinger.kinematics.estimation.error_budget import NEIGHBOURS, Uncertainty, set_budget
from softfinger.kinematics.estimation.frame_pipeline import D_MAX, estimate_frame
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
from softfinger.kinematics.estimation.likelihood import set_law
from softfinger.kinematics.estimation.moments import moment_ratios
from softfinger.kinematics.estimation.solid_budget import set_solid_budget
from softfinger.kinematics.estimation.solid_fit import lay_out_solid, within_rim
from softfinger.kinematics.estimation.state import PLANES, EstimatorState
from softfinger.kinematics.sensing.cell_integrals import ACTIVE, cell_integrals
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


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


# Of the fit and the activity test; `ContactEstimator.state` has them, should others be tried.
_TOLERANCE = 16.0  # of the squared step, in noise floors, that ends the iteration
_ITERATIONS = 20
PEAK_LEVEL = 3.0  # noise, of a cell and of its neighbours: see `detection.activity`
PATCH_LEVEL = 4.9
_R_SQUARED_MIN = (
    0.8  # fraction of the frame's squared pressure below which an estimate is not valid
)


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
        # For compiled callers: the memory of `frame_pipeline.estimate_frame`, …
        state = self.state = EstimatorState()
        self.scratch: tuple[FloatArray, IntArray | None, Any]  # … and what it takes last
        options = self._options = state.options
        self.noise = noise
        options.saturation = math.inf
        # Counts are rounded, so the smallest one sent stands for half a count less and up.
        options.floor = max(readings.threshold - 0.5, 0.0)
        options.free_gain = tip.physics == "springs" if free_gain is None else free_gain
        options.tolerance = _TOLERANCE
        options.iterations = _ITERATIONS
        options.peak_level = PEAK_LEVEL
        options.patch_level = PATCH_LEVEL
        options.r_squared_min = _R_SQUARED_MIN
        options.modulus = material.reference_modulus
        options.blur = grid.blur
        options.rotation = grid.rotation
        if tip.physics == "solid":
            alive = alive & within_rim(grid, tip, known)
            scratch, indices, solid = lay_out_solid(state, grid, tip, alive, material)
            set_solid_budget(state, solid, known, grid, tip, indices, material.fit_error)
            self.scratch = scratch, indices, solid.array
            pattern = np.zeros(grid.shape)
            image = grid.images(tip)[0].ravel()[indices]
            pattern.ravel()[indices] = image - image.mean()
            options.undetected = self._undetected(
                tip, material, pattern, solid.weights.table.deepest
            )
        else:
            set_law(state.law, material)
            state.moments.ratios = moment_ratios(tip, material)
            set_budget(state, known, grid, tip, material.fit_error)
            self.scratch = *_lay_out(state, grid, tip, alive), None
            options.undetected = self._undetected(tip, material, NEIGHBOURS, D_MAX * tip.radius)
        self._estimate: Any = state.estimate.array
        self._frame = np.zeros(grid.shape)
        self._seq: int | None = None
        self._last = ContactEstimate(
            cells_per_sample=state.budget.cells_per_sample,
            covariance=state.estimate.covariance,
            systematic=state.estimate.systematic,
        )

    def _undetected(
        self, tip: Fingertip, material: Material, pattern: FloatArray, deepest: float
    ) -> float:
        """Return the d [m] of an upright contact that the activity test only just feels.

        By the ``pattern`` that it compares with a frame: whole, or the cells round the largest.
        """
        options = self._options
        noise = math.hypot(options.noise, self._quantum / math.sqrt(12.0))
        level = options.patch_level * noise * math.sqrt((pattern**2).sum())
        rows, cols = pattern.shape
        low, high = 1e-6 * deepest, deepest
        for _ in range(14):
            d = math.sqrt(low * high)
            frame = self.grid.pressure(tip, material, d)
            felt = True
            if pattern.shape != frame.shape:
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
        if frame.shape != self._frame.shape:
            raise ValueError(f"a frame must have shape {self._frame.shape}, got {frame.shape}")
        if not 0.0 < pascal_per_count < math.inf:
            raise ValueError(f"pascal_per_count must be positive, got {pascal_per_count}")
        if full != self._full:
            self._full = full
            self._options.saturation = full if self._saturation is None else self._saturation
        # One copy makes every type, layout and read-only frame the same to the compiled entry.
        self._frame[...] = frame
        step = self._quantum if full == math.inf else pascal_per_count
        estimate_frame(
            self.state.array,
            self._frame,
            float(pascal_per_count),
            float(step),
            *self.scratch,
        )
        result = self._last
        # The record's fields in their order: read at once, a tenth of the time of one by one.
        (
            result.d,
            result.gain,
            result.chi2,
            result.tilt_x,
            result.tilt_y,
            result.r_squared,
            result.peak,
            result.cells,
            result.iterations,
            result.rejected,
            result.contact,
            invalid,
            result.second,
            _,
            result.shear_x,
            result.shear_y,
            *_,
        ) = self._estimate.item()
        result.invalid = REASONS[invalid]
        # By Wilson-Hilferty, 5 σ.
        variance = 2.0 / (9.0 * max(result.cells / result.cells_per_sample - 4, 1))
        result.misfit = result.chi2 > (1.0 - variance + 5.0 * math.sqrt(variance)) ** 3
        self._seq = seq
        return result

    def reset(self) -> None:
        """Forget the last estimate: the next frame starts cold."""
        self.state.estimate.warm = False
        self._seq = None


@lru_cache(maxsize=4)
def _integrals(grid: SensorGrid, tip: Fingertip) -> FloatArray:
    """Integrate a grid's cells under a tip; cached, since two fingers' are mostly the same."""
    return cell_integrals(grid.on(tip))


def _lay_out(
    state: EstimatorState, grid: SensorGrid, tip: Fingertip, active: NDArray[np.bool_]
) -> tuple[FloatArray, IntArray | None]:
    """The scratch of a grid, and indices of a blurred one's pieces; see `state`."""
    geometry = grid.on(tip)
    state.grid.assign(geometry)
    state.model.assign(geometry)
    centres = cell_centres(geometry, active, tip.radius + 3.0 * grid.blur, state.region)
    cells = _integrals(grid, tip).copy()
    # A blur reaches cells that no contact is looked for in; whatever they read, it's not used.
    cells[:, ACTIVE] = (centres[HEIGHT] >= 0.0).reshape(grid.shape)
    arrays = {"centres": centres, "cells": cells}
    indices = None
    if grid.blur > 0.0:
        pitch_x, pitch_y = grid.pitches
        number = pieces_to_fit(grid.blur / pitch_x), pieces_to_fit(grid.blur / pitch_y)
        (across, along), finer = grid.finer(number)
        pieces = _integrals(finer, tip).copy()
        pieces[:, ACTIVE] = 1.0
        model, blur = state.model, state.blur
        model.rows, model.cols = finer.shape
        model.pitch_x, model.pitch_y = pitch_x / number[0], pitch_y / number[1]
        model.x = geometry.x - len(across) // 2 * model.pitch_x
        model.y = geometry.y - len(along) // 2 * model.pitch_y
        across, along = weights(across, number[0]), weights(along, number[1])
        blur.pieces_x, blur.pieces_y = number
        blur.weights_x, blur.weights_y = len(across), len(along)
        fine, half = np.zeros(finer.shape), np.zeros(finer.cols)
        arrays |= {"pieces": pieces, "across": across, "along": along, "fine": fine, "half": half}
        indices = np.zeros(finer.rows * finer.cols, dtype=np.int64)
    rows, cols = state.model.rows, state.model.cols
    arrays["columns"], arrays["lines"] = np.zeros(2 * (cols + 1)), np.zeros(2 * (rows + 1))
    arrays["packed"] = np.zeros(PLANES * rows * cols)
    start = 0
    for name, array in arrays.items():
        setattr(state.at, name, start)
        start += array.size
    return np.concatenate([array.ravel() for array in arrays.values()]), indices
