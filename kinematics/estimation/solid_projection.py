"""A solid tip's frame, projected on the images that the model is made of, as kernels.

Cells that don't read the pressure as it is, since it ends at a floor or is cut at 0 where the model
pulls, are given what they would have read, by the model before.

A shear force on the face adds two images of its own, which look much like a tilt's. It is fitted
along, by taking out of all other images what they share with these two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, TypeAlias

import numpy as np
from numba import types

from softfinger.kinematics.compiled.kernel import Function, fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.compiled.simd import IntPointer, Pointer, address, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.likelihood import CLIP, CLIP_END
from softfinger.kinematics.estimation.state import EstimatorState, Matrix
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.solid_pressure import (
    IMAGES,
    Weights,
    add_image,
    image_count,
    set_weights,
    weights_of,
)

_LOST = 0.01  # squared noise floor that a image may count to be left out
_HYSTERESIS = 0.5  # of the level for a first contact: one that is just felt doesn't flicker
_NEAR = 0.03  # rad round a contact for which that holds

Sums = Annotated[FloatArray, IMAGES]
Products = Annotated[FloatArray, IMAGES, IMAGES]
Columns: TypeAlias = tuple[Pointer, Pointer, Pointer, Pointer]
Overlap = Annotated[FloatArray, IMAGES, 2]  # how much of each shear image is in each other


class SolidBudget(Record):
    """Sums over the cells for `solid_budget`, less what is like shear."""

    shift: Annotated[FloatArray, 3, IMAGES]  # Σ image, and times x and y over the radius
    shifts: Annotated[FloatArray, 3]  # the same of 1, x and y themselves
    displacement: Annotated[FloatArray, 3, IMAGES, IMAGES]  # Σ change of one · other image
    squares: Annotated[FloatArray, 3, IMAGES, IMAGES]  # Σ change · change
    correlated_sums: Products  # Σ over pairs of cells of image · their correlation · image
    shear: float  # the same of both of shear's alone, scaled to 1
    tilted: float  # the data's error of the pressure, relative, over the sine of the tilt
    whole: Sums  # scratch: what each image counts, with shear's
    sums: Sums  # scratch
    work: Matrix  # scratch


class SolidFit(Record):
    """A solid tip's images over a grid's active cells, and one frame's sums over them."""

    weights: Weights
    cells: int
    packed: int  # where in the scratch the images of active cells start [images, cells]
    readings: int  # likewise [cells]
    model: int
    projected: Sums  # Σ image · reading
    count: int  # images that count in the contact at work: the first ones
    low: int  # those of m ≤ 2
    first: float  # mean of the first image, which any contact shows most
    norm: float  # √Σ(first image − mean)²
    plain: Products  # Σ image · image over active cells, shear's two last
    products: Products  # the same without what is like shear
    used: Products  # and over the cells that count in this frame
    whole: Overlap
    overlap: Overlap  # in this frame
    shear: Pair  # of the model [Pa]
    strongest: float  # cell of shear's images
    sides: Annotated[FloatArray, 4, IMAGES]  # products times columns of the Jacobian
    d: float  # of the contact at work
    n_x: float
    n_y: float
    square: float  # Σ reading², each as it is compared with the model
    raw: float  # and as it came
    counted: float  # cells
    limited: bool  # the last step ended where the data do
    budget: SolidBudget


def solid_fit(tip: Fingertip, material: Material, active: FloatArray) -> SolidFit:
    """Allocate the fit's memory for the images of ``active`` cells, float64 [images, cells]."""
    fit = SolidFit()
    fit.weights.assign(weights_of(tip, material))
    count, fit.cells = active.shape
    fit.plain[:count, :count] = plain = active @ active.T
    both = plain[-2:, -2:]
    fit.whole[: count - 2] = overlap = plain[:-2, -2:] @ np.linalg.inv(both)
    fit.products[: count - 2, : count - 2] = plain[:-2, :-2] - overlap @ both @ overlap.T
    fit.strongest = np.abs(active[-2:]).max()
    fit.first = active[0].mean()
    fit.norm = active[0].std() * math.sqrt(fit.cells)
    low = fit.weights.harmonics[: fit.weights.modes] <= 2
    fit.low = image_count(fit.weights.harmonics[: fit.weights.modes][low])
    return fit


