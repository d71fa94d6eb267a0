"""Forward model of a solid tip: a frame is a weighted sum of fixed images.

Each image shows a mode from `solid_data`. A directional mode has two images, B(r) cos mφ and B(r)
sin mφ. A mode without direction (m = 0) has one image. The images are averaged over each cell. The
image weights are smooth functions of (d, n_x, n_y). Because the sensor cannot measure tension, a
cell reads 0 where the sum is negative.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray, IntArray, Record, Records
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import normal_force
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.solid_data import solid_data
from softfinger.kinematics.contact.table_build import solid_table
from softfinger.kinematics.contact.table_record import Table
from softfinger.kinematics.sensing.blur import axis_points, cell_means
from softfinger.kinematics.sensing.footprint import Grid, axes

MODES = 32
IMAGES = 2 * MODES
# The number of images is padded to a multiple of _LANES. IMAGES must also be a multiple of _LANES.
_LANES = 8
ROOT_TERMS, SQUARE_TERMS = 12, 6  # maximum number of terms in a mode's polynomial

# Number of sample points per cell side. Cells inside the rim have _INSIDE points, and cells cut by
# the rim have _CUT points. All cells of a sensor with blur have _BLURRED points.
_INSIDE, _CUT, _BLURRED = 6, 24, 12


class Weights(Record):
    """Image weights for one contact, set by `set_weights`."""

    table: Table
    modes: int
    images: int
    harmonics: Annotated[IntArray, MODES]
    ratios: Annotated[FloatArray, SQUARE_TERMS * ROOT_TERMS * MODES]  # [y, x, mode]
    q: Annotated[FloatArray, MODES]
    q_x: Annotated[FloatArray, MODES]
    q_y: Annotated[FloatArray, MODES]
    row: Annotated[FloatArray, MODES]  # scratch
    slope: Annotated[FloatArray, MODES]
    values: Annotated[FloatArray, 4, IMAGES]  # weights, ∂/∂d, ∂/∂n_x and ∂/∂n_y


def weights_of(tip: Fingertip, material: Material) -> Weights:
    """Create the image weights of a solid tip, without setting a contact.

    Raises MaterialError unless the material is linear.
    """
    data, weights = solid_data(tip), Weights()
    weights.table.assign(solid_table(tip, material))
    count, i, j = data.ratios.shape
    weights.modes, weights.images = count, count + np.count_nonzero(data.harmonics)
    weights.harmonics[:count] = data.harmonics
    weights.ratios.reshape(SQUARE_TERMS, ROOT_TERMS, MODES)[:j, :i, :count] = data.ratios.T
    return weights


def images(tip: Fingertip, cells: Grid, blur: float) -> FloatArray:
    """Return the mode images, followed by the images for shear along x and y, [·, rows · cols]."""
    if blur > 0.0:
        return _blurred_images(tip, cells, blur)
    data = solid_data(tip)
    count = len(data.harmonics) + np.count_nonzero(data.harmonics) + 2
    out = np.zeros((count, cells.rows * cells.cols))
    width, height = cells.pitch_x / cells.radius, cells.pitch_y / cells.radius
    x, y = (middle / cells.radius for middle in axes(cells))
    # Distances from the tip centre to the nearest and the farthest point of each cell.
    near, far = (
        np.hypot(
            np.maximum(np.abs(x) + sign * width, 0.0),
            np.maximum(np.abs(y) + sign * height, 0.0)[:, None],
        )
        for sign in (-0.5, 0.5)
    )
    cut = (near < 1.0) & (far > 1.0)
    for points, chosen in ((_INSIDE, (near < data.edges[-1]) & ~cut), (_CUT, cut)):
        rows, cols = np.nonzero(chosen)
        offset = (np.arange(points) + 0.5) / points - 0.5
        at_x = x[cols, None, None] + width * offset
        at_y = y[rows, None, None] + height * offset[:, None]
        out[:, chosen.ravel()] = list(_means(tip, (at_x + 1j * at_y).reshape(len(rows), points**2)))
    return out


def _blurred_images(tip: Fingertip, cells: Grid, blur: float) -> FloatArray:
    x, across = axis_points(cells.x, cells.pitch_x, cells.cols, _BLURRED, blur)
    y, along = axis_points(cells.y, cells.pitch_y, cells.rows, _BLURRED, blur)
    z: Any = (x.T.ravel() + 1j * y.T.ravel()[:, None]) / cells.radius
    inside = np.abs(z) < solid_data(tip).edges[-1]
    points = np.zeros(z.shape)
    found: list[FloatArray] = []
    for values in _means(tip, z[inside][:, None]):
        points[inside] = values
        found.append(cell_means(points, along, across))
    return np.reshape(found, (len(found), -1))


def _means(tip: Fingertip, z: NDArray[np.complex128]) -> Iterator[FloatArray]:
    """Yield the mean of each image over each cell's points x + i y [cells, points]."""
    data = solid_data(tip)
    middle = 0.5 * (data.edges[1:] + data.edges[:-1])
    r = np.abs(z)
    inside = (r < data.edges[-1]) / z.shape[1]
    phase = z / np.maximum(r, 1e-12)
    powers = {m: phase**m for m in {*data.harmonics.tolist(), 1}}
    for m, mode in zip([*data.harmonics.tolist(), 1], [*data.modes, data.shear], strict=True):
        # Modes with m > 0 are zero at the centre.
        start = 0.0 if m else 1.5 * mode[0] - 0.5 * mode[1]
        value = np.interp(r, [0.0, *middle], [start, *mode]) * inside
        yield (value * powers[m].real).sum(axis=1)
        if m:
            yield (value * powers[m].imag).sum(axis=1)


