"""The likelihood of a solid tip's frame, and its maximum by Gauss-Newton, as kernels.

The model is Σ_j w_j(d, n_x, n_y) P_j with fixed pictures P_j (`sensing.solid_pressure`). So a frame
is projected on the pictures once, and the iteration works on these sums and on the pictures'
products alone. Cells that don't read the pressure as it is, since it ends at a floor or is cut at 0
where the model pulls, are given what they would have read, by the model before: the frame is then
projected again until that settles.

A shear force on the face adds two pictures of its own, which look much like a tilt's. It is fitted
along, by taking out of all other pictures what they share with these two.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.compiled.simd import IntPointer, Pointer, address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.gauss_newton import GAIN_CURVATURE, solve
from softfinger.kinematics.estimation.likelihood import CLIP, CLIP_END
from softfinger.kinematics.estimation.state import EstimatorState
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.solid_pressure import (
    PICTURES,
    Weights,
    add_picture,
    pictures_of,
    weigh,
    weights_of,
)

_PASSES = 24  # projections of a frame
_LIMITED = 4  # of them that may end where the data do, one after the other
_SETTLED = 0.1  # squared step, in units of the noise floor, at which readings by the model stay
_MOST_HALVINGS = 5
_LOST = 0.01  # squared noise floor that a picture may count to be left out
_NEAR = 0.03  # rad round a contact for which that holds
_STARTS = 8  # depths from which a frame alone is fitted

Sums = Annotated[FloatArray, PICTURES]
Products = Annotated[FloatArray, PICTURES, PICTURES]
Likeness = Annotated[FloatArray, PICTURES, 2]  # how much of each shear picture is in each other


class SolidFit(Record):
    """A solid tip's pictures over a grid's live cells, and one frame's sums over them."""

    weights: Weights
    cells: int
    packed: int  # where in the arena the pictures of live cells start [pictures, cells]
    readings: int  # likewise [cells]
    model: int
    projected: Sums  # Σ picture · reading
    count: int  # pictures that count in the contact at work: the first ones
    low: int  # those of m ≤ 2
    first: float  # mean of the first picture, which any contact shows most
    spread: float  # √Σ(first picture − mean)²
    plain: Products  # Σ picture · picture over live cells, shear's two last
    products: Products  # the same without what is like shear
    used: Products  # and over the cells that count in this frame
    whole: Likeness
    likeness: Likeness  # in this frame
    shear: Pair  # of the model [Pa]
    strongest: float  # cell of shear's pictures
    sides: Annotated[FloatArray, 4, PICTURES]  # products times columns of the Jacobian
    d: float  # of the contact at work
    n_x: float
    n_y: float
    square: float  # Σ reading², each as it is compared with the model
    raw: float  # and as it came
    counted: float  # cells
    limited: bool  # the last step ended where the data do


def solid_fit(tip: Fingertip, material: Material, live: FloatArray) -> SolidFit:
    """The fit's memory for the pictures of ``live`` cells, float64 [pictures, cells]."""
    fit = SolidFit()
    fit.weights.assign(weights_of(tip, material))
    count, fit.cells = live.shape
    fit.plain[:count, :count] = plain = live @ live.T
    both = plain[-2:, -2:]
    fit.whole[: count - 2] = likeness = plain[:-2, -2:] @ np.linalg.inv(both)
    fit.products[: count - 2, : count - 2] = plain[:-2, :-2] - likeness @ both @ likeness.T
    fit.strongest = np.abs(live[-2:]).max()
    fit.first = live[0].mean()
    fit.spread = live[0].std() * math.sqrt(fit.cells)
    low = fit.weights.harmonics[: fit.weights.modes] <= 2
    fit.low = pictures_of(fit.weights.harmonics[: fit.weights.modes][low])
    return fit


@fast_inner_kernel
def _dot(a: Pointer, b: Pointer, count: int) -> float:
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


