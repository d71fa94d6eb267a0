"""Errors that one frame doesn't show as noise from cell to cell, carried into its covariance.

With J the Jacobian by (gain, u, v, w), JᵀJ = L Lᵀ, white noise of σ² leaves σ² (JᵀJ)⁻¹. Besides:

    correlated noise   σ² L⁻ᵀ K L⁻¹,   K(d) = L⁻¹ Jᵀ C J L⁻ᵀ                     (`correlate`)
    shared error q     m mᵀ,   m = size (JᵀJ)⁻¹ Jᵀq                              (`systematic`)
      of second order  (0.7 d Δ²)² + (0.8 d ω²)² + (1.6 ω² d²/a)² in d, … (`add_second_order`)
      it leaves        Σ size² qᵀq − m·(size Jᵀq)
    smooth error       W (JᵀJ)⁻¹ W smooth² Σ p², p the model's pressures      (`systematic`)
    radius             m of the pitch, and d size in depth                       (`deepen`)
    rotation, scan     (n × z) rotation, and in w the way over the rows' length    (`turn`)
    smooth misfit      Σ r_k r_(k−1) − n ρ₁ σ² − decrement             (`undetected_misfit`)

C is the noise's correlation by lag, as `calibrate` measures it: K, the ``variance_factor``, depends
on the footprint's size beside the correlation's and is tabulated over d. The q are images of what
is the same in every frame: a shift of all cells, its slopes in x and y, the tip's centre in x and
y, the pitch, and the modulus or gain, ``size`` their standard deviations; Δ is m's part in depth
over d, ω² = ``rotated`` its rotation squared. W² are the fractions of a smooth error's square that
look like a change of d and the gain, and of a tilt: the errors of real cells are nearly as
symmetric as the pressure. r_k are the residuals of the packed cells: single cells' noise adds
nothing to the product of neighbours on average, a misfit that is smooth over the footprint all of
it.

Kernels that take ``solid`` first depend on the tip: those here are of springs, and `solid_budget`
has a solid tip's, of which a scene compiles the ones it needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.likelihood import BY_U, BY_V, BY_W, STRESS
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import (
    DEPTHS,
    PLACE_X,
    PLACE_Y,
    READING,
    SCALING,
    SHIFT,
    SLOPE_X,
    SLOPE_Y,
    SOURCES,
    WEIGHT,
    Budget,
    EstimatorState,
    Four,
    Matrix,
)
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_DEEPEST = 0.75  # of the radius: the end of the table over d
NEIGHBOURS = np.outer((1.0, 2.0, 2.0, 2.0, 1.0), (1.0, 2.0, 2.0, 2.0, 1.0))  # see `detection`
NEIGHBOURS[2, 2] = 0.0
_PEAK = 4.5  # standard deviations of the cell that noise alone makes the largest
_FEW = 48.0  # cells within which nothing is smooth or rough
# What the fit makes of a motion besides its straight answer, as fractions of d and of the gain by
# the square of the motion in depth over d and of the turn, and by that of the turn times d/a in any
# direction: measured over the envelope, with shifts of 1 kPa, of 0.5 mm, of 1 % of the pitch and 5
# % of the modulus.
_D_BY_DEPTH, _GAIN_BY_DEPTH = 0.7, 0.6
_D_BY_ROTATION, _GAIN_BY_ROTATION, _BY_ROTATION_AT_DEPTH = 0.8, 2.0, 1.6
# Of an error's squares, smooth over a footprint: what d (and the gain), each tilt, and no parameter
# has. Curves, hysteresis and crosstalk are nearly as symmetric as the pressure.
_SMOOTH_IN_DEPTH, _SMOOTH_IN_TILT, _SMOOTH_LEFT = 0.15, 0.06, 0.2
_SURE = 6.0  # standard deviations that noise alone hardly makes of neighbours' products


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of what a sensor's frames have in common, and how its noise correlates.

    ``baseline``: of a shift of all cells [Pa], ``slope``: of the same from the tip's middle to its
    rim, in x and in y [Pa]; ``centre``: of the tip's place on the sensor, in x and in y [m];
    ``rotation``: of the sensor [rad]; ``pitch``, ``radius``, ``modulus`` and ``gain`` (of all cells
    alike): relative; ``smooth``: of a cell's pressure, relative, where neighbours share it, by
    another curve, hysteresis or crosstalk; ``skew``: of the way [m] that the face goes during one
    scan of the rows. ``correlation`` [rows, cols] is that of two
    cells' noise by their distance in rows and columns, 1 at [0, 0] and 0 beyond; None for white
    noise.
    """

    baseline: float = 0.0
    centre: float = 0.0
    pitch: float = 0.0
    modulus: float = 0.0
    correlation: FloatArray | None = None
    slope: float = 0.0
    gain: float = 0.0
    smooth: float = 0.0
    rotation: float = 0.0
    radius: float = 0.0
    skew: float = 0.0

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self) if each.name != "correlation"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.correlation is not None:
            rho = np.asarray(self.correlation, np.float64)
            if rho.ndim != 2 or not np.isfinite(rho).all() or not abs(rho[0, 0] - 1.0) < 1e-6:
                raise ValueError("correlation must be [rows, cols], with 1 at [0, 0]")
            object.__setattr__(self, "correlation", rho)


