"""Forward model of a solid tip: a frame is a weighted sum of fixed images.

Each image shows a mode from `solid_data`. A mode has one image on the grid, or two images if it is
directional: B(r) cos mφ and B(r) sin mφ, averaged over each cell. The image weights are smooth
functions of (d, n_x, n_y). Because the sensor cannot measure tension, a cell reads 0 where the sum
is negative.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.solid_data import solid_data
from softfinger.kinematics.contact.solid_lookup import energy_lanes, solid_table
from softfinger.kinematics.contact.table_record import Table
from softfinger.kinematics.sensing.blur import axis_points, mean_matrix
from softfinger.kinematics.sensing.footprint import FloatArray, Grid, IntArray

MODES = 32
IMAGES = 2 * MODES
_IMAGES_PER_PASS = 4  # number of images added per pass; it must divide IMAGES
ROOT_TERMS, SQUARE_TERMS = 12, 6  # maximum number of terms in a mode's polynomial

# Number of sample points per cell side: for cells inside the rim, for cells cut by the rim, and
# with blur.
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
    value: Annotated[FloatArray, IMAGES]
    by_d: Annotated[FloatArray, IMAGES]
    by_x: Annotated[FloatArray, IMAGES]
    by_y: Annotated[FloatArray, IMAGES]


def weights_of(tip: Fingertip, material: Material) -> Weights:
    """Return the modes of a solid tip; no contact is set yet.

    Raises MaterialError unless the material is linear.
    """
    data, weights = solid_data(tip), Weights()
    weights.table.assign(solid_table(tip, material))
    count, i, j = data.ratios.shape
    weights.modes, weights.images = count, image_count(data.harmonics)
    weights.harmonics[:count] = data.harmonics
    weights.ratios.reshape(SQUARE_TERMS, ROOT_TERMS, MODES)[:j, :i, :count] = data.ratios.T
    return weights


def image_count(harmonics: IntArray) -> int:
    """Return the number of images required for the modes."""
    return int(len(harmonics) + np.count_nonzero(harmonics))


def images(tip: Fingertip, cells: Grid, blur: float) -> FloatArray:
    """Return the mode images, followed by the images for shear along x and y, [·, rows · cols]."""
    if blur > 0.0:
        return _blurred_images(tip, cells, blur)
    data = solid_data(tip)
    out = np.zeros((image_count(data.harmonics) + 2, cells.rows * cells.cols))
    x, y = (
        (low + pitch * np.arange(count)) / cells.radius
        for low, pitch, count in (
            (cells.x, cells.pitch_x, cells.cols),
            (cells.y, cells.pitch_y, cells.rows),
        )
    )
    width, height = cells.pitch_x / cells.radius, cells.pitch_y / cells.radius
    near = np.hypot(*np.meshgrid(_nearest(x, width), _nearest(y, height)))
    far = np.hypot(*np.meshgrid(np.maximum(-x, x + width), np.maximum(-y, y + height)))
    cut = (near < 1.0) & (far > 1.0)
    for points, chosen in ((_INSIDE, (near < data.edges[-1]) & ~cut), (_CUT, cut)):
        rows, cols = np.nonzero(chosen)
        offset = (np.arange(points) + 0.5) / points
        at_x = x[cols, None, None] + width * offset[None, None, :]
        at_y = y[rows, None, None] + height * offset[None, :, None]
        z = (at_x + 1j * at_y).reshape(len(rows), points**2)
        out[:, rows * cells.cols + cols] = _means(tip, z)
    return out


def _blurred_images(tip: Fingertip, cells: Grid, blur: float) -> FloatArray:
    x, across = axis_points(cells.x, cells.pitch_x, cells.cols, _BLURRED, blur)
    y, along = axis_points(cells.y, cells.pitch_y, cells.rows, _BLURRED, blur)
    z: Any = (x.T.ravel() + 1j * y.T.ravel()[:, None]) / cells.radius
    columns, lines = mean_matrix(across, cells.cols).T, mean_matrix(along, cells.rows)
    whole: Any = 0.0
    for some in np.array_split(np.arange(len(z)), max(z.size // 2**15, 1)):
        fine = _means(tip, z[some].reshape(-1, 1)).reshape(-1, len(some), z.shape[1])
        whole = whole + lines[:, some] @ (fine @ columns)
    return np.ascontiguousarray(whole.reshape(len(whole), -1))


def _nearest(low: NDArray[Any], width: float) -> NDArray[Any]:
    return np.asarray(np.maximum(np.maximum(low, -(low + width)), 0.0))


def _means(tip: Fingertip, z: NDArray[np.complex128]) -> FloatArray:
    """Return each image's mean over the points x + i y [cells, points]; 0 outside the rings."""
    data = solid_data(tip)
    middle = 0.5 * (data.edges[1:] + data.edges[:-1])
    r = np.abs(z)
    inside = (r < data.edges[-1]) / z.shape[1]
    phase = z / np.maximum(r, 1e-12)
    found: list[FloatArray] = []
    modes = zip([*data.harmonics.tolist(), 1], [*data.modes, data.shear], strict=True)
    powers = {m: phase**m for m in {*data.harmonics.tolist(), 1}}
    for m, mode in modes:
        # Modes with m > 0 vanish at the centre.
        start = 0.0 if m else 1.5 * mode[0] - 0.5 * mode[1]
        value = np.interp(r, [0.0, *middle], [start, *mode]) * inside
        found.append((value * powers[m].real).sum(axis=1))
        if m:
            found.append((value * powers[m].imag).sum(axis=1))
    return np.stack(found)