@inner_kernel
def presses(
    state: EstimatorState, solid: SolidFit, frame: Pointer, arena: Pointer, places: IntPointer
) -> bool:
    """Whether the frame shows the first picture, by more than ``patch_level`` deviations.

    The mean over the cells is taken off both, so that a shift of all their zeros, or noise that
    ends at 0, is no contact. Much of a solid tip's pressure is spread over its base: a weak contact
    shows in all cells together long before it does in any neighbourhood.
    """
    readings = further(arena, solid.readings)
    total = 0.0
    for k in range(solid.cells):
        readings[k] = frame[places[k]]
        total += readings[k]
    shown = _dot(further(arena, solid.packed), readings, solid.cells)
    level = state.options.patch_level * state.signal.noise * solid.spread
    return bool(shown - solid.first * total > level)


@inner_kernel
def _counting(state: EstimatorState, solid: SolidFit) -> int:
    """How many pictures count at the contact, and near it: the others are well within the noise."""
    weights = solid.weights
    weigh(weights, solid.d, solid.n_x, solid.n_y)
    least = _LOST * state.signal.variance / (state.fit.gain * state.fit.gain)
    count = weights.pictures
    while count > solid.low:
        j = count - 1
        near = _NEAR * max(abs(weights.by_x[j]), abs(weights.by_y[j]))
        shown = max(abs(weights.value[j]), near)
        if shown * shown * solid.products[j, j] > least:
            break
        count = j
    return count


@fast_inner_kernel
def _set_model(solid: SolidFit, arena: Pointer, gain: float) -> None:
    model = further(arena, solid.model)
    for k in range(solid.cells):
        model[k] = 0.0
    for j in range(solid.count):
        picture = further(arena, solid.packed + j * solid.cells)
        add_picture(picture, gain * solid.weights.value[j], 0, solid.cells, model)
    for k in range(2):
        picture = further(arena, solid.packed + (solid.weights.pictures + k) * solid.cells)
        add_picture(picture, solid.shear[k], 0, solid.cells, model)


@inner_kernel
def _excess(model: float, floor: float, clip: float) -> float:
    """How much more a cell reads on average than the model, cut at 0, with noise at ``floor``."""
    pressure = max(model, 0.0)
    most = max(pressure, floor) - model
    if clip > 0.0:
        z = abs(pressure - floor) / clip
        if z < CLIP_END:
            above = 1.0 - z * (1.0 / CLIP_END)
            base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
            most += clip * above * above * base
    return most


@inner_kernel
def _read(
    state: EstimatorState,
    solid: SolidFit,
    frame: Pointer,
    arena: Pointer,
    height: Pointer,
    places: IntPointer,
) -> bool:
    """Take the frame's live cells, as they would read the model without ends, and project them.

    Whether any cell was changed, so that this depends on the model.
    """
    signal = state.signal
    readings = further(arena, solid.readings)
    model = further(arena, solid.model)
    floor = max(signal.floor, 0.0)
    clip = math.sqrt(signal.variance) if signal.clipped else 0.0
    near = floor + CLIP_END * clip
    count = solid.count
    pictures = solid.weights.pictures + 2
    solid.counted = float(solid.cells)
    square = raw = 0.0
    changed = False
    for k in range(solid.cells):
        at = places[k]
        reading = frame[at] * signal.scale
        pressure = model[k]
        outlier = height[at] < 0.0
        full = reading >= signal.saturation and pressure >= signal.saturation
        raw += 0.0 if outlier else reading * reading
        if full or outlier:
            # Saturated, or an outlier: it doesn't count.
            if solid.counted == solid.cells:
                solid.used[:] = solid.plain
            for i in range(pictures):
                value = arena[solid.packed + i * solid.cells + k]
                for j in range(pictures):
                    solid.used[i, j] -= value * arena[solid.packed + j * solid.cells + k]
            solid.counted -= 1.0
            readings[k] = 0.0
            changed = changed or full
            continue
        if pressure < near:
            reading = max(reading, signal.floor) - _excess(pressure, floor, clip)
            changed = True
        readings[k] = reading
        square += reading * reading
    solid.raw = raw
    last = further(arena, solid.packed + (pictures - 2) * solid.cells)
    x = _dot(last, readings, solid.cells)
    y = _dot(further(last, solid.cells), readings, solid.cells)
    if solid.counted == solid.cells:
        solid.likeness[:] = solid.whole
        solid.square = square - _along_shear(solid.plain, pictures, (x, y), solid.shear)
    else:
        solid.square = square - _along_shear(solid.used, pictures, (x, y), solid.shear)
        _take_out_shear(solid, pictures)
    for j in range(count):
        picture = further(arena, solid.packed + j * solid.cells)
        shown = _dot(picture, readings, solid.cells)
        solid.projected[j] = shown - solid.likeness[j, 0] * x - solid.likeness[j, 1] * y
    return changed