def set_errors(state: EstimatorState, known: Uncertainty, grid: SensorGrid, law: float) -> None:
    """Fill in what depends on no tip.

    ``law`` [Pa] is how far the material's law is off the points that it was made from: to the
    cells that it presses that is like a shift.
    """
    budget = state.budget
    budget.shift = math.hypot(known.baseline, law)
    budget.baseline, budget.slope = known.baseline, known.slope
    budget.centre, budget.pitch, budget.radius = known.centre, known.pitch, known.radius
    budget.modulus = 0.0 if state.options.free_gain else math.hypot(known.modulus, known.gain)
    budget.smooth, budget.rotation = known.smooth, known.rotation
    budget.skew = known.skew / (grid.rows * grid.pitches[1])
    sizes = budget.shift, budget.slope, budget.centre, budget.pitch, budget.radius, budget.modulus
    budget.systematic = max(*sizes, budget.smooth, budget.rotation, budget.skew) > 0.0
    budget.cells_per_sample = 1.0
    if known.correlation is not None and known.correlation.size > 1:
        rho = both_ways(known.correlation)
        budget.correlated = True
        budget.cells_per_sample = float((rho**2).sum())
        budget.along = float(known.correlation[0, 1]) if known.correlation.shape[1] > 1 else 0.0


def set_budget(
    state: EstimatorState, known: Uncertainty, grid: SensorGrid, tip: Fingertip, law: float
) -> None:
    """Fill in the budget, and raise the activity test's level to what the errors alone may make."""
    set_errors(state, known, grid, law)
    budget, options = state.budget, state.options
    level = options.patch_level
    weights = NEIGHBOURS
    norm = float(np.sqrt((weights**2).sum()))
    if budget.correlated:
        rho = both_ways(known.correlation)
        _set_variance_factor(budget, rho, grid, tip, options.free_gain)
        with_centre = float((weights * _fitted(rho, 5)).sum())
        variance = float(quadratic(weights, rho)) - with_centre**2
        level = (level * math.sqrt(max(variance, 0.0)) + _PEAK * max(with_centre, 0.0)) / norm
    # A shift of twice the baseline's standard deviation is no contact.
    options.patch_level = level + 2.0 * known.baseline / options.noise * weights.sum() / norm


def both_ways(correlation: FloatArray | None) -> FloatArray:
    """Return the correlation [2 rows − 1, 2 cols − 1] by lags of both signs."""
    assert correlation is not None
    rows, cols = correlation.shape
    return np.asarray(
        correlation[np.abs(np.arange(1 - rows, rows))][:, np.abs(np.arange(1 - cols, cols))]
    )


def _fitted(rho: FloatArray, size: int) -> FloatArray:
    """The middle [size, size] of ``rho``, with zeros where it has none."""
    out = np.zeros((size, size))
    for i in range(size):
        for j in range(size):
            at = i - size // 2 + rho.shape[0] // 2, j - size // 2 + rho.shape[1] // 2
            if 0 <= at[0] < rho.shape[0] and 0 <= at[1] < rho.shape[1]:
                out[i, j] = rho[at]
    return out


