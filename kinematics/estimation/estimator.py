"""Estimate displacement, tilts and gain, with their covariance, from a pressure frame.

This module contains `ContactEstimator` and its result `ContactEstimate`. Each frame is processed in
one compiled call; see `frame_pipeline`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.solid_data import solid_data
from softfinger.kinematics.estimation.detection import PATCH_LEVEL
from softfinger.kinematics.estimation.error_budget import NEIGHBOURS, Uncertainty, set_budget
from softfinger.kinematics.estimation.frame_pipeline import D_MAX, estimate_frame
from softfinger.kinematics.estimation.gauss_newton import CELLS_MIN
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
from softfinger.kinematics.estimation.moments import tabulate_moments
from softfinger.kinematics.estimation.state import SHEAR_X, EstimatorState, new_cells
from softfinger.kinematics.sensing.footprint import Grid, axes
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import Weights, pixels_of, weights_of
from softfinger.kinematics.sensing.springs_pressure import count_for, points_of

__all__ = ["ContactEstimate", "ContactEstimator", "Readings"]


@dataclass(slots=True)
class ContactEstimate:
    """Estimated contact in one frame, in SI units.

    Attributes
    ----------
    contact
        True if a contact is detected.
    invalid
        Reason why the estimate cannot be used, or `Invalid.NONE`.
    d
        Displacement [m].
    tilt_x, tilt_y
        Tilts of the object's face normal [rad].
    gain
        Ratio of measured to modelled pressure.
    chi2
        Mean squared residual per cell divided by the noise variance; 0 without a fit.
    r_squared
        Fraction of the frame's squared pressure that the model explains; 0 without a fit.
    peak
        Largest reading [Pa].
    cells
        Number of cells in the fit.
    iterations
        Number of iterations of the fit.
    rejected_count
        Number of outliers excluded from the fit.
    has_second_contact
        True if a second contact presses outside the footprint.
    misfit
        True if χ² exceeds the value that noise alone reaches once in 3.5 million frames. Either the
        model does not describe the contact well, or the noise is larger than specified.
    shear_x, shear_y
        Force along the face [N] of a solid tip; 0 for springs.
    cells_per_sample
        Number of cells per independent noise sample.
    covariance
        Covariance of (d, tilt_x, tilt_y, gain) in m and rad. The row of a fixed gain is zero.
    systematic
        Part of the covariance due to errors that all frames share. Averaging does not reduce this
        part.

    Notes
    -----
    A ``valid`` estimate with a contact meets these conditions:

    - The fit has converged, d is below 3/4 of the radius, and the gain is between 1/20 and 20.
    - The model explains at least 80 % of the frame's squared pressure.
    - There is no second contact.
    - The smooth part of the residual could change d by at most 60 % (one standard deviation). If
      the gain is below 1/2 or above 2, a smooth residual indicates a different tip, so the limit is
      3 %.
    - The standard deviation of d due to the known uncertainties is at most half of d.

    The covariance includes the known uncertainties and the smooth residual. A curved face, for
    example, causes a smooth residual.

    An estimate without a contact is valid. Its d and tilts are 0, and its ``d_std`` is the smallest
    detectable d. A single frame does not reveal a displacement of the tip on the sensor. If the
    gain is fixed, a single frame does not reveal a wrong modulus either.
    """

    contact: bool = False
    invalid: Invalid = Invalid.NO_FRAME
    d: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    gain: float = 1.0
    chi2: float = 0.0
    r_squared: float = 0.0
    peak: float = 0.0
    cells: int = 0
    iterations: int = 0
    rejected_count: int = 0
    has_second_contact: bool = False
    misfit: bool = False
    shear_x: float = 0.0
    shear_y: float = 0.0
    cells_per_sample: float = 1.0
    covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))
    systematic: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))

    def __repr__(self) -> str:
        if not self.valid:
            return f"ContactEstimate: not valid: {self.invalid.text}"
        if not self.contact:
            return f"ContactEstimate: no contact deeper than {1e3 * self.d_std:.2g} mm"
        pairs = (self.tilt_x, self.tilt_x_std), (self.tilt_y, self.tilt_y_std)
        tilts = ", ".join(f"{math.degrees(a):z.2f} ± {math.degrees(std):.2f}°" for a, std in pairs)
        d = f"d {1e3 * self.d:.3f} ± {1e3 * self.d_std:.3f} mm"
        return f"ContactEstimate: {d}, tilts {tilts}, gain {self.gain:.2f}"

    @property
    def valid(self) -> bool:
        """True if the estimate can be used; see the class notes."""
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


# Accepted frame types, and the readings at which they saturate.
_SATURATION_COUNTS = {
    np.dtype(np.uint8): 255.0,
    np.dtype(np.uint16): 65535.0,
    np.dtype(np.float32): math.inf,
    np.dtype(np.float64): math.inf,
}


@dataclass(frozen=True, slots=True)
class Readings:
    """Range and resolution of the board's readings.

    Parameters
    ----------
    saturation
        Reading at which a cell saturates [counts, or Pa for float frames]. None means the maximum
        of the integer type.
    threshold
        Smallest nonzero count that the board sends; smaller readings are sent as 0. The threshold
        applies only to integer frames.
    quantum
        Size of one count [Pa] if float frames were converted from counts clipped at 0, otherwise 0.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    saturation: float | None = None
    threshold: float = 0.0
    quantum: float = 0.0

    def __post_init__(self) -> None:
        if self.saturation is not None and not self.saturation > 0.0:
            raise ValueError(f"saturation must be positive, got {self.saturation}")
        for name in ("threshold", "quantum"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


_RESULTS = (
    "d", "gain", "chi2", "tilt_x", "tilt_y", "r_squared", "peak", "cells", "iterations",
    "rejected_count", "contact", "has_second_contact", "shear_x", "shear_y", "invalid",
)  # fmt: skip

_TOLERANCE = 16.0  # squared ratio of step to noise floor at which the iteration stops
# Minimum number of model points per tip radius, for linear and for nonlinear material laws. For
# tilts up to 25° and noise of 0.2 % of the modulus, the bias is at most a quarter of the noise
# floor. Within 4° of the domain limit, the bias is up to four times the noise floor.
_FINENESS_LINEAR, _FINENESS_NONLINEAR = 22.0, 31.0
_DEEPEST, _SINE_MAX = 0.95, 3.0 / math.sqrt(10.0)  # maximum values of d/a and sin θ in a spring fit
# Width of the excluded rim of a solid tip, relative to the radius.
_RIM_WIDTH = {"bonded": 0.03, "lying": 0.05}


def cell_centres(
    grid: Grid, active: NDArray[np.bool_], radius: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return height, x and y of the cells as flat arrays.

    The height is √(a² − x² − y²) at the cell centre. If the cell centre lies outside the rim, the
    cell's point closest to the tip centre is used instead. The height of unused cells is −∞. Unused
    cells are outside the mask ``active`` [rows, cols] or farther than ``radius`` [m] from the tip
    centre.
    """
    a, pitch_x, pitch_y = grid.radius, grid.pitch_x, grid.pitch_y
    x, y = np.meshgrid(*axes(grid))
    nearest_x = np.maximum(np.abs(x) - 0.5 * pitch_x, 0.0)
    nearest_y = np.maximum(np.abs(y) - 0.5 * pitch_y, 0.0)
    touched = nearest_x**2 + nearest_y**2 < radius * radius
    near = np.maximum(a * a - nearest_x**2 - nearest_y**2, 0.0)
    inside = a * a - x * x - y * y
    height = np.sqrt(np.where(inside > 0.0, inside, near))
    return np.where(touched & active, height, -math.inf).ravel(), x.ravel(), y.ravel()


def _range(at: NDArray[np.intp]) -> tuple[int, int]:
    """Return the half-open range of ascending indices, or (0, 0) if there are none."""
    return (int(at[0]), int(at[-1]) + 1) if len(at) else (0, 0)


def cells_within_rim(grid: SensorGrid, tip: Fingertip, known: Uncertainty) -> NDArray[np.bool_]:
    """Return a mask [rows, cols] of the cells inside a solid tip's rim.

    At the rim of a bonded base, the stress is singular, and its computed value depends on the mesh.
    Compared with independent finite-element models, the rms error is 3 %. Without the rim cells,
    the rms error is 0.6 %. If a base that lies on the sensor is tilted, the model predicts tension
    at the rim. Real rubber lifts off there. The mask also allows for the uncertainty of the tip
    position.
    """
    margin = max(_RIM_WIDTH[tip.base] * tip.radius, 2.0 * (known.centre + known.pitch * tip.radius))
    x, y = (
        np.abs(middle) + 0.5 * pitch
        for middle, pitch in zip(axes(grid.on(tip)), grid.pitches, strict=True)
    )
    return np.asarray(np.hypot(x, y[:, None]) < tip.radius - margin - grid.blur)


class ContactEstimator:
    """Estimate the contact of one tip from the frames of a pressure grid.

    Parameters
    ----------
    tip, material, grid
        Fingertip ("springs" or "solid"), its stress-strain law, and the sensor. The sensor must
        have at least two rows and two columns.
    noise
        Standard deviation of a cell's noise [Pa].
    free_gain
        If True, also estimate the gain, the ratio of measured to modelled pressure. If False, the
        gain is 1. The default is True for springs and False for solid tips. The shape of a solid
        tip's frame hardly depends on d, so only the force can determine d.
    active
        Mask of working cells, bool [rows, cols]; None uses all cells.
    readings
        Range and resolution of the readings.
    known
        Other uncertainties of the sensor. These uncertainties and the material's ``fit_error``
        widen the covariance and make the contact detection less sensitive.

    Attributes
    ----------
    saturation
        Reading at which a cell saturates, as in `Readings`. Update this value whenever the zero
        offset that is subtracted from the readings changes.

    Raises
    ------
    ValueError
        If an argument is out of range.

    Notes
    -----
    For a spring tip, tilts are estimated up to 71.57° (tan θ = 3). For a solid tip, tilts are
    estimated up to the maximum tilt of its data.
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
                "this class can't estimate the contact of a measured tip: use "
                "softfinger.kinematics.estimation.measured.MeasuredEstimator"
            )
        if min(grid.shape) < 2:
            # Tilts of opposite sign across a single line of cells result in nearly equal frames.
            raise ValueError(
                "the grid must have at least two rows and two columns, which determine both "
                f"tilts, got {grid.rows} × {grid.cols}"
            )
        if active is not None and np.shape(active) != grid.shape:
            raise ValueError(f"active must have shape {grid.shape}, got {np.shape(active)}")
        readings = readings or Readings()
        self.grid = grid
        self.saturation = readings.saturation
        self._quantum = readings.quantum
        known = known or Uncertainty()
        alive = np.ones(grid.shape, np.bool_) if active is None else np.asarray(active, dtype=bool)
        is_solid = tip.physics == "solid"
        if is_solid:
            alive = alive & cells_within_rim(grid, tip, known)
            if alive.sum() < CELLS_MIN:
                raise ValueError(
                    f"a solid tip requires at least {CELLS_MIN} active cells within its rim, got "
                    f"{alive.sum()}"
                )
        state = self.state = EstimatorState()
        options = self._options = state.options
        self.noise = noise
        # Counts are rounded, so the floor is half a count below the smallest count that the board
        # sends.
        options.floor = max(readings.threshold - 0.5, 0.0)
        options.free_gain = not is_solid if free_gain is None else free_gain
        options.tolerance, options.patch_level = _TOLERANCE, PATCH_LEVEL
        options.modulus = material.reference_modulus
        options.blur, options.rotation = grid.blur, grid.rotation
        options.is_solid = is_solid
        self._lay_out(tip, material, alive)
        pattern = None
        if is_solid:
            pattern = self._pattern(tip, alive)
            known = _with_data_errors(known, tip, options.free_gain)
        set_budget(state, known, grid, tip, material, pattern)
        tabulate_moments(state.moments, grid, tip, material, options.deepest)
        records: Any = state.estimate.array
        self._estimate = records
        self._results = self._estimate[list(_RESULTS)]  # a view of the estimate, not a copy
        self._seq: int | None = None
        self._last = ContactEstimate(
            cells_per_sample=state.budget.cells_per_sample,
            covariance=state.estimate.covariance,
            systematic=state.estimate.systematic,
        )
        options.undetected = self._smallest_detectable_d(tip, material)

    def __repr__(self) -> str:
        rows, cols = self.grid.shape
        gain = "free" if self._options.free_gain else "fixed"
        return f"ContactEstimator: {rows} × {cols} cells, noise {self.noise:g} Pa, {gain} gain"

    def _lay_out(self, tip: Fingertip, material: Material, alive: NDArray[np.bool_]) -> None:
        """Set up the model, the cell arrays, and the window of cells that a contact can press.

        At the edges of a sensor that is smaller than the tip, the window includes cells beyond the
        sensor. They are unused, but the error budget compares each cell with these neighbours.
        """
        grid, state, options = self.grid, self.state, self.state.options
        radius = tip.radius + 3.0 * grid.blur
        wide = np.pad(alive, NEIGHBOURS, mode="edge")
        beyond = replace(grid, rows=wide.shape[0], cols=wide.shape[1])
        window = beyond.on(tip)
        reached = cell_centres(window, wide, radius)[0].reshape(wide.shape) >= 0.0
        top, bottom = _range(np.flatnonzero(reached.any(axis=1)))
        left, right = _range(np.flatnonzero(reached.any(axis=0)))
        within = slice(top, bottom), slice(left, right)
        alive = np.pad(alive, NEIGHBOURS)[within]
        window.x += window.pitch_x * left
        window.y += window.pitch_y * top
        window.rows, window.cols = alive.shape
        state.grid.assign(window)
        self._frame = np.zeros(alive.shape)
        self._flat = self._frame.reshape(-1)
        # The part of the sensor in the window, and its place in ``_frame``.
        top, bottom, left, right = (at - NEIGHBOURS for at in (top, bottom, left, right))
        self._window = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
        rows, cols = np.empty(grid.shape)[self._window].shape
        self._inside = self._frame[max(-top, 0) :, max(-left, 0) :][:rows, :cols]
        cells = self._cells = new_cells(*alive.shape)
        cells.reach[:], cells.x[:], cells.y[:] = cell_centres(window, alive, radius)
        options.number = int(np.count_nonzero(cells.reach >= 0.0))
        pixels, weights = np.zeros((0, 0)), Weights()
        if options.is_solid:
            images = beyond.images(tip).reshape(-1, *wide.shape)[:, *within]
            images = images.reshape(-1, alive.size)
            pixels, cells.sensitivity[SHEAR_X:] = pixels_of(images[:-2]), images[-2:]
            weights = weights_of(tip, material)
            options.deepest, options.sine_max = weights.table.deepest, math.sin(weights.table.tilt)
        else:
            options.deepest, options.sine_max = _DEEPEST * tip.radius, _SINE_MAX
        fineness = _FINENESS_LINEAR if material.is_linear else _FINENESS_NONLINEAR
        points = points_of(window, material, grid.blur, count_for(window, fineness))
        # Arguments of the kernel, except the state and the frame.
        self._arrays = cells, points, pixels, weights.array

    def _pattern(self, tip: Fingertip, alive: NDArray[np.bool_]) -> FloatArray:
        """Compute, store and return a solid tip's contact pattern [rows, cols]."""
        pattern = self.grid.images(tip)[0].reshape(self.grid.shape) * alive
        pattern = np.where(alive, pattern - pattern.sum() / alive.sum(), 0.0)
        pattern /= math.sqrt((pattern**2).sum())
        self._inside[...] = pattern[self._window]
        self._cells.pattern[:] = self._flat
        return np.asarray(pattern)

    def _smallest_detectable_d(self, tip: Fingertip, material: Material) -> float:
        """Return the smallest d [m] at which the activity test detects an upright contact."""
        high = min(self._options.deepest, D_MAX * tip.radius)
        low = 1e-6 * high
        for _ in range(14):
            d = math.sqrt(low * high)
            self(self.grid.pressure(tip, material, d))
            low, high = (low, d) if self.state.signal.contact else (d, high)
        return high

    @property
    def noise(self) -> float:
        """Standard deviation of a cell's noise [Pa]. It must be positive."""
        return float(self._options.noise)

    @noise.setter
    def noise(self, noise: float) -> None:
        if not (math.isfinite(noise) and noise > 0.0):
            raise ValueError(f"noise must be positive [Pa], got {noise}")
        self._options.noise = noise

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """Estimate the contact from this frame alone, and return a new result.

        See :meth:`update` for the arguments and exceptions.
        """
        estimate = self.state.estimate
        before, seq, last = self._estimate.copy(), self._seq, self._last
        self._last = ContactEstimate(cells_per_sample=self.state.budget.cells_per_sample)
        try:
            estimate.has_last_contact = False
            found = self.update(frame, pascal_per_count)
            found.covariance[:] = estimate.covariance
            found.systematic[:] = estimate.systematic
            return found
        finally:
            self._estimate[:], self._seq, self._last = before, seq, last

    def update(
        self, frame: NDArray[Any], pascal_per_count: float = 1.0, seq: int | None = None
    ) -> ContactEstimate:
        """Estimate the contact from this frame, starting the fit from the last estimate.

        Parameters
        ----------
        frame
            Readings [rows, cols] of type uint8, uint16, float32 or float64. For integer types, the
            quantisation noise is added to the cell noise.
        pascal_per_count
            Conversion factor from readings to Pa.
        seq
            Sequence number. If the number equals that of the last frame, the last result is
            returned.

        Returns
        -------
        ContactEstimate
            Result; every call overwrites and returns the same object.

        Raises
        ------
        ValueError
            If the frame has the wrong shape or type, or if ``pascal_per_count`` is not positive.
        """
        if seq is not None and seq == self._seq:
            return self._last
        full = _SATURATION_COUNTS.get(frame.dtype) if isinstance(frame, np.ndarray) else None
        if full is None:
            kind = getattr(frame, "dtype", type(frame).__name__)
            raise ValueError(f"a frame must be uint8, uint16, float32 or float64, got {kind}")
        if frame.shape != self.grid.shape:
            raise ValueError(f"a frame must have shape {self.grid.shape}, got {frame.shape}")
        if not 0.0 < pascal_per_count < math.inf:
            raise ValueError(f"pascal_per_count must be positive, got {pascal_per_count}")
        saturation = full if self.saturation is None else self.saturation
        # Copy the frame. The compiled code requires a fixed type and memory layout, and a writable
        # array.
        self._inside[...] = frame[self._window]
        step = self._quantum if full == math.inf else pascal_per_count
        estimate_frame(
            self.state.array, self._flat, float(pascal_per_count), float(step), float(saturation),
            *self._arrays,
        )  # fmt: skip
        result = self._last
        for name, value in zip(_RESULTS, self._results.item(), strict=True):
            setattr(result, name, value)
        result.invalid = REASONS[result.invalid]
        # The threshold of χ² at 5 σ follows from the Wilson-Hilferty approximation.
        variance = 2.0 / (9.0 * max(result.cells / result.cells_per_sample - 4, 1))
        result.misfit = result.chi2 > (1.0 - variance + 5.0 * math.sqrt(variance)) ** 3
        self._seq = seq
        return result

    def reset(self) -> None:
        """Discard the last estimate, so that the next frame is estimated from scratch."""
        self.state.estimate.has_last_contact = False
        self._seq = None


def _with_data_errors(known: Uncertainty, tip: Fingertip, free_gain: bool) -> Uncertainty:
    """Add the data errors of a solid tip, determined by independent finite-element analyses.

    The pressure error is included only if the gain is free. The pressure error is as symmetric as
    the pressure itself. With a fixed gain, a symmetric error hardly affects d.
    """
    data = solid_data(tip)
    smooth = data.pressure_error if free_gain else 0.0
    modulus, smooth = math.hypot(known.modulus, data.error), math.hypot(known.smooth, smooth)
    return replace(known, modulus=modulus, smooth=smooth)