@inner_kernel
def _along_shear(
    products: FloatArray, pictures: int, sums: tuple[float, float], shear: FloatArray
) -> float:
    """Fit shear's two pictures alone: ``shear`` by their ``sums``, and the squares they explain."""
    k = pictures - 2
    x, y = sums
    p = products[k, k]
    q = products[k, k + 1]
    r = products[k + 1, k + 1]
    inverse = 1.0 / (p * r - q * q)
    shear[0] = (r * x - q * y) * inverse
    shear[1] = (p * y - q * x) * inverse
    explained: float = shear[0] * x + shear[1] * y
    return explained


@inner_kernel
def _take_out_shear(solid: SolidFit, pictures: int) -> None:
    """Take what is like shear out of this frame's products, where some cells don't count."""
    count = pictures - 2
    used = solid.used
    likeness = solid.likeness
    for j in range(count):
        _along_shear(used, pictures, (used[j, count], used[j, count + 1]), likeness[j])
    for i in range(count):
        for j in range(count):
            used[i, j] -= likeness[i, 0] * used[count, j] + likeness[i, 1] * used[count + 1, j]


@inner_kernel
def _set_sums(state: EstimatorState, solid: SolidFit) -> float:
    """The normal equations at the contact; returns the sum of squares less the readings' own.

    The columns are those of `gauss_newton.solve`: ∂/∂gain, and over the gain −∂/∂d, ∂/∂n_x, ∂/∂n_y.
    """
    weights = solid.weights
    fit = state.fit
    count = solid.count
    weigh(weights, solid.d, solid.n_x, solid.n_y)
    by_d = address(weights.by_d)
    for k in range(count):
        by_d[k] = -by_d[k]
    columns = address(weights.value), by_d, address(weights.by_x), address(weights.by_y)
    sides = address(solid.sides)
    whole = solid.counted == solid.cells
    _multiply(address(solid.products if whole else solid.used), columns, count, sides)
    normal = fit.sums.normal
    right = fit.sums.right
    at = 0
    for i in range(4):
        side = further(sides, i * PICTURES)
        for j in range(i, 4):
            normal[at] = _dot(side, columns[j], count)
            at += 1
        right[i] = _dot(columns[i], address(solid.projected), count)
        right[i] -= fit.gain * _dot(further(sides, 0), columns[i], count)
    cost: float = -fit.gain * (right[0] + _dot(columns[0], address(solid.projected), count))
    fit.sums.misfit = solid.square + cost
    return cost


@fast_inner_kernel
def _multiply(
    matrix: Pointer,
    columns: tuple[Pointer, Pointer, Pointer, Pointer],
    count: int,
    out: Pointer,
) -> None:
    """The symmetric ``matrix`` [PICTURES, PICTURES] times four columns, into ``out`` by rows."""
    a, b, c, d = columns
    for k in range(4 * PICTURES):
        out[k] = 0.0
    for j in range(count):
        row = further(matrix, j * PICTURES)
        p = a[j]
        q = b[j]
        r = c[j]
        s = d[j]
        for k in range(count):
            out[k] += p * row[k]
            out[PICTURES + k] += q * row[k]
            out[2 * PICTURES + k] += r * row[k]
            out[3 * PICTURES + k] += s * row[k]


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
    most = math.sin(table.tilt)
    solid.limited = d > table.deepest or tilt > most
    if tilt > most:
        n_x *= most / tilt
        n_y *= most / tilt
    solid.d = min(max(d, 0.3 * solid.d, 1e-4 * table.radius), table.deepest)
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
        if not cost <= before + variance and halvings < _MOST_HALVINGS:
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