@inner_kernel
def set_weights(weights: Weights, d: float, n_x: float, n_y: float) -> None:
    """Set the image weights [Pa] of a contact and their partials with respect to d, n_x and n_y."""
    table = weights.table
    square = n_x * n_x + n_y * n_y
    t = math.sqrt(d * table.inverse_radius)
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    normal, normal_d, normal_s, _, _ = normal_force(table, t, square)
    t_d = 0.5 * table.inverse_radius / t
    cosine = math.sqrt(1.0 - square)
    values = weights.values
    _evaluate_ratios(weights, x, y)
    # If the face sticks to the tip, F/(N cos θ) differs from 1.
    held = 1.0 - square * weights.q[0]
    held_t = -square * weights.q_x[0] * table.by_root
    held_s = -weights.q[0] - square * weights.q_y[0] * table.by_square
    both = 2.0 * (normal_s * held + normal * held_s) * cosine - normal * held / cosine
    values[0, 0] = normal * cosine * held
    values[1, 0] = (normal_d * held + normal * held_t * t_d) * cosine
    values[2, 0], values[3, 0] = n_x * both, n_y * both
    # Real and imaginary parts of (n_x + i n_y)^m, and of its derivative divided by m. The modes are
    # sorted by m. Complex numbers would take longer to compile.
    m = 0
    power_x, power_y = 1.0, 0.0
    below_x, below_y = 0.0, 0.0
    at = 1
    for k in range(1, weights.modes):
        q = weights.q[k]
        q_t = weights.q_x[k] * table.by_root
        q_s = weights.q_y[k] * table.by_square
        while m < weights.harmonics[k]:
            below_x, below_y = power_x, power_y
            power_x, power_y = below_x * n_x - below_y * n_y, below_x * n_y + below_y * n_x
            m += 1
        size = normal * q
        by_d = normal_d * q + normal * q_t * t_d
        by_square = 2.0 * (normal_s * q + normal * q_s)
        turned_x, turned_y = size * m * below_x, size * m * below_y
        values[0, at] = size * power_x
        values[1, at] = by_d * power_x
        values[2, at] = by_square * power_x * n_x + turned_x
        values[3, at] = by_square * power_x * n_y - turned_y
        if m > 0:
            values[0, at + 1] = size * power_y
            values[1, at + 1] = by_d * power_y
            values[2, at + 1] = by_square * power_y * n_x + turned_y
            values[3, at + 1] = by_square * power_y * n_y + turned_x
        at += 2 if m > 0 else 1


@inner_kernel
def own_shear(weights: Weights, d: float, square: float) -> float:
    """Return the shear of straight indentation with a sticking face, divided by a² sin θ [Pa].

    This shear acts at height a and is already included in the modes. ``weights`` must be set for
    this contact.
    """
    q = weights.q[0]
    normal = weights.values[0, 0] / (1.0 - square * q)
    shear: float = -normal * q * (1.0 - d * weights.table.inverse_radius)
    return shear


