"""A solid tip's part of `error_budget`: its patterns of error, as sums of images.

A frame is a sum of images, and so is what it changes by where the tip stands elsewhere, or the
cells are wider: each image has its change. All sums over cells of images and changes are made
once, so that a frame's own take products of matrices alone.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.solid_data import solid_data
from softfinger.kinematics.estimation.error_budget import (
    Uncertainty,
    add_second_order,
    add_square,
    add_turned,
    both_ways,
    correlate,
    deepen,
    project_shared_errors,
    quadratic,
    set_errors,
    smooth_misfit,
    smooth_square,
    turn,
)
from softfinger.kinematics.estimation.gauss_newton import set_covariance
from softfinger.kinematics.estimation.solid_projection import (
    SolidFit,
    columns_at,
    dot,
    multiply,
    set_model,
    solid_kernel,
)
from softfinger.kinematics.estimation.state import PLACE_X, SOURCES, EstimatorState, Fit, Matrix
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import IMAGES

# What the fit makes of a motion besides its straight answer, as fractions of d and of the tilt by
# the square of the motion in depth over d, and of d by that of the turn: measured with shifts of 1
# kPa and of 0.5 mm.
# … and of a face that goes on during a scan, of the radius: with 0.2 mm over 58 mm, 0.5 to 7 mm.
_D_BY_SKEW, _TILT_BY_SKEW = 0.5, 0.19
_D_BY_DEPTH, _TILT_BY_DEPTH, _D_BY_ROTATION = 0.4, 1.2, 1.6
# Of the tilt, over d/a: half of what another base than set makes of it, which few sensors show.
_TILT_BY_BASE = 0.2
_TILTED = math.radians(15.0)  # where the data's error of the pressure was measured


def set_solid_budget(
    state: EstimatorState,
    solid: SolidFit,
    known: Uncertainty,
    grid: SensorGrid,
    tip: Fingertip,
    indices: IntArray,
    law: float,
) -> None:
    """Set the budget as `error_budget.set_budget` does, for the cells ``indices`` of ``grid``.

    A shift is no contact to a solid tip whatever its size: the activity test takes the mean off.
    What the data are off by counts, too: the force, and the pressure as far as the tip is tilted.
    Upright an error of theirs is as symmetric as they are, and with a known gain hardly moves d.
    """
    data, budget = solid_data(tip), solid.budget
    known = replace(known, modulus=math.hypot(known.modulus, data.error))
    if state.options.free_gain:
        known = replace(known, smooth=math.hypot(known.smooth, data.pressure_error))
    else:
        budget.tilted = data.pressure_error / math.sin(_TILTED)
    set_errors(state, known, grid, law)
    active = np.ascontiguousarray(grid.images(tip)[:, indices])
    shear = active[-2:]
    across = np.linalg.inv(shear @ shear.T)

    def alone(fields: FloatArray) -> FloatArray:
        """Return the fields less their projection on shear."""
        return np.asarray(fields - fields @ shear.T @ across @ shear)

    basis = alone(active)
    count = len(active) - 2
    cells = grid.on(tip)
    rows, cols = np.divmod(indices, grid.cols)
    x_of = (cells.x + cells.pitch_x * (cols + 0.5)) / tip.radius
    y_of = (cells.y + cells.pitch_y * (rows + 0.5)) / tip.radius
    planes = alone(np.stack([np.ones(len(indices)), x_of, y_of]))
    budget.shift[:, :count] = planes @ basis[:count].T
    budget.shifts[:] = (planes**2).sum(axis=1)
    scaled = max(known.pitch, known.radius)
    for k, (x, y, scaling) in enumerate(
        ((known.centre, 0.0, 0.0), (0.0, known.centre, 0.0), (0.0, 0.0, scaled))
    ):
        size = max(x, y, scaling)
        if size > 0.0:
            displacement = alone(
                (
                    _elsewhere(grid, x, y, scaling).images(tip)[:, indices]
                    - _elsewhere(grid, -x, -y, -scaling).images(tip)[:, indices]
                )
                / (2.0 * size)
            )
            budget.displacement[k, : count + 2, :count] = displacement @ basis[:count].T
            budget.squares[k, : count + 2, : count + 2] = displacement @ displacement.T
    if state.budget.correlated:
        rho = both_ways(known.correlation)

        def correlated_sums(fields: FloatArray) -> FloatArray:
            whole = np.zeros((len(fields), grid.rows * grid.cols))
            whole[:, indices] = fields
            return quadratic(whole.T.reshape(grid.rows, grid.cols, -1), rho)

        budget.correlated_sums[:count, :count] = correlated_sums(basis[:count])
        budget.shear = float((across * correlated_sums(shear)).sum())
        first = active[:1] - active[0].mean()
        state.options.patch_level *= math.sqrt(correlated_sums(first)[0, 0] / (first**2).sum())


def _elsewhere(grid: SensorGrid, x: float, y: float, scaling: float) -> SensorGrid:
    """The grid with the tip's centre moved, and with wider cells."""
    wider = 1.0 + scaling
    return replace(
        grid,
        pitch=(grid.pitches[0] * wider, grid.pitches[1] * wider),
        centre=(grid.centre[0] * wider + x, grid.centre[1] * wider + y),
    )


@fast_inner_kernel
def _apply(matrix: Pointer, values: Pointer, rows: int, count: int, out: Pointer) -> None:
    """``values`` times rows of a ``matrix`` [·, PICTURES]: its first ``count`` columns."""
    for k in range(count):
        out[k] = 0.0
    for j in range(rows):
        row = further(matrix, j * IMAGES)
        value = values[j]
        for k in range(count):
            out[k] += value * row[k]