def solid_kernel(springs: Any) -> Callable[[Function], Function]:
    """Make an inner kernel that stands for ``springs`` where there is a solid tip.

    Kernels that depend on the tip take ``solid`` first, None for a tip of springs; of each pair a
    scene compiles one.
    """

    def make(function: Function) -> Function:
        made = inner_kernel(function)
        springs.also(made, lambda kind: not isinstance(kind, types.NoneType))
        return made

    return make


@fast_inner_kernel
def dot(a: Pointer, b: Pointer, count: int) -> float:
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


@inner_kernel
def columns_at(solid: SolidFit) -> Columns:
    """Return each image's weight in the contact at work, and the partials by −d, n_x and n_y."""
    weights = solid.weights
    set_weights(weights, solid.d, solid.n_x, solid.n_y)
    by_d = address(weights.by_d)
    for k in range(weights.images):
        by_d[k] = -by_d[k]
    return address(weights.value), by_d, address(weights.by_x), address(weights.by_y)


@fast_inner_kernel
def multiply(
    matrix: Pointer,
    columns: Columns,
    count: int,
    out: Pointer,
) -> None:
    """Multiply the symmetric ``matrix`` [PICTURES, PICTURES] by four columns, into ``out``."""
    a, b, c, d = columns
    for k in range(4 * IMAGES):
        out[k] = 0.0
    for j in range(count):
        row = further(matrix, j * IMAGES)
        p = a[j]
        q = b[j]
        r = c[j]
        s = d[j]
        for k in range(count):
            out[k] += p * row[k]
            out[IMAGES + k] += q * row[k]
            out[2 * IMAGES + k] += r * row[k]
            out[3 * IMAGES + k] += s * row[k]


@inner_kernel
def presses(
    state: EstimatorState, solid: SolidFit, frame: Pointer, scratch: Pointer, indices: IntPointer
) -> bool:
    """Return whether the frame shows the first image, by more than ``patch_level`` deviations.

    The mean over the cells is taken off both, so that a shift of all their zeros, or noise that
    ends at 0, is no contact. Much of a solid tip's pressure is spread over its base: a weak contact
    shows in all cells together long before it does in any neighbourhood.
    """
    readings = further(scratch, solid.readings)
    total = 0.0
    for k in range(solid.cells):
        readings[k] = frame[indices[k]]
        total += readings[k]
    projection = dot(further(scratch, solid.packed), readings, solid.cells)
    level = state.options.patch_level * state.signal.noise * solid.norm
    level *= _HYSTERESIS if state.estimate.warm else 1.0
    return bool(projection - solid.first * total > level)


@inner_kernel
def counting(state: EstimatorState, solid: SolidFit) -> int:
    """Return the number of images above the noise at the contact and near it."""
    weights = solid.weights
    set_weights(weights, solid.d, solid.n_x, solid.n_y)
    threshold = _LOST * state.signal.variance / (state.fit.gain * state.fit.gain)
    count = weights.images
    while count > solid.low:
        j = count - 1
        near = _NEAR * max(abs(weights.by_x[j]), abs(weights.by_y[j]))
        projection = max(abs(weights.value[j]), near)
        if projection * projection * solid.products[j, j] > threshold:
            break
        count = j
    return count


@fast_inner_kernel
def set_model(solid: SolidFit, scratch: Pointer, gain: float) -> None:
    model = further(scratch, solid.model)
    for k in range(solid.cells):
        model[k] = 0.0
    for j in range(solid.count):
        image = further(scratch, solid.packed + j * solid.cells)
        add_image(image, gain * solid.weights.value[j], 0, solid.cells, model)
    for k in range(2):
        image = further(scratch, solid.packed + (solid.weights.images + k) * solid.cells)
        add_image(image, solid.shear[k], 0, solid.cells, model)


