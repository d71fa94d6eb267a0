"""The likelihood of a solid tip's frame, and its maximum by Gauss-Newton, as kernels.

The model is Σ_j w_j(d, n_x, n_y) P_j with fixed images P_j (`sensing.solid_pressure`). So a frame
is projected on the images once, and the iteration works on these sums and on the images'
products alone. Where the projection goes by the model before (`solid_projection`), the frame is
projected again until that settles.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import HEIGHT, cell_centres
from softfinger.kinematics.estimation.detection import presses_outside
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.gauss_newton import conclude, fit, solve
from softfinger.kinematics.estimation.moments import start
from softfinger.kinematics.estimation.solid_projection import (
    SolidFit,
    columns_at,
    counting,
    dot,
    multiply,
    project,
    set_model,
    solid_fit,
    solid_kernel,
)
from softfinger.kinematics.estimation.state import EstimatorState
from softfinger.kinematics.sensing.cell_integrals import CELL_PLANES
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import IMAGES, own_shear

_RIM = {"bonded": 0.03, "lying": 0.05}  # of the radius: nearer to a solid tip's rim none counts
CELLS_MIN = 9  # that a solid tip's contact and shear can be told from
_PASSES = 24  # projections of a frame
_LIMITED = 4  # of them that may end where the data do, one after the other
_OVER = 1.01  # of the data's ends, in d and sin θ: so far noise may take a fit at them
_SETTLED = 0.1  # squared step, in units of the noise floor, at which readings by the model stay
_HALVINGS_MAX = 5
_STARTS = 8  # depths from which a frame alone is fitted


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


def lay_out_solid(
    state: EstimatorState,
    grid: SensorGrid,
    tip: Fingertip,
    active: NDArray[np.bool_],
    material: Material,
) -> tuple[FloatArray, IntArray, SolidFit]:
    """Return a grid's scratch under a solid tip, its active cells' indices, and the fit's memory.

    Raises ValueError where there are too few.
    """
    if active.sum() < CELLS_MIN:
        raise ValueError(
            f"a solid tip needs {CELLS_MIN} active cells within its rim, got {active.sum()}"
        )
    geometry = grid.on(tip)
    state.grid.assign(geometry)
    state.model.assign(geometry)
    centres = cell_centres(geometry, active, tip.radius + 3.0 * grid.blur, state.region)
    cells = np.zeros((grid.rows, CELL_PLANES, grid.cols))
    indices = np.flatnonzero(centres[HEIGHT] >= 0.0).astype(np.int64)
    packed = np.ascontiguousarray(grid.images(tip)[:, indices])
    solid = solid_fit(tip, material, packed)
    state.at.cells = centres.size
    solid.packed = centres.size + cells.size
    solid.readings = solid.packed + packed.size
    solid.model = solid.readings + len(indices)
    arrays = centres.ravel(), cells.ravel(), packed.ravel(), np.zeros(2 * len(indices))
    return np.concatenate(arrays), indices, solid


@inner_kernel
def _set_sums(state: EstimatorState, solid: SolidFit) -> float:
    """The normal equations at the contact; returns the sum of squares less the readings' own.

    The columns are those of `gauss_newton.solve`: ∂/∂gain, and over the gain −∂/∂d, ∂/∂n_x, ∂/∂n_y.
    """
    fit = state.fit
    count = solid.count
    columns = columns_at(solid)
    sides = address(solid.sides)
    whole = solid.counted == solid.cells
    multiply(address(solid.products if whole else solid.used), columns, count, sides)
    normal = fit.sums.normal
    right = fit.sums.right
    at = 0
    for i in range(4):
        side = further(sides, i * IMAGES)
        for j in range(i, 4):
            normal[at] = dot(side, columns[j], count)
            at += 1
        right[i] = dot(columns[i], address(solid.projected), count)
        right[i] -= fit.gain * dot(further(sides, 0), columns[i], count)
    cost: float = -fit.gain * (right[0] + dot(columns[0], address(solid.projected), count))
    fit.sums.misfit = solid.square + cost
    return cost


@inner_kernel
def _go_on(state: EstimatorState, solid: SolidFit) -> None:
    """Take the step, kept within what the data cover."""
    fit = state.fit
    table = solid.weights.table
    fit.gain = max(fit.gain + fit.step[0], 0.2 * fit.gain)
    d = solid.d + fit.step[1]
    n_x = solid.n_x + fit.step[2]
    n_y = solid.n_y + fit.step[3]
    tilt = math.hypot(n_x, n_y)
    sine_max = _OVER * math.sin(table.tilt)
    deepest = _OVER * table.deepest
    solid.limited = d > deepest or tilt > sine_max
    if tilt > sine_max:
        n_x *= sine_max / tilt
        n_y *= sine_max / tilt
    solid.d = min(max(d, 0.3 * solid.d, 1e-4 * table.radius), deepest)
    solid.n_x = n_x
    solid.n_y = n_y


@inner_kernel
def _descend(state: EstimatorState, solid: SolidFit, tolerance: float) -> int:
    """Gauss-Newton on the projected frame: the number of steps, 0 where it doesn't settle."""
    fit = state.fit
    variance = state.signal.variance
    before = math.inf
    d = n_x = n_y = gain = 0.0
    halvings = 0
    for number in range(state.options.iterations):
        cost = _set_sums(state, solid)
        if not cost <= before + variance and halvings < _HALVINGS_MAX:
            solid.d = 0.5 * (solid.d + d)
            solid.n_x = 0.5 * (solid.n_x + n_x)
            solid.n_y = 0.5 * (solid.n_y + n_y)
            fit.gain = 0.5 * (fit.gain + gain)
            halvings += 1
            continue
        before = cost
        halvings = 0
        if not solve(fit, state.options.free_gain):
            return 0
        d = solid.d
        n_x = solid.n_x
        n_y = solid.n_y
        gain = fit.gain
        _go_on(state, solid)
        if fit.decrement <= tolerance * variance:
            return number + 1
        if solid.limited and solid.d == d and solid.n_x == n_x and solid.n_y == n_y:
            return number + 1
    return 0


