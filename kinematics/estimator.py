"""Pressure grid → displacement, tilt, gain and their covariance.

Holds `ContactEstimator` and the one compiled entry it calls for a frame. The ladder: an activity test;
centroid and extent over the footprint (moments.py); Gauss-Newton on the likelihood of every cell in
the footprint (likelihood.py). The frame-to-frame path starts from the last estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kinematics.cells import face_integrals
from kinematics.contact import Fingertip
from kinematics.footprint import plane
from kinematics.kernels import kernel
from kinematics.likelihood import PLANES, accumulate, cubic_law, pack
from kinematics.material import Material
from kinematics.moments import activity, bounded, coarse, refine
from kinematics.pressure import SensorGrid

FloatArray = NDArray[np.float64]

# Places in the estimator's state: what a frame's call leaves, and where the next one starts.
(
    WARM,
    CONTACT,
    VALID,
    D,
    N_X,
    N_Y,
    GAIN,
    CHI2,
    EXPLAINED,
    ITERATIONS,
    CELLS,
    PEAK,
) = range(12)
COVARIANCE = 12  # 4 × 4 of (d, n_x, n_y, gain)
STATE = COVARIANCE + 16

# Places in the options.
(
    NOISE,
    SATURATION,
    FREE_GAIN,
    FIXED_GAIN,
    TOLERANCE,
    ITERATIONS_MAX,
    MOMENTS_ONLY,
    PEAK_LEVEL,
    PATCH_LEVEL,
    EXPLAINED_MIN,
    MODULUS,
) = range(11)
OPTIONS = 11


@kernel
def _solve(sums, gain, free, step, inverse):
    """Gauss-Newton step (gain, u, v, w) and the inverse normal matrix; returns (ok, decrement).

    Without a free gain its row is taken out. ``inverse`` [4, 4] is in (gain, u, v, w).
    """
    matrix = np.empty((4, 4))
    right = np.empty(4)
    k = 0
    for i in range(4):
        for j in range(i, 4):
            factor = 1.0
            if i > 0:
                factor *= -gain if i == 1 else gain
            if j > 0:
                factor *= -gain if j == 1 else gain
            matrix[i, j] = sums[k] * factor
            matrix[j, i] = matrix[i, j]
            k += 1
        right[i] = sums[10 + i] * (1.0 if i == 0 else -gain if i == 1 else gain)
    if not free:
        for i in range(4):
            matrix[0, i] = 0.0
            matrix[i, 0] = 0.0
        matrix[0, 0] = 1.0
        right[0] = 0.0
    # Scaled Cholesky: a pivot below 1e-10 of its column says that the frame doesn't determine all.
    scale = np.empty(4)
    for i in range(4):
        if not matrix[i, i] > 0.0:
            return False, 0.0
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(4):
        for j in range(4):
            matrix[i, j] *= scale[i] * scale[j]
    for j in range(4):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 1e-10:
            return False, 0.0
        pivot = math.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, 4):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / pivot
    # Inverse of L in place of the upper triangle's work, then L⁻ᵀ L⁻¹.
    lower = np.zeros((4, 4))
    for j in range(4):
        lower[j, j] = 1.0 / matrix[j, j]
        for i in range(j + 1, 4):
            value = 0.0
            for k in range(j, i):
                value -= matrix[i, k] * lower[k, j]
            lower[i, j] = value / matrix[i, i]
    decrement = 0.0
    for i in range(4):
        for j in range(4):
            value = 0.0
            for k in range(max(i, j), 4):
                value += lower[k, i] * lower[k, j]
            inverse[i, j] = value * scale[i] * scale[j]
    for i in range(4):
        value = 0.0
        for j in range(4):
            value += inverse[i, j] * right[j]
        step[i] = value
        decrement += value * right[i]
    if not free:
        for i in range(4):
            inverse[0, i] = 0.0
            inverse[i, 0] = 0.0
    return True, decrement


@kernel
def _covariance(inverse, a, u, v, w, variance, out):
    """Covariance of (d, n_x, n_y, gain), row-major into ``out`` [16], from that of (gain, u, v, w)."""
    n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
    cube = n_z * n_z * n_z
    jacobian = np.zeros((4, 4))
    # d = a − u n_z, n_x = v n_z, n_y = w n_z, ∂n_z/∂v = −v n_z³.
    jacobian[0, 1] = -n_z
    jacobian[0, 2] = u * v * cube
    jacobian[0, 3] = u * w * cube
    jacobian[1, 2] = n_z - v * v * cube
    jacobian[1, 3] = -v * w * cube
    jacobian[2, 2] = -v * w * cube
    jacobian[2, 3] = n_z - w * w * cube
    jacobian[3, 0] = 1.0
    for i in range(4):
        for j in range(4):
            value = 0.0
            for k in range(4):
                for m in range(4):
                    value += jacobian[i, k] * inverse[k, m] * jacobian[j, m]
            out[4 * i + j] = value * variance


@kernel
def _fit(frame, scale, geometry, cells, law, options, variance, state, columns, packed, work):
    """Gauss-Newton from the contact in ``state``; leaves the estimate there. False if it fails."""
    a = geometry[0]
    free = options[FREE_GAIN] > 0.0
    sums = work[:17]
    step = work[17:21]
    inverse = work[21:37].reshape(4, 4)
    u, v, w = plane(a, state[D], state[N_X], state[N_Y])
    gain = state[GAIN] if free else options[FIXED_GAIN]
    cost = math.inf
    previous = (u, v, w, gain)
    halvings = 0
    for iteration in range(int(options[ITERATIONS_MAX])):
        count = pack(u, v, w, geometry, cells, frame, scale, columns, packed)
        accumulate(packed, count, u, v, w, gain, options[SATURATION] * scale, law, sums)
        now = sums[14] - sums[15]
        if iteration > 0 and not now <= cost + variance and halvings < 4:
            # Too far: half way back.
            u = 0.5 * (u + previous[0])
            v = 0.5 * (v + previous[1])
            w = 0.5 * (w + previous[2])
            gain = 0.5 * (gain + previous[3])
            halvings += 1
            continue
        cost = now
        ok, decrement = _solve(sums, gain, free, step, inverse)
        if not ok:
            return False
        previous = (u, v, w, gain)
        halvings = 0
        gain = max(gain + step[0], 0.05 * gain)
        u += step[1]
        v += step[2]
        w += step[3]
        # Keep the face between the tip's top and its base plate.
        tilt = math.hypot(v, w)
        if tilt > 3.0:
            v *= 3.0 / tilt
            w *= 3.0 / tilt
        n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
        d = a - u * n_z
        limited = min(max(d, 0.3 * (a - previous[0] * n_z), 1e-4 * a), 0.95 * a)
        if limited != d:
            d = limited
            u = (a - d) / n_z
        elif decrement <= options[TOLERANCE] * variance:
            state[D] = d
            state[N_X] = v * n_z
            state[N_Y] = w * n_z
            state[GAIN] = gain
            state[ITERATIONS] = iteration + 1
            freedom = sums[16] - (4.0 if free else 3.0)
            misfit = max(sums[14] - decrement, 0.0)
            state[CHI2] = misfit / (variance * max(freedom, 1.0))
            state[CELLS] = sums[16]
            state[EXPLAINED] = misfit - sums[15]
            # A misfit beyond its own scatter widens the covariance.
            excess = max(state[CHI2] - 3.0 * math.sqrt(2.0 / max(freedom, 1.0)), 1.0)
            _covariance(inverse, a, u, v, w, variance * excess, state[COVARIANCE:])
            return freedom > 0.0
    return False


@kernel
def _start(frame, geometry, cells, runs, options, noise, peak, row, col, scale, state):
    """First estimate from the frame alone, into ``state``."""
    level = max(4.0 * noise, 0.15 * peak)
    d, n_x, n_y = coarse(frame, cells, geometry, runs, level, row, col)
    gain = 1.0
    for _ in range(2):
        d, n_x, n_y, gain = refine(frame, cells, geometry, options[MODULUS] / scale, d, n_x, n_y)
    state[D] = d
    state[N_X] = n_x
    state[N_Y] = n_y
    state[GAIN] = min(max(gain, 0.05), 20.0)


@kernel
def estimate_frame(
    frame, scale, step, geometry, cells, runs, law, options, state, columns, packed, work
):
    """One frame → the estimate in ``state``. The only compiled entry of the estimator.

    ``frame`` float64 [rows, cols] in counts, ``scale`` Pa a count, ``step`` the width of the counts'
    quantum [Pa], 0 for none.
    """
    variance = options[NOISE] ** 2 + step * step / 12.0
    noise = math.sqrt(variance) / scale
    row, col, peak, lowest, finite = activity(
        frame, cells, runs, noise, options[PEAK_LEVEL], options[PATCH_LEVEL]
    )
    warm = state[WARM] > 0.0
    state[WARM] = 0.0
    state[PEAK] = peak * scale
    state[CONTACT] = 0.0
    state[CHI2] = 0.0
    state[EXPLAINED] = 0.0
    state[ITERATIONS] = 0.0
    state[CELLS] = 0.0
    # A baseline far below zero is a sensor to tare, not a hand without contact.
    state[VALID] = 1.0 if finite and lowest > -12.0 * noise else 0.0
    if row < 0 or not finite:
        state[D] = 0.0
        state[N_X] = 0.0
        state[N_Y] = 0.0
        state[GAIN] = options[FIXED_GAIN]
        state[COVARIANCE:] = 0.0
        return
    state[CONTACT] = 1.0
    done = False
    if options[MOMENTS_ONLY] > 0.0:
        if warm:
            d, n_x, n_y, gain = refine(
                frame, cells, geometry, options[MODULUS] / scale, state[D], state[N_X], state[N_Y]
            )
            warm = gain > 0.0
            state[D], state[N_X], state[N_Y], state[GAIN] = d, n_x, n_y, gain
        if not warm:
            _start(frame, geometry, cells, runs, options, noise, peak, row, col, scale, state)
        state[COVARIANCE:] = 0.0
        state[EXPLAINED] = 1.0
        done = True
    else:
        energy = 0.0
        for i in range(frame.shape[0]):
            energy += _row_energy(frame, cells, i, runs[i, 0], runs[i, 1])
        energy *= scale * scale
        for attempt in range(2):
            if attempt == 0 and not warm:
                continue
            if attempt == 1:
                _start(frame, geometry, cells, runs, options, noise, peak, row, col, scale, state)
            if _fit(
                frame, scale, geometry, cells, law, options, variance, state, columns, packed, work
            ):
                # Share of the frame's pressure, squared, that the model accounts for.
                number = runs[:, 1].sum() - runs[:, 0].sum()
                misfit = energy + state[EXPLAINED] - number * variance
                state[EXPLAINED] = 1.0 - max(misfit, 0.0) / max(energy, variance)
                done = state[EXPLAINED] >= options[EXPLAINED_MIN]
            if done:
                break
    if done:
        state[WARM] = 1.0
    else:
        state[VALID] = 0.0


@kernel
def _row_energy(frame, cells, i, first, last):
    total = 0.0
    for j in range(first, last):
        value = frame[i, j] if cells[i, 3, j] > 0.0 else 0.0
        total += value * value
    return total


@dataclass(slots=True)
class ContactEstimate:
    """What one frame says about the contact; SI units, angles in rad.

    ``contact``: something presses. ``valid``: the numbers can be used (without contact d and the
    tilts are 0 and valid). ``covariance`` is of (d, tilt_x, tilt_y, gain), zero where nothing was
    fitted; a fixed gain has a zero row. ``chi2`` is the misfit's square a cell over the noise's,
    ``explained`` the share of the frame's squared pressure that the model accounts for.
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
    covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def d_std(self) -> float:
        """Standard deviation of d [m]."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def tilt_std(self) -> tuple[float, float]:
        """Standard deviations of (tilt_x, tilt_y) [rad]."""
        return math.sqrt(self.covariance[1, 1]), math.sqrt(self.covariance[2, 2])


class ContactEstimator:
    """Estimates the contact under one tip from frames of a pressure grid.

    Parameters: the tip, its material, the grid, and ``noise``, a cell's standard deviation [Pa].
    ``method`` is "ml" (maximum likelihood) or "moments". ``free_gain`` also estimates measured over
    modelled pressure; otherwise ``gain`` is taken. ``live`` [rows, cols] bool masks dead cells.
    ``saturation`` is the reading [counts, or Pa for float frames] at which a cell is full; by default
    an integer type's largest value. ``tolerance`` stops the iteration when the squared step, in units
    of the noise floor, is below it.
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
        tolerance: float = 0.3,
        iterations: int = 20,
    ) -> None:
        if not (math.isfinite(noise) and noise > 0.0):
            raise ValueError(f"noise must be a positive number of Pa, got {noise}")
        if method not in ("ml", "moments"):
            raise ValueError(f"method must be 'ml' or 'moments', got {method!r}")
        if not (math.isfinite(gain) and gain > 0.0):
            raise ValueError(f"gain must be positive, got {gain}")
        if live is not None and np.shape(live) != grid.shape:
            raise ValueError(f"live must have shape {grid.shape}, got {np.shape(live)}")
        self.grid = grid
        self._geometry = grid.geometry(tip)
        self._saturation = saturation
        self._law = cubic_law(material.law)
        rows, cols = grid.shape
        self._cells = np.zeros((rows, 4, cols))
        face_integrals(*self._geometry, self._cells)
        self._cells[:, 3] = 1.0 if live is None else np.asarray(live, dtype=bool)
        self._runs = _disc_runs(self._geometry, rows, cols)
        options = np.zeros(OPTIONS)
        options[NOISE] = noise
        options[SATURATION] = math.inf
        options[FREE_GAIN] = free_gain
        options[FIXED_GAIN] = gain
        options[TOLERANCE] = tolerance
        options[ITERATIONS_MAX] = iterations
        options[MOMENTS_ONLY] = method == "moments"
        options[PEAK_LEVEL] = 3.0
        options[PATCH_LEVEL] = 6.3
        options[EXPLAINED_MIN] = 0.6
        options[MODULUS] = material.reference_modulus
        self._options = options
        self._free = free_gain
        self._state = np.zeros(STATE)
        self._columns = np.zeros((cols + 1, 2))
        self._packed = np.zeros((PLANES, rows * cols + 1))
        self._work = np.zeros(64)
        self._frame = np.zeros((rows, cols))
        self._last = ContactEstimate()
        self._last_seq: int | None = None

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """Estimate from this frame alone: a new result, whatever frames came before.

        Frames as for :meth:`update`. Raises ValueError for a wrong shape or type.
        """
        state = self._state
        kept = state.copy()
        try:
            state[WARM] = 0.0
            self._run(frame, pascal_per_count)
            return self._read(ContactEstimate())
        finally:
            state[:] = kept

    def update(
        self, frame: NDArray[Any], pascal_per_count: float = 1.0, seq: int | None = None
    ) -> ContactEstimate:
        """Estimate from this frame, starting from the last; the one result object is reused.

        ``frame`` [rows, cols] is uint8, uint16, float32 or float64; its values times
        ``pascal_per_count`` are Pa. The quantum's noise of integer frames is added to the cells'
        noise. A ``seq`` equal to the last one's returns at once. Raises ValueError for a wrong shape
        or type.
        """
        if seq is not None and seq == self._last_seq:
            return self._last
        self._run(frame, pascal_per_count)
        self._last_seq = seq
        return self._read(self._last)

    def reset(self) -> None:
        """Forget the last estimate: the next frame starts cold."""
        self._state[:] = 0.0
        self._last_seq = None

    def warm_up(self) -> None:
        """Compile, or load from the cache, all that :meth:`update` needs, on an empty frame."""
        self(self._frame)

    def _run(self, frame: NDArray[Any], pascal_per_count: float) -> None:
        if frame.shape != self._frame.shape:
            raise ValueError(f"the frame must have shape {self._frame.shape}, got {frame.shape}")
        full = _FULL.get(frame.dtype)
        if full is None:
            raise ValueError(f"frames are uint8, uint16, float32 or float64, got {frame.dtype}")
        if not 0.0 < pascal_per_count < math.inf:
            raise ValueError(f"pascal_per_count must be positive, got {pascal_per_count}")
        self._options[SATURATION] = full if self._saturation is None else self._saturation
        # One copy makes every type, layout and read-only frame the same to the compiled entry.
        np.copyto(self._frame, frame)
        estimate_frame(
            self._frame,
            pascal_per_count,
            0.0 if full == math.inf else pascal_per_count,
            self._geometry,
            self._cells,
            self._runs,
            self._law,
            self._options,
            self._state,
            self._columns,
            self._packed,
            self._work,
        )

    def _read(self, result: ContactEstimate) -> ContactEstimate:
        (
            _,
            contact,
            valid,
            d,
            n_x,
            n_y,
            gain,
            result.chi2,
            result.explained,
            iterations,
            cells,
            result.peak,
            *covariance,
        ) = self._state.tolist()
        result.contact = contact > 0.0
        result.valid = valid > 0.0
        result.iterations = int(iterations)
        result.cells = int(cells)
        result.d = d
        result.gain = gain
        rotation = self.grid.rotation
        if rotation != 0.0:
            c, s = math.cos(rotation), math.sin(rotation)
            n_x, n_y = c * n_x - s * n_y, s * n_x + c * n_y
        result.tilt_x = math.asin(n_x)
        result.tilt_y = math.asin(n_y)
        out = result.covariance
        out.flat = covariance
        if rotation != 0.0:
            turn = np.array([[c, -s], [s, c]])
            out[1:3] = turn @ out[1:3]
            out[:, 1:3] = out[:, 1:3] @ turn.T
        # ∂tilt/∂n = 1/cos tilt.
        for k, n in ((1, n_x), (2, n_y)):
            factor = 1.0 / math.sqrt(1.0 - n * n)
            out[k] *= factor
            out[:, k] *= factor
        return result


# Accepted frame types and the reading at which a cell is full.
_FULL = {
    np.dtype(np.uint8): 255.0,
    np.dtype(np.uint16): 65535.0,
    np.dtype(np.float32): math.inf,
    np.dtype(np.float64): math.inf,
}


def _disc_runs(
    geometry: tuple[float, float, float, float, float], rows: int, cols: int
) -> NDArray[np.int64]:
    """Columns (first, last + 1) of each row's cells that the tip's disc touches, int64 [rows, 2]."""
    a, x_first, y_first, pitch_x, pitch_y = geometry
    runs = np.zeros((rows, 2), dtype=np.int64)
    for i in range(rows):
        y0 = y_first + i * pitch_y
        y1 = y0 + pitch_y
        nearest = 0.0 if y0 * y1 <= 0.0 else min(abs(y0), abs(y1))
        if nearest < a:
            half = math.sqrt(a * a - nearest * nearest)
            first = min(max(math.floor((-half - x_first) / pitch_x), 0), cols)
            last = min(max(math.ceil((half - x_first) / pitch_x), first), cols)
            runs[i] = first, last
    return runs