@inner_kernel
def _excess(model: float, floor: float, clip: float) -> float:
    """Return the mean excess of a cell over the model, cut at 0, with noise at ``floor``."""
    pressure = max(model, 0.0)
    excess = max(pressure, floor) - model
    if clip > 0.0:
        z = abs(pressure - floor) / clip
        if z < CLIP_END:
            above = 1.0 - z * (1.0 / CLIP_END)
            base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
            excess += clip * above * above * base
    return excess


@inner_kernel
def project(
    state: EstimatorState, solid: SolidFit, frame: Pointer, scratch: Pointer, indices: IntPointer
) -> bool:
    """Take the frame's active cells, as they would read the model without ends, and project them.

    Whether any cell was changed, so that this depends on the model.
    """
    signal = state.signal
    readings = further(scratch, solid.readings)
    model = further(scratch, solid.model)
    height = further(scratch, state.at.centres)
    floor = max(signal.floor, 0.0)
    clip = math.sqrt(signal.variance) if signal.clipped else 0.0
    near = floor + CLIP_END * clip
    count = solid.count
    images = solid.weights.images + 2
    solid.counted = float(solid.cells)
    square = raw = 0.0
    changed = False
    for k in range(solid.cells):
        at = indices[k]
        reading = frame[at] * signal.scale
        pressure = model[k]
        outlier = height[at] < 0.0
        full = reading >= signal.saturation and pressure >= signal.saturation
        raw += 0.0 if outlier else reading * reading
        if full or outlier:
            # Saturated, or an outlier: it doesn't count.
            if solid.counted == solid.cells:
                solid.used[:] = solid.plain
            for i in range(images):
                value = scratch[solid.packed + i * solid.cells + k]
                for j in range(images):
                    solid.used[i, j] -= value * scratch[solid.packed + j * solid.cells + k]
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
    last = further(scratch, solid.packed + (images - 2) * solid.cells)
    x = dot(last, readings, solid.cells)
    y = dot(further(last, solid.cells), readings, solid.cells)
    if solid.counted == solid.cells:
        solid.overlap[:] = solid.whole
        solid.square = square - _along_shear(solid.plain, images, (x, y), solid.shear)
    else:
        solid.square = square - _along_shear(solid.used, images, (x, y), solid.shear)
        _remove_shear(solid, images)
    for j in range(count):
        image = further(scratch, solid.packed + j * solid.cells)
        projection = dot(image, readings, solid.cells)
        solid.projected[j] = projection - solid.overlap[j, 0] * x - solid.overlap[j, 1] * y
    return changed


@inner_kernel
def _along_shear(
    products: FloatArray, images: int, sums: tuple[float, float], shear: FloatArray
) -> float:
    """Fit shear's two images alone: ``shear`` by their ``sums``, and the squares they explain."""
    k = images - 2
    x, y = sums
    p = products[k, k]
    q = products[k, k + 1]
    r = products[k + 1, k + 1]
    inverse = 1.0 / (p * r - q * q)
    shear[0] = (r * x - q * y) * inverse
    shear[1] = (p * y - q * x) * inverse
    r_squared: float = shear[0] * x + shear[1] * y
    return r_squared


@inner_kernel
def _remove_shear(solid: SolidFit, images: int) -> None:
    """Take what is like shear out of this frame's products, where some cells don't count."""
    count = images - 2
    used = solid.used
    overlap = solid.overlap
    for j in range(count):
        _along_shear(used, images, (used[j, count], used[j, count + 1]), overlap[j])
    for i in range(count):
        for j in range(count):
            used[i, j] -= overlap[i, 0] * used[count, j] + overlap[i, 1] * used[count + 1, j]