@inner_kernel
def set_weights(weights: Weights, d: float, n_x: float, n_y: float) -> None:
    """Set a contact's image weights (for images in Pa) and their partials in d, n_x and n_y."""
    table = weights.table
    square = n_x * n_x + n_y * n_y
    t = math.sqrt(d * table.inverse_radius)
    x = t * table.by_root - 1.0
    y = square * table.by_square - 1.0
    g, g_t, g_tt, g_s, g_ts = energy_lanes(table, t, square)
    # Normal force divided by a², and its partials with respect to t and sin² θ.
    normal = table.modulus * t * t * t * (2.5 * g + 0.5 * t * g_t)
    normal_t = 0.5 * table.modulus * t * t * (15.0 * g + t * (9.0 * g_t + t * g_tt))
    normal_s = table.modulus * t * t * t * (2.5 * g_s + 0.5 * t * g_ts)
    t_d = 0.5 * table.inverse_radius / t
    cosine = math.sqrt(1.0 - square)
    value = weights.value
    by_d = weights.by_d
    by_x = weights.by_x
    by_y = weights.by_y
    _evaluate_ratios(weights, x, y)
    # If the face sticks to the tip, F/(N cos θ) differs from 1.
    held = 1.0 - square * weights.q[0]
    held_t = -square * weights.q_x[0] * table.by_root
    held_s = -weights.q[0] - square * weights.q_y[0] * table.by_square
    value[0] = normal * cosine * held
    by_d[0] = (normal_t * held + normal * held_t) * t_d * cosine
    both = 2.0 * (normal_s * held + normal * held_s) * cosine - normal * held / cosine
    by_x[0] = n_x * both
    by_y[0] = n_y * both
    # (n_x + i n_y)^m, and its derivative divided by m. The modes are sorted by m.
    m = 0
    power = 1.0 + 0.0j
    below = 0.0j
    at = 1
    for k in range(1, weights.modes):
        q = weights.q[k]
        q_t = weights.q_x[k] * table.by_root
        q_s = weights.q_y[k] * table.by_square
        amplitude = normal * q
        amplitude_d = (normal_t * q + normal * q_t) * t_d
        amplitude_s = 2.0 * (normal_s * q + normal * q_s)
        while m < weights.harmonics[k]:
            below = power
            power *= complex(n_x, n_y)
            m += 1
        value[at] = amplitude * power.real
        by_d[at] = amplitude_d * power.real
        by_x[at] = amplitude_s * n_x * power.real + amplitude * m * below.real
        by_y[at] = amplitude_s * n_y * power.real - amplitude * m * below.imag
        at += 1
        if m > 0:
            value[at] = amplitude * power.imag
            by_d[at] = amplitude_d * power.imag
            by_x[at] = amplitude_s * n_x * power.imag + amplitude * m * below.imag
            by_y[at] = amplitude_s * n_y * power.imag + amplitude * m * below.real
            at += 1


@inner_kernel
def own_shear(weights: Weights, d: float, square: float) -> float:
    """Return the shear force of straight indentation on a sticking face, divided by a² sin θ [Pa].

    This shear acts at height a and is already included in the modes. ``weights`` must be set for
    this contact.
    """
    q = weights.q[0]
    normal = weights.value[0] / (1.0 - square * q)
    shear: float = -normal * q * (1.0 - d * weights.table.inverse_radius)
    return shear