@solid_kernel(project_shared_errors)
def _project_shared_errors(solid: SolidFit, state: EstimatorState, packed: Pointer) -> None:
    budget = solid.budget
    count = solid.count
    each = columns_at(solid)
    images = solid.weights.images
    whole = address(budget.whole)
    for k in range(images):
        whole[k] = each[0][k]
    for k in range(2):
        whole[images + k] = solid.shear[k] / state.fit.gain
    scaled = max(state.budget.pitch, state.budget.radius)
    sizes = (state.budget.centre, state.budget.centre, scaled)
    sums = address(budget.sums)
    for source in range(SOURCES):
        change = sums
        if source < PLACE_X:
            state.budget.squares[source] = budget.shifts[source]
            change = further(address(budget.shift), source * IMAGES)
        elif sizes[source - PLACE_X] > 0.0:
            start = (source - PLACE_X) * IMAGES * IMAGES
            squares = further(address(budget.squares), start)
            _apply(squares, whole, images + 2, images + 2, sums)
            state.budget.squares[source] = dot(sums, whole, images + 2)
            changes = further(address(budget.displacement), start)
            _apply(changes, whole, images + 2, count, sums)
        else:
            continue
        for column in range(4):
            state.budget.responses[column, source] = dot(each[column], change, count)


@solid_kernel(add_second_order)
def _add_second_order(solid: SolidFit, state: EstimatorState, d: float, out: Matrix) -> None:
    displacement = state.budget.displacement
    square = min((displacement[1] / d) ** 2, 1.0)
    rotated = (
        _D_BY_ROTATION
        * d
        * min(displacement[2] * displacement[2] + displacement[3] * displacement[3], 1.0)
    )
    deeper = _D_BY_DEPTH * d * square
    along_x = _TILT_BY_DEPTH * solid.n_x * square
    along_y = _TILT_BY_DEPTH * solid.n_y * square
    out[1, 1] += deeper * deeper + rotated * rotated
    out[2, 2] += along_x * along_x
    out[2, 3] += along_x * along_y
    out[3, 2] += along_x * along_y
    out[3, 3] += along_y * along_y


@solid_kernel(smooth_square)
def _smooth_square(solid: SolidFit, state: EstimatorState) -> float:
    tilted = solid.budget.tilted * solid.budget.tilted
    square = solid.n_x * solid.n_x + solid.n_y * solid.n_y
    return state.budget.smooth * state.budget.smooth + tilted * square


@solid_kernel(deepen)
def _deepen(solid: SolidFit, state: EstimatorState, change: float) -> None:
    state.budget.displacement[1] += change


@solid_kernel(turn)
def _turn(
    solid: SolidFit, state: EstimatorState, rotation: float, skew: float, out: Matrix
) -> None:
    add_turned(solid.n_x, solid.n_y, rotation, out)
    a = state.grid.radius
    displacement = state.budget.displacement
    displacement[0] = displacement[2] = 0.0
    displacement[1] = skew * _D_BY_SKEW * a * solid.n_y
    displacement[3] = skew * _TILT_BY_SKEW * a / solid.d
    add_square(displacement, out)
    displacement[1] = 0.0
    displacement[2] = _TILT_BY_BASE * solid.d / a * solid.n_x
    displacement[3] = _TILT_BY_BASE * solid.d / a * solid.n_y
    add_square(displacement, out)


@solid_kernel(correlate)
def _correlate(solid: SolidFit, state: EstimatorState, d: float) -> float:
    fit = state.fit
    first = 0 if state.options.free_gain else 1
    count = solid.count
    columns = columns_at(solid)
    sides = address(solid.sides)
    multiply(address(solid.budget.correlated_sums), columns, count, sides)
    factor = (1.0, -fit.gain, fit.gain, fit.gain)
    # JᵀCJ times the inverse, then the inverse times that.
    half = fit.matrix
    work = solid.budget.work
    for i in range(4):
        for j in range(4):
            both = dot(further(sides, i * IMAGES), columns[j], count)
            work[i, j] = factor[i] * factor[j] * both
    trace = 0.0
    for i in range(first, 4):
        for j in range(first, 4):
            value = 0.0
            for m in range(first, 4):
                value += work[i, m] * fit.inverse[m, j]
            half[i, j] = value
        trace += half[i, i]
    for i in range(first, 4):
        for j in range(first, 4):
            value = 0.0
            for m in range(first, 4):
                value += fit.inverse[i, m] * half[m, j]
            work[i, j] = value
    for i in range(first, 4):
        for j in range(first, 4):
            fit.inverse[i, j] = work[i, j]
    # Shear's two are off the cells' number already.
    return trace + solid.budget.shear - 2.0


@solid_kernel(smooth_misfit)
def _smooth_misfit(solid: SolidFit, state: EstimatorState, packed: Pointer) -> tuple[float, float]:
    set_model(solid, packed, state.fit.gain)
    model = further(packed, solid.model)
    readings = further(packed, solid.readings)
    total = 0.0
    number = 0.0
    for k in range(1, solid.cells):
        # Cells that don't count read 0.
        if readings[k] != 0.0 and readings[k - 1] != 0.0:
            total += (readings[k] - model[k]) * (readings[k - 1] - model[k - 1])
            number += 1.0
    return total, number


@solid_kernel(set_covariance)
def _set_covariance(
    solid: SolidFit, fit: Fit, inverse: Matrix, variance: float, out: Matrix
) -> None:
    # From (gain, d, n_x, n_y) to (d, n_x, n_y, gain).
    for i in range(4):
        for j in range(4):
            out[(i + 3) % 4, (j + 3) % 4] = variance * inverse[i, j]