def quadratic(fields: FloatArray, rho: FloatArray) -> FloatArray:
    """Return Σ over pairs of cells of field · ρ · field, for fields [rows, cols] or […, n]."""
    several = fields.reshape(*fields.shape[:2], -1)
    shape = [n + m for n, m in zip(fields.shape[:2], rho.shape, strict=True)]
    kernel = np.zeros(shape)
    kernel[: rho.shape[0], : rho.shape[1]] = rho
    kernel = np.roll(kernel, (-(rho.shape[0] // 2), -(rho.shape[1] // 2)), (0, 1))
    # A measured correlation may want a negative power at some frequency, which no noise has.
    power = np.maximum(np.fft.fft2(kernel).real, 0.0)
    waves = np.fft.fft2(several, shape, axes=(0, 1))
    out = np.einsum("xyi,xy,xyj->ij", waves.conj(), power, waves).real / power.size
    return np.asarray(out if fields.ndim == 3 else out[0, 0])


def _set_variance_factor(
    budget: Budget, rho: FloatArray, grid: SensorGrid, tip: Fingertip, free: bool
) -> None:
    """K = L⁻¹ JᵀCJ L⁻ᵀ over d, J by (gain, u, v, w) at no tilt, JᵀJ = LLᵀ, C the correlation.

    For a constant modulus: how smooth J is hardly depends on the law, nor on the tilt.
    """
    material, a = Material.constant(1.0), tip.radius
    for k in range(DEPTHS):
        d = _DEEPEST * a * ((k + 1) / DEPTHS) ** 2

        def at(d: float, x: float = 0.0, y: float = 0.0) -> FloatArray:
            return grid.pressure(tip, material, d, x, y)

        step = 1e-4
        columns = [
            at(d),
            (at(d * (1.0 - step)) - at(d * (1.0 + step))) / (2.0 * step * d),  # by u = a − d
            (at(d, step) - at(d, -step)) / (2.0 * step),
            (at(d, 0.0, step) - at(d, 0.0, -step)) / (2.0 * step),
        ][0 if free else 1 :]
        jacobian = np.stack(columns, axis=2)
        jacobian /= np.sqrt((jacobian**2).sum(axis=(0, 1)))
        white = np.einsum("xyi,xyj->ij", jacobian, jacobian)
        inverse = np.linalg.inv(np.linalg.cholesky(white))
        first = 4 - len(columns)
        budget.variance_factor[k, first:, first:] = inverse @ quadratic(jacobian, rho) @ inverse.T


@inner_kernel
def correlate(solid: SolidFit | None, state: EstimatorState, d: float) -> float:
    """Make ``fit.inverse`` the covariance under correlated noise of variance 1; the trace of K."""
    fit = state.fit
    budget = state.budget
    first = 0 if state.options.free_gain else 1
    t = DEPTHS * math.sqrt(d / (_DEEPEST * state.grid.radius)) - 1.0
    t = min(max(t, 0.0), DEPTHS - 1.001)
    k = int(t)
    t -= k
    work = budget.work
    trace = 0.0
    for i in range(first, 4):
        for j in range(first, 4):
            work[i, j] = (1.0 - t) * budget.variance_factor[k, i, j] + t * budget.variance_factor[
                k + 1, i, j
            ]
        trace += work[i, i]
    # (JᵀJ)⁻¹ = AᵀA with A = lower · scale.
    half = fit.matrix
    for i in range(first, 4):
        for j in range(first, 4):
            value = 0.0
            for m in range(j, 4):
                value += work[i, m] * fit.lower[m, j]
            half[i, j] = value * fit.scale[j]
    for i in range(first, 4):
        for j in range(first, 4):
            value = 0.0
            for m in range(i, 4):
                value += fit.lower[m, i] * half[m, j]
            fit.inverse[i, j] = value * fit.scale[i]
    return trace


@fast_inner_kernel
def smooth_misfit(
    solid: SolidFit | None, state: EstimatorState, packed: Pointer
) -> tuple[float, float]:
    """Return Σ over neighbouring packed cells of the product of residuals [Pa²], and their number.

    Noise of single cells adds nothing to it on average, what is smooth over the footprint all.
    """
    gain = state.fit.gain
    saturation = state.signal.saturation
    # Nearer to the floor, readings that end there are more than the pressure.
    floor = state.signal.floor + 2.0 * state.fit.clip
    size = state.model.rows * state.model.cols
    total = 0.0
    number = 0.0
    for k in range(1, state.fit.count):
        here = gain * packed[STRESS * size + k]
        before = gain * packed[STRESS * size + k - 1]
        y = packed[READING * size + k]
        z = packed[READING * size + k - 1]
        weight = packed[WEIGHT * size + k] * packed[WEIGHT * size + k - 1]
        counts = (max(here, before) < saturation) & (min(here, before) > floor)
        weight = weight if counts else 0.0
        total += weight * (y - here) * (z - before)
        number += weight
    return total, number


@inner_kernel
def undetected_misfit(
    solid: SolidFit | None, state: EstimatorState, packed: Pointer, beyond: float
) -> float:
    """Return the square sum [Pa²] of misfit smooth over the footprint; 0 within the noise.

    ``beyond`` [Pa²] is all that it leaves beyond what is expected: in a footprint of few cells no
    part of that can be told from smooth.
    """
    total, number = smooth_misfit(solid, state, packed)
    variance = state.signal.variance
    # What the last step takes off is not in the packed cells yet.
    total -= number * variance * state.budget.along + state.fit.decrement
    total = beyond if number < _FEW else min(total, beyond)
    if total <= _SURE * variance * math.sqrt(number * state.budget.cells_per_sample):
        return 0.0
    return total


@fast_inner_kernel
def project_shared_errors(solid: SolidFit | None, state: EstimatorState, packed: Pointer) -> None:
    """Set Jᵀq and qᵀq of the shared errors q."""
    face = state.fit.face
    u = face.u
    v = face.v
    w = face.w
    a2 = state.model.radius * state.model.radius
    per_radius = 1.0 / state.model.radius
    # Variances of x and of y in a cell, times 4.
    xx_cell = state.model.pitch_x * state.model.pitch_x / 3.0
    yy_cell = state.model.pitch_y * state.model.pitch_y / 3.0
    size = state.model.rows * state.model.cols
    responses = address(state.budget.responses)
    squares = address(state.budget.squares)
    for column in range(4):
        plane = column * size  # STRESS, BY_U, BY_V, BY_W stand first
        shift = slope_x = slope_y = along_x = along_y = scaling = 0.0
        n = nx = ny = xx = yy = ss = 0.0
        for k in range(state.fit.count):
            g = packed[BY_U * size + k]
            per_g = 1.0 / g if g > 0.0 else 0.0
            x = packed[BY_V * size + k] * per_g
            y = packed[BY_W * size + k] * per_g
            # The strain is 1 − (u − v x − w y) g with g = 1/√(a² − x² − y²), so ∂g/∂x = x g³.
            q = max(a2 - x * x - y * y, 0.01 * a2)
            # Near the rim the mean of g³ over a cell is more than its middle's.
            wide = (xx_cell * x * x + yy_cell * y * y) / (q * q)
            steep = (u - v * x - w * y) * (1.0 + 0.5 * min(wide, 1.0)) / q
            by_x = g * (v - steep * x)
            by_y = g * (w - steep * y)
            own = packed[WEIGHT * size + k] * packed[plane + k]
            whole = 1.0 if g > 0.0 else 0.0
            by_pitch = x * by_x + y * by_y
            shift += own * whole
            slope_x += own * x
            slope_y += own * y
            along_x += own * by_x
            along_y += own * by_y
            scaling += own * by_pitch
            n += whole
            nx += x * x
            ny += y * y
            xx += by_x * by_x
            yy += by_y * by_y
            ss += by_pitch * by_pitch
        out = further(responses, SOURCES * column)
        out[SHIFT] = shift
        out[SLOPE_X] = per_radius * slope_x
        out[SLOPE_Y] = per_radius * slope_y
        out[PLACE_X] = along_x
        out[PLACE_Y] = along_y
        out[SCALING] = scaling
        squares[SHIFT] = n
        squares[SLOPE_X] = nx / a2
        squares[SLOPE_Y] = ny / a2
        squares[PLACE_X] = xx
        squares[PLACE_Y] = yy
        squares[SCALING] = ss


@inner_kernel
def add_second_order(solid: SolidFit | None, state: EstimatorState, d: float, out: Matrix) -> None:
    """Add the second-order error of the shift ``budget.displacement`` to the covariance ``out``."""
    fit = state.fit
    displacement = state.budget.displacement
    gain = fit.gain
    u = fit.face.u
    v = fit.face.v
    w = fit.face.w
    n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
    deeper = (
        n_z * (u * n_z * n_z * (v * displacement[2] + w * displacement[3]) - displacement[1]) / d
    )
    square = min(deeper * deeper, 1.0)
    rotated = min(displacement[2] * displacement[2] + displacement[3] * displacement[3], 1.0)
    d_by_rotation = _D_BY_ROTATION * d * rotated
    tilted = _BY_ROTATION_AT_DEPTH * rotated * d / state.grid.radius
    out[1, 1] += (_D_BY_DEPTH * d * square) ** 2 + d_by_rotation * d_by_rotation + (tilted * d) ** 2
    out[2, 2] += tilted * tilted
    out[3, 3] += tilted * tilted
    if state.options.free_gain:
        gain_by_rotation = _GAIN_BY_ROTATION * gain * rotated
        out[0, 0] += (_GAIN_BY_DEPTH * gain * square) ** 2 + gain_by_rotation * gain_by_rotation
        out[0, 0] += (tilted * gain) ** 2
        out[0, 1] += d_by_rotation * gain_by_rotation
        out[1, 0] += d_by_rotation * gain_by_rotation


@inner_kernel
def deepen(solid: SolidFit | None, state: EstimatorState, change: float) -> None:
    """Add a ``change`` of d [m] to the shift ``budget.displacement``."""
    v = state.fit.face.v
    w = state.fit.face.w
    state.budget.displacement[1] -= change * math.sqrt(1.0 + v * v + w * w)


@inner_kernel
def turn(
    solid: SolidFit | None, state: EstimatorState, rotation: float, skew: float, out: Matrix
) -> None:
    """Add what a rotated grid and a face that goes on during a scan do to the covariance ``out``.

    The first turns the tilt with it. The second's change, y ∂p/∂u, is that of w to springs.
    """
    v = state.fit.face.v
    w = state.fit.face.w
    add_turned(v, w, rotation, out)
    out[3, 3] += skew * skew * (1.0 + v * v + w * w)


@inner_kernel
def add_turned(x: float, y: float, rotation: float, out: Matrix) -> None:
    """Add the covariance of a vector (x, y), the last two of ``out``, by its ``rotation``."""
    square = rotation * rotation
    out[2, 2] += square * y * y
    out[2, 3] -= square * x * y
    out[3, 2] -= square * x * y
    out[3, 3] += square * x * x


@inner_kernel
def smooth_square(solid: SolidFit | None, state: EstimatorState) -> float:
    """Return the square of the relative error of a cell's pressure that neighbours share."""
    return state.budget.smooth * state.budget.smooth


@inner_kernel
def add_square(displacement: Four, out: Matrix) -> None:
    """Add the covariance of a shift by ``displacement``."""
    for i in range(4):
        for j in range(4):
            out[i, j] += displacement[i] * displacement[j]


@inner_kernel
def systematic(
    solid: SolidFit | None, state: EstimatorState, packed: Pointer, d: float, out: Matrix
) -> float:
    """Compute the covariance of (gain, u, v, w) by what all frames share, into ``out``.

    ``fit.inverse`` is that of white noise of variance 1 [Pa²]. Returns the square sum [Pa²] that
    the fit leaves of it where each is twice its standard deviation.
    """
    fit = state.fit
    budget = state.budget
    gain = fit.gain
    project_shared_errors(solid, state, packed)
    factor = (1.0, -gain, gain, gain)
    # The pattern of the modulus is the pressure itself, that of the radius the pitch's.
    sizes = (
        budget.shift,
        budget.slope,
        budget.slope,
        gain * budget.centre,
        gain * budget.centre,
        gain * budget.pitch,
        gain * budget.radius,
        gain * budget.modulus,
    )
    displacement = budget.displacement
    pressure = fit.sums.normal[0]
    smooth = smooth_square(solid, state) * gain * gain * pressure
    deep = math.sqrt(_SMOOTH_IN_DEPTH * smooth)
    tilted = math.sqrt(_SMOOTH_IN_TILT * smooth)
    parts = (deep, deep, tilted, tilted)
    for i in range(4):
        for j in range(4):
            out[i, j] = parts[i] * parts[j] * fit.inverse[i, j]
    remaining: float = _SMOOTH_LEFT * smooth
    for source in range(SOURCES + 2):
        size = sizes[source]
        if size == 0.0:
            continue
        image = min(source, SCALING)
        own = source <= SOURCES
        remaining += size * size * (budget.squares[image] if own else pressure)
        for i in range(4):
            displacement[i] = 0.0
        for j in range(4):
            response = budget.responses[j, image] if own else fit.sums.normal[j]
            response *= factor[j] * size
            for i in range(4):
                displacement[i] += fit.inverse[i, j] * response
        for j in range(4):
            response = budget.responses[j, image] if own else fit.sums.normal[j]
            remaining -= displacement[j] * response * factor[j] * size
        add_second_order(solid, state, d, out)
        if source == SOURCES:
            # A wider tip looks like finer cells, and then its d is as much more.
            deepen(solid, state, d * budget.radius)
        add_square(displacement, out)
    turn(solid, state, budget.rotation, budget.skew, out)
    return 4.0 * max(remaining, 0.0)