@solid_kernel(start)
def _start(
    solid: SolidFit, state: EstimatorState, frame: Pointer, scratch: Pointer, indices: IntArray
) -> None:
    """The best of some contacts, straight and tilted, into ``state.estimate``: where a fit starts.

    A first contact of no depth lets every cell read what it reads.
    """
    estimate = state.estimate
    fit = state.fit
    deepest = solid.weights.table.deepest
    clip = further(scratch, solid.model)
    for k in range(solid.cells):
        clip[k] = math.inf
    solid.count = solid.low
    project(state, solid, frame, scratch, address(indices))
    best = math.inf
    tilt = 0.5 * math.sin(solid.weights.table.tilt)
    # Straight at each depth, then tilted at the best of them: the tilt hardly changes the force.
    for k in range(_STARTS + 4):
        m = k - _STARTS
        solid.d = deepest * ((k + 0.5) / _STARTS) ** 2 if m < 0 else estimate.d
        solid.n_x = tilt if m == 0 else -tilt if m == 1 else 0.0
        solid.n_y = tilt if m == 2 else -tilt if m == 3 else 0.0
        fit.gain = 1.0
        cost = _set_sums(state, solid)
        if state.options.free_gain:
            gain = fit.gain + fit.sums.right[0] / fit.sums.normal[0]
            cost = -gain * gain * fit.sums.normal[0]
            fit.gain = gain
        if cost < best and fit.gain > 0.0:
            best = cost
            estimate.d = solid.d
            estimate.n_x = solid.n_x
            estimate.n_y = solid.n_y
            estimate.gain = fit.gain
    solid.shear[:] = 0.0


@solid_kernel(presses_outside)
def _presses_outside(
    solid: SolidFit, state: EstimatorState, frame: Pointer, height: Pointer, level: float
) -> bool:
    # A solid tip's footprint can't be seen, and all of its base is pressed.
    return False


@solid_kernel(fit)
def _fit(
    solid: SolidFit,
    state: EstimatorState,
    frame: Pointer,
    scratch: Pointer,
    indices: IntArray,
    tolerance: float,
) -> bool:
    """False also where the contact is beyond what the data cover."""
    estimate = state.estimate
    fit = state.fit
    solid.d = min(estimate.d, solid.weights.table.deepest)
    solid.n_x = estimate.n_x
    solid.n_y = estimate.n_y
    fit.gain = estimate.gain
    total = 0
    limited = 0
    for _ in range(_PASSES):
        solid.count = counting(state, solid)
        x = solid.shear[0]
        y = solid.shear[1]
        set_model(solid, scratch, fit.gain)
        changed = project(state, solid, frame, scratch, address(indices))
        # What is read off the model settles more slowly than Gauss-Newton does.
        steps = _descend(state, solid, min(tolerance, _SETTLED) if changed else tolerance)
        total += steps
        if steps == 0:
            return False
        # What the images leave of the shear that was fitted alone.
        for k in range(2):
            for j in range(solid.count):
                solid.shear[k] -= fit.gain * solid.overlap[j, k] * solid.weights.value[j]
        limited = limited + 1 if solid.limited else 0
        if limited == _LIMITED:
            return False
        sheared = solid.strongest * math.hypot(solid.shear[0] - x, solid.shear[1] - y)
        same = steps == 1 or not (changed or counting(state, solid) > solid.count)
        if same and limited == 0 and sheared < 0.5 * math.sqrt(state.signal.variance):
            return _finish(state, solid, scratch, total)
    return False


@inner_kernel
def _finish(state: EstimatorState, solid: SolidFit, scratch: Pointer, iterations: int) -> bool:
    """The estimate and its covariance at the fit's end."""
    estimate = state.estimate
    fit = state.fit
    area = state.grid.radius * state.grid.radius
    along = area * math.cos(state.options.rotation)
    across = area * math.sin(state.options.rotation)
    square = solid.n_x * solid.n_x + solid.n_y * solid.n_y
    own = fit.gain * own_shear(solid.weights, solid.d, square)
    x = solid.shear[0] + own * solid.n_x
    y = solid.shear[1] + own * solid.n_y
    estimate.shear_x = along * x - across * y
    estimate.shear_y = across * x + along * y
    # Noise's own share beyond the data's ends is none of the contact.
    sine_max = math.sin(solid.weights.table.tilt)
    within = min(1.0, sine_max / max(math.sqrt(square), 1e-9))
    estimate.d = min(solid.d, solid.weights.table.deepest)
    estimate.n_x = within * solid.n_x
    estimate.n_y = within * solid.n_y
    fit.sums.readings = solid.raw
    fit.sums.weight = solid.counted - 2.0  # shear's
    return conclude(solid, state, scratch, iterations)