@inner_kernel
def start_solid(
    state: EstimatorState,
    solid: SolidFit,
    frame: Pointer,
    arena: Pointer,
    height: Pointer,
    places: IntPointer,
) -> None:
    """The best of some contacts, straight and tilted, into ``state.estimate``: where a fit starts.

    A first contact of no depth lets every cell read what it reads.
    """
    estimate = state.estimate
    fit = state.fit
    deepest = solid.weights.table.deepest
    clip = further(arena, solid.model)
    for k in range(solid.cells):
        clip[k] = math.inf
    solid.count = solid.low
    _read(state, solid, frame, arena, height, places)
    best = math.inf
    tilt = 0.5 * math.sin(solid.weights.table.tilt)
    for k in range(_STARTS):
        solid.d = deepest * ((k + 0.5) / _STARTS) ** 2
        for m in range(5):
            solid.n_x = tilt if m == 1 else -tilt if m == 2 else 0.0
            solid.n_y = tilt if m == 3 else -tilt if m == 4 else 0.0
            fit.gain = state.options.fixed_gain
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


@inner_kernel
def fit_solid(
    state: EstimatorState,
    solid: SolidFit,
    frame: Pointer,
    arena: Pointer,
    height: Pointer,
    places: IntPointer,
    tolerance: float,
) -> bool:
    """As `gauss_newton.fit`; False also where the contact is beyond what the data cover."""
    estimate = state.estimate
    fit = state.fit
    solid.d = min(estimate.d, solid.weights.table.deepest)
    solid.n_x = estimate.n_x
    solid.n_y = estimate.n_y
    fit.gain = estimate.gain
    total = 0
    limited = 0
    for _ in range(_PASSES):
        solid.count = _counting(state, solid)
        x = solid.shear[0]
        y = solid.shear[1]
        _set_model(solid, arena, fit.gain)
        changed = _read(state, solid, frame, arena, height, places)
        # What is read off the model settles more slowly than Gauss-Newton does.
        steps = _descend(state, solid, min(tolerance, _SETTLED) if changed else tolerance)
        total += steps
        if steps == 0:
            return False
        # What the pictures leave of the shear that was fitted alone.
        for k in range(2):
            for j in range(solid.count):
                solid.shear[k] -= fit.gain * solid.likeness[j, k] * solid.weights.value[j]
        limited = limited + 1 if solid.limited else 0
        if limited == _LIMITED:
            return False
        sheared = solid.strongest * math.hypot(solid.shear[0] - x, solid.shear[1] - y)
        same = steps == 1 or not (changed or _counting(state, solid) > solid.count)
        if same and limited == 0 and sheared < 0.5 * math.sqrt(state.signal.variance):
            return _finish(state, solid, total)
    return False


@inner_kernel
def _finish(state: EstimatorState, solid: SolidFit, iterations: int) -> bool:
    """The estimate and its covariance at the fit's end."""
    fit = state.fit
    estimate = state.estimate
    free = state.options.free_gain
    variance = state.signal.variance
    freedom = solid.counted - (6.0 if free else 5.0)
    area = state.grid.radius * state.grid.radius
    along = area * math.cos(state.options.rotation)
    across = area * math.sin(state.options.rotation)
    estimate.shear_x = along * solid.shear[0] - across * solid.shear[1]
    estimate.shear_y = across * solid.shear[0] + along * solid.shear[1]
    misfit = max(fit.sums.misfit - fit.decrement, 0.0)
    estimate.d = solid.d
    estimate.n_x = solid.n_x
    estimate.n_y = solid.n_y
    estimate.gain = fit.gain
    estimate.chi2 = misfit / (variance * max(freedom, 1.0))
    estimate.cells = int(solid.counted)
    estimate.iterations = iterations
    estimate.residual = misfit - solid.raw
    # A misfit beyond its own scatter widens the covariance, and so does an uncertain d.
    wider = max(estimate.chi2 - 3.0 * math.sqrt(2.0 / max(freedom, 1.0)), 1.0) * variance
    if free:
        spread = wider * fit.inverse[1, 1] / (solid.d * solid.d)
        wider *= 1.0 + GAIN_CURVATURE * min(spread, 1.0)
    # From (gain, d, n_x, n_y) to (d, n_x, n_y, gain).
    for i in range(4):
        for j in range(4):
            fit.covariance[(i + 3) % 4, (j + 3) % 4] = wider * fit.inverse[i, j]
    return bool(freedom > 0.0)
