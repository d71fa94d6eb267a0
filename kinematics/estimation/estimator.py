"""Pressure grid → displacement, tilt, gain and their covariance.

Holds `ContactEstimator` and its result. The ladder it climbs for a frame, in one compiled call, is
in ladder.py: an activity test (activity.py); centroid and extent over the footprint (moments.py);
Gauss-Newton on the likelihood of every cell in the footprint (gauss_newton.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation import frame_pipeline, scratch
from softfinger.kinematics.estimation.blurred_cells import parts_to_fit, weights
from softfinger.kinematics.estimation.cell_centres import HEIGHT, cell_middles
from softfinger.kinematics.estimation.likelihood import fit_law
from softfinger.kinematics.estimation.moments import moment_ratios
from softfinger.kinematics.sensing.cell_integrals import CELL_PLANES, LIVE, face_integrals
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


@dataclass(slots=True)
class ContactEstimate:
    """What one frame says about the contact; SI units, angles in rad.

    ``contact``: something presses. ``valid``: the numbers can be used; without contact d and the
    tilts are 0 and that is valid. ``covariance`` is of (d, tilt_x, tilt_y, gain); a fixed gain has
    a zero row, and without contact all is zero. ``chi2`` is the misfit's square a cell over the
    noise's, ``explained`` the share of the frame's squared pressure that the model accounts for;
    both are 0 where nothing was fitted, as by the moments. ``misfit`` tells a contact that is
    another than the model's.
    """

    contact: bool = False
    valid: bool = False
    d: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    gain: float = 1.0
    chi2: float = 0.0
    explained: float = 0.0
    peak: float = 0.0  # largest cell [Pa]
    cells: int = 0  # cells in the fit
    iterations: int = 0
    rejected: int = 0  # hot cells left out
    second: bool = False  # something else presses too, off the footprint
    covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def misfit(self) -> bool:
        """χ² is beyond what the noise makes once in 3.5 million frames (Wilson-Hilferty, 5 σ).

        So the numbers are those of a contact that this model doesn't describe, or the noise is
        larger than was told; the covariance is widened then, but knows no bias.
        """
        spread = 2.0 / (9.0 * max(self.cells - 4, 1))
        return self.chi2 > (1.0 - spread + 5.0 * math.sqrt(spread)) ** 3

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


class ContactEstimator:
    """Estimates the contact under one tip from frames of a pressure grid.

    Takes the tip, its material, the grid, and ``noise``, a cell's standard deviation [Pa].
    ``method`` is "ml" (maximum likelihood) or "moments". ``free_gain`` also estimates measured over
    modelled pressure; otherwise ``gain`` is taken. ``live`` [rows, cols] bool masks dead cells.
    ``saturation`` is the reading [counts, or Pa for float frames] at which a cell is full; by
    default an integer type's largest value. ``threshold`` is the smallest count the board sends,
    0 stands for all below; for integer frames. ``quantum`` [Pa] is the width of a count where float
    frames are made of counts, which end at 0; 0 where they are not. ``tolerance`` stops the
    iteration once the squared step, in units of the noise floor, is below it (below 1 where it
    started from the frame alone): a step leaves an error of its square's order, so one of 4 σ ends
    well inside the noise.
    ``peak_level`` and ``patch_level`` set the activity test, see
    :func:`estimation.detection.activity`; ``explained_min`` is the share of the frame's squared
    pressure below which an estimate is not valid.

    Raises ValueError for arguments out of their range.
    """

    def __init__(
        self,
        tip: Fingertip,
        material: Material,
        grid: SensorGrid,
        noise: float,
        *,
        method: Literal["ml", "moments"] = "ml",
        free_gain: bool = True,
        gain: float = 1.0,
        live: NDArray[np.bool_] | None = None,
        saturation: float | None = None,
        threshold: float = 0.0,
        quantum: float = 0.0,
        tolerance: float = 16.0,
        iterations: int = 20,
        peak_level: float = 3.0,
        patch_level: float = 4.9,
        explained_min: float = 0.8,
    ) -> None:
        if not (math.isfinite(noise) and noise > 0.0):
            raise ValueError(f"noise must be a positive number of Pa, got {noise}")
        if method not in ("ml", "moments"):
            raise ValueError(f"method must be 'ml' or 'moments', got {method!r}")
        if not (math.isfinite(gain) and gain > 0.0):
            raise ValueError(f"gain must be positive, got {gain}")
        if not 0.0 <= threshold < math.inf:
            raise ValueError(f"threshold must not be negative, got {threshold}")
        if not 0.0 <= quantum < math.inf:
            raise ValueError(f"quantum must not be negative, got {quantum}")
        if live is not None and np.shape(live) != grid.shape:
            raise ValueError(f"live must have shape {grid.shape}, got {np.shape(live)}")
        self.grid = grid
        geometry = grid.geometry(tip)
        rows, cols = grid.shape
        self.saturation = saturation
        self._quantum = quantum
        self._cells = np.zeros((rows, CELL_PLANES, cols))
        face_integrals(geometry, self._cells)
        alive = np.ones(grid.shape, dtype=bool) if live is None else np.asarray(live, dtype=bool)
        middles, bounds = cell_middles(geometry, alive, tip.radius + 3.0 * grid.blur)
        # A blur reaches cells that no contact is looked for in; whatever they read, it's not used.
        self._cells[:, LIVE] = (middles[HEIGHT] >= 0.0).reshape(grid.shape)
        self._tables = np.concatenate(
            [moment_ratios(tip, material).ravel(), fit_law(material.law).ravel()]
        )
        self._floats, self._integers = scratch.make(
            middles, bounds, grid.shape, _parts(grid, tip) if grid.blur > 0.0 else None
        )
        plan = np.zeros(frame_pipeline.OPTIONS)
        plan[:5] = geometry
        plan[frame_pipeline.NOISE] = noise
        plan[frame_pipeline.SATURATION] = math.inf
        plan[frame_pipeline.FREE_GAIN] = free_gain
        plan[frame_pipeline.FIXED_GAIN] = gain
        plan[frame_pipeline.TOLERANCE] = tolerance
        plan[frame_pipeline.ITERATIONS_MAX] = iterations
        plan[frame_pipeline.MOMENTS_ONLY] = method == "moments"
        plan[frame_pipeline.PEAK_LEVEL] = peak_level
        plan[frame_pipeline.PATCH_LEVEL] = patch_level
        plan[frame_pipeline.EXPLAINED_MIN] = explained_min
        plan[frame_pipeline.MODULUS] = material.reference_modulus
        plan[frame_pipeline.ROTATION] = grid.rotation
        plan[frame_pipeline.BLUR] = grid.blur
        # Counts are rounded, so the smallest one sent stands for half a count less and up.
        plan[frame_pipeline.FLOOR] = max(threshold - 0.5, 0.0)
        self._plan = plan
        self._state = np.zeros(frame_pipeline.STATE)
        self._frame = np.zeros((rows, cols))
        self._seq: int | None = None
        self._last = ContactEstimate(
            covariance=self._state[frame_pipeline.COVARIANCE :].reshape(4, 4)
        )

    @property
    def saturation(self) -> float | None:
        """The reading at which a cell is full; None for an integer type's largest value.

        Set it anew where another zero is taken off the readings. Raises ValueError for one that is
        not positive.
        """
        return self._saturation

    @saturation.setter
    def saturation(self, reading: float | None) -> None:
        if reading is not None and not reading > 0.0:
            raise ValueError(f"saturation must be positive, got {reading}")
        self._saturation = reading

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """Estimate from this frame alone: a new result, whatever frames came before.

        Frames as for :meth:`update`. Raises ValueError for a wrong shape or type.
        """
        kept = self._state.copy()
        try:
            self._state[frame_pipeline.WARM] = 0.0
            self._run(frame, pascal_per_count)
            covariance = self._state[frame_pipeline.COVARIANCE :].reshape(4, 4).copy()
            return self._tell(ContactEstimate(covariance=covariance))
        finally:
            self._state[:] = kept

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
        self._run(frame, pascal_per_count)
        self._seq = seq
        return self._tell(self._last)

    def reset(self) -> None:
        """Forget the last estimate: the next frame starts cold."""
        self._state[frame_pipeline.WARM] = 0.0
        self._seq = None

    def compiled_arguments(
        self,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
        """What :func:`estimation.frame_pipeline.estimate_frame` takes behind the frame and its
        scale.

        For callers that are compiled themselves. Options, cells, tables, state, floats, integers;
        the arrays are the estimator's own. Saturation is as for the last frame of :meth:`update`.
        """
        return (
            self._plan,
            self._cells,
            self._tables,
            self._state,
            self._floats,
            self._integers,
        )

    def _run(self, frame: NDArray[Any], pascal_per_count: float) -> None:
        full = _FULL.get(frame.dtype) if isinstance(frame, np.ndarray) else None
        if full is None:
            kind = getattr(frame, "dtype", type(frame).__name__)
            raise ValueError(f"a frame is uint8, uint16, float32 or float64, got {kind}")
        if frame.shape != self.grid.shape:
            raise ValueError(f"a frame must have shape {self.grid.shape}, got {frame.shape}")
        if not 0.0 < pascal_per_count < math.inf:
            raise ValueError(f"pascal_per_count must be positive, got {pascal_per_count}")
        self._plan[frame_pipeline.SATURATION] = (
            full if self._saturation is None else self._saturation
        )
        # One copy makes every type, layout and read-only frame the same to the compiled entry.
        np.copyto(self._frame, frame)
        frame_pipeline.estimate_frame(
            self._frame,
            float(pascal_per_count),
            self._quantum if full == math.inf else float(pascal_per_count),
            *self.compiled_arguments(),
        )

    def _tell(self, result: ContactEstimate) -> ContactEstimate:
        state = self._state[: frame_pipeline.TOLD].tolist()
        result.contact = state[frame_pipeline.CONTACT] > 0.0
        result.valid = state[frame_pipeline.VALID] > 0.0
        result.d = state[frame_pipeline.D]
        result.tilt_x = state[frame_pipeline.TILT_X]
        result.tilt_y = state[frame_pipeline.TILT_Y]
        result.gain = state[frame_pipeline.GAIN]
        result.chi2 = state[frame_pipeline.CHI2]
        result.explained = state[frame_pipeline.EXPLAINED]
        result.peak = state[frame_pipeline.PEAK]
        result.cells = int(state[frame_pipeline.CELLS])
        result.iterations = int(state[frame_pipeline.ITERATIONS])
        result.rejected = int(state[frame_pipeline.REJECTED])
        result.second = state[frame_pipeline.SECOND] > 0.0
        return result


def _parts(grid: SensorGrid, tip: Fingertip) -> scratch.Parts:
    """The parts of cells that a blurred grid is modelled on."""
    pitch_x, pitch_y = grid.pitches
    number = parts_to_fit(grid.blur / pitch_x), parts_to_fit(grid.blur / pitch_y)
    (across, along), finer = grid.finer(number)
    planes = np.zeros((finer.rows, CELL_PLANES, finer.cols))
    face_integrals(finer.geometry(tip), planes)
    planes[:, LIVE] = 1.0
    return scratch.Parts(
        number,
        (len(across) // 2, len(along) // 2),
        # By the remainder of a part's column first.
        weights(across, number[0]).reshape(-1, number[0]).T.ravel(),
        weights(along, number[1]),
        planes,
    )