@fast_inner_kernel
def _evaluate_ratios(weights: Weights, x: float, y: float) -> None:
    """Evaluate q of each mode and its partials in x and y, using one SIMD lane per mode."""
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
def _add_images(
    weights: FloatArray,
    first: int,
    pixels: FloatArray,
    image: int,
    count: int,
    out: FloatArray,
) -> None:
    """Add four weighted images, starting with index ``first``; their pixels begin at ``image``."""
    a, b, c, d = weights[first], weights[first + 1], weights[first + 2], weights[first + 3]
    second = image + count
    third = second + count
    fourth = third + count
    for k in range(index(0), count):
        out[k] += (
            a * pixels[image + k]
            + b * pixels[second + k]
            + c * pixels[third + k]
            + d * pixels[fourth + k]
        )


@inner_kernel
def add_images(weights: Weights, of: FloatArray, pixels: FloatArray, out: FloatArray) -> None:
    """Add all images in ``pixels``, which are stored consecutively, with the weights in ``of``.

    The last group of images may include the shear images, whose weights are 0 here.
    """
    count = out.shape[0]
    for j in range(0, weights.images, _IMAGES_PER_PASS):
        _add_images(of, j, pixels, index(j * count), index(count), out)


@inner_kernel
def press_solid(
    weights: Weights, pixels: FloatArray, d: float, n_x: float, n_y: float, planes: FloatArray
) -> None:
    """Compute the contact pressure and its partials in d, n_x and n_y, [4, rows, cols].

    The pressure is not clipped; it is negative where the rubber is in tension.
    """
    set_weights(weights, d, n_x, n_y)
    count = planes.shape[1] * planes.shape[2]
    flat = planes.reshape(-1)
    flat[:] = 0.0
    add_images(weights, weights.value, pixels, flat[:count])
    add_images(weights, weights.by_d, pixels, flat[count : 2 * count])
    add_images(weights, weights.by_x, pixels, flat[2 * count : 3 * count])
    add_images(weights, weights.by_y, pixels, flat[3 * count :])


@kernel
def render_solid(
    weights: Records[Weights],
    basis: FloatArray,
    contact: tuple[float, float, float],
    shear: tuple[float, float],
    whole: bool,
    gain: float,
    out: FloatArray,
) -> None:
    """Write the pressure [Pa] of a ``contact`` (d, n_x, n_y), multiplied by ``gain``, into ``out``.

    ``shear`` [N] is the force on the face along x and y, acting at height a. If ``whole`` is True,
    ``shear`` is the total shear; otherwise ``shear`` is added to the shear of straight indentation.
    ``basis`` holds the grid's images. The result is zero for d ≤ 0. Contacts outside the range of
    the data are clamped to the maximum depth and tilt at the same azimuth.
    """
    each = weights[0]
    table = each.table
    d, n_x, n_y = contact
    out[:] = 0.0
    if not (d > 0.0 and n_x * n_x + n_y * n_y < 1.0):
        return
    tilt = math.hypot(n_x, n_y)
    sine_max = math.sin(table.tilt)
    if tilt > sine_max:
        n_x *= sine_max / tilt
        n_y *= sine_max / tilt
    d = min(d, table.deepest)
    set_weights(each, d, n_x, n_y)
    own = own_shear(each, d, n_x * n_x + n_y * n_y) if whole else 0.0
    add_images(each, each.value, basis, out)
    area = table.radius * table.radius
    x = shear[0] / area - own * n_x
    y = shear[1] / area - own * n_y
    cells = out.shape[0]
    along = each.images * cells
    for k in range(cells):
        pressure = out[k] + x * basis[along + k] + y * basis[along + cells + k]
        out[k] = max(gain * pressure, 0.0)


def padded(images: FloatArray) -> FloatArray:
    """Flatten images [·, cells] and pad them so that `add_images` can read past the end."""
    return np.concatenate([images.ravel(), np.zeros((_IMAGES_PER_PASS - 1) * images.shape[1])])


class SolidPressure:
    """Pressure of one solid tip on the cells of the ``basis`` images."""

    def __init__(self, tip: Fingertip, material: Material, basis: FloatArray) -> None:
        self._weights = weights_of(tip, material).array
        self._basis = padded(basis)

    def __call__(
        self,
        contact: tuple[float, float, float],
        gain: float,
        out: FloatArray,
        shear: tuple[float, float] | None = None,
    ) -> None:
        """Call :func:`render_solid`; by default, ``shear`` is that of straight indentation."""
        whole = shear is not None
        render_solid(
            self._weights, self._basis, contact, shear or (0.0, 0.0), whole, gain, out.reshape(-1)
        )