@fast_inner_kernel
def _evaluate_ratios(weights: Weights, x: float, y: float) -> None:
    """Evaluate q of each mode and its partials with respect to x and y, one mode per SIMD lane."""
    ratios = weights.ratios
    q = weights.q
    q_x = weights.q_x
    q_y = weights.q_y
    row = weights.row
    slope = weights.slope
    for k in range(MODES):
        q[k] = q_x[k] = q_y[k] = 0.0
    for j in range(SQUARE_TERMS - 1, -1, -1):
        for k in range(MODES):
            row[k] = slope[k] = 0.0
        for i in range(ROOT_TERMS - 1, -1, -1):
            at = index((j * ROOT_TERMS + i) * MODES)
            for k in range(index(0), index(MODES)):
                slope[k] = slope[k] * x + row[k]
                row[k] = row[k] * x + ratios[at + k]
        for k in range(MODES):
            q_y[k] = q_y[k] * y + q[k]
            q[k] = q[k] * y + row[k]
            q_x[k] = q_x[k] * y + slope[k]


@fast_inner_kernel
def _sum_images(weights: Weights, pixels: FloatArray, planes: FloatArray) -> None:
    """Set ``planes`` [4, cells] to the sums of ``pixels`` multiplied by the four weight rows."""
    values = weights.values
    for k in range(pixels.shape[0]):
        pressure = by_d = by_x = by_y = 0.0
        for j in range(index(0), index(pixels.shape[1])):
            pixel = pixels[k, j]
            pressure += values[0, j] * pixel
            by_d += values[1, j] * pixel
            by_x += values[2, j] * pixel
            by_y += values[3, j] * pixel
        planes[0, k] = pressure
        planes[1, k] = by_d
        planes[2, k] = by_x
        planes[3, k] = by_y


@inner_kernel
def press_solid(
    weights: Weights, pixels: FloatArray, d: float, n_x: float, n_y: float, planes: FloatArray
) -> None:
    """Compute the pressure and its partials with respect to d, n_x and n_y, [4, cells].

    The pressure is not clipped; it is negative where the rubber is in tension.
    """
    set_weights(weights, d, n_x, n_y)
    _sum_images(weights, pixels, planes)


@fast_inner_kernel
def _sum_pressures(values: FloatArray, pixels: FloatArray, gain: float, out: FloatArray) -> None:
    for k in range(pixels.shape[0]):
        pressure = 0.0
        for j in range(index(0), index(pixels.shape[1])):
            pressure += values[0, j] * pixels[k, j]
        out[k] = max(gain * pressure, 0.0)


@kernel
def render_solid(
    weights: Records[Weights],
    pixels: FloatArray,
    contact: tuple[float, float, float],
    shear: tuple[float, float],
    whole: bool,
    gain: float,
    out: FloatArray,
) -> None:
    """Write the pressure [Pa] of a ``contact`` (d, n_x, n_y), multiplied by ``gain``, into ``out``.

    ``shear`` [N] is the force on the face along x and y, acting at height a. If ``whole`` is True,
    ``shear`` is the total shear force. Otherwise, ``shear`` is added to the shear force that
    straight indentation causes. ``pixels`` contains all images, including the shear images. The
    result is zero for d ≤ 0. Contacts outside the range of the data are clamped to the maximum
    depth and tilt at the same azimuth.
    """
    each = weights[0]
    table = each.table
    d, n_x, n_y = contact
    out[:] = 0.0
    if not (d > 0.0 and n_x * n_x + n_y * n_y < 1.0):
        return
    within = min(1.0, math.sin(table.tilt) / max(math.hypot(n_x, n_y), 1e-9))
    n_x *= within
    n_y *= within
    d = min(d, table.deepest)
    set_weights(each, d, n_x, n_y)
    own = own_shear(each, d, n_x * n_x + n_y * n_y) if whole else 0.0
    area = table.radius * table.radius
    each.values[0, each.images] = shear[0] / area - own * n_x
    each.values[0, each.images + 1] = shear[1] / area - own * n_y
    _sum_pressures(each.values, pixels, gain, out)


def pixels_of(images: FloatArray) -> FloatArray:
    """Transpose ``images`` to [cells, ·]; pad with zero columns to a multiple of `_LANES`."""
    return np.ascontiguousarray(np.pad(images, ((0, -len(images) % _LANES), (0, 0))).T)


class SolidPressure:
    """Pressure model of one solid tip on the cells of the ``basis`` images."""

    def __init__(self, tip: Fingertip, material: Material, basis: FloatArray) -> None:
        self._weights = weights_of(tip, material).array
        self._pixels = pixels_of(basis)

    def __call__(
        self,
        contact: tuple[float, float, float],
        gain: float,
        out: FloatArray,
        shear: tuple[float, float] | None = None,
    ) -> None:
        """Call :func:`render_solid`; if ``shear`` is None, assume straight indentation."""
        whole = shear is not None
        render_solid(
            self._weights, self._pixels, contact, shear or (0.0, 0.0), whole, gain, out.reshape(-1)
        )
