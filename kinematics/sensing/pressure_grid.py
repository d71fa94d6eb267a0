"""The forward model: what a pressure grid of given cells under a soft tip would read.

Holds the sensor's geometry (`SensorGrid`) and the rendering of a contact on it. Every cell reads
the pressure averaged over its area; sensor imperfections (noise, counts, dead cells) are not here.

The elastomer over a sensor spreads a point's pressure, a Gaussian blur: a cell reads
c(x) = (p ∗ box)(x), a blurred one ∫ G(t) c(x − t) dt with G of standard deviation w both ways. c is
smooth on the scale of a cell, so the integral is a weighted sum of neighbouring cells' c, along one
axis and then along the other: of finer cells here, of half or whole ones in the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.cell_integrals import (
    NODES,
    NODES_A_CELL,
    Nodes,
    add_cut_cell,
    add_whole_cell,
    evaluate,
)
from softfinger.kinematics.sensing.footprint import (
    Face,
    FloatArray,
    Grid,
    IntArray,
    band_columns,
    line_span,
    rows_touched,
    set_extremes,
    set_face,
)
from softfinger.kinematics.sensing.solid_pressure import SolidPressure, images

_PITCH_MAX = 0.1  # m; a greater one is in millimetres
OWNERS = 256  # cells whose nodes are evaluated at once
_MATCHED = 0.75  # cells: below it weights that match moments, above it samples of the Gaussian
_CUTOFF = 4.5  # standard deviations of the blur
_PIECES_MAX = 8


class Rendering(Record):
    """A contact on a grid of cells, and scratch for its pressures."""

    d: float  # [m]
    n_x: float  # of the object's outward normal, in the sensor's axes
    n_y: float
    gain: float
    grid: Grid
    face: Face
    nodes: Nodes
    waiting: int
    cells: Annotated[IntArray, OWNERS]
    ends: Annotated[IntArray, OWNERS]  # of their nodes


@inner_kernel
def _flush(work: Rendering, law: FloatArray, out: FloatArray) -> None:
    """Sum the nodes of the waiting cells into ``out``."""
    nodes = work.nodes
    evaluate(nodes, work.face, work.grid.radius, law)
    cols = work.grid.cols
    node = 0
    for k in range(work.waiting):
        total = 0.0
        while node < work.ends[k]:
            total += nodes.weight[node] * nodes.stress[node]
            node += 1
        cell = work.cells[k]
        out[cell // cols, cell % cols] = work.gain * total
    nodes.count = 0
    work.waiting = 0


@kernel
def render(
    works: Records[Rendering], law: FloatArray, columns: FloatArray, out: FloatArray
) -> None:
    """Write the pressure [Pa] of a contact, averaged over each cell, into ``out`` [rows, cols].

    ``law`` is the material's, ``columns`` [cols + 1, 2] is overwritten: an array made here would
    have every start load Numba's arrays. d ≤ 0 gives zeros. Beyond the domain's limit the footprint
    ends at the rim and the strain stays ≤ 1.
    """
    work = works[0]
    grid = work.grid
    face = work.face
    nodes = work.nodes
    a = grid.radius
    out[:] = 0.0
    if not (work.d > 0.0 and work.n_x * work.n_x + work.n_y * work.n_y < 1.0):
        return
    set_face(face, a, min(work.d, a), work.n_x, work.n_y)
    set_extremes(face, a)
    if not face.low < face.high:
        return
    first_row, last_row = rows_touched(face, grid)
    for j in range(grid.cols + 1):
        columns[j, 0], columns[j, 1] = line_span(
            face.u, face.w, face.v, a, grid.x + j * grid.pitch_x
        )
    nodes.count = 0
    work.waiting = 0
    above = line_span(face.u, face.v, face.w, a, grid.y + first_row * grid.pitch_y)
    for i in range(first_row, last_row):
        y0 = grid.y + i * grid.pitch_y
        y1 = grid.y + (i + 1) * grid.pitch_y
        below = above
        above = line_span(face.u, face.v, face.w, a, y1)
        first, inner_first, inner_last, last = band_columns(face, grid, below, above, y0, y1)
        for j in range(first, last):
            if inner_first <= j < inner_last:
                add_whole_cell(nodes, grid, i, j)
            else:
                left = (columns[j, 0], columns[j, 1])
                right = (columns[j + 1, 0], columns[j + 1, 1])
                add_cut_cell(nodes, face, grid, i, j, left, right)
            work.cells[work.waiting] = i * grid.cols + j
            work.ends[work.waiting] = nodes.count
            work.waiting += 1
            if nodes.count > NODES - NODES_A_CELL or work.waiting == OWNERS:
                _flush(work, law, out)
    _flush(work, law, out)


@dataclass(frozen=True)
class SensorGrid:
    """Rows × cols cells of a pressure sensor under a tip; rows run along y, columns along x.

    ``pitch`` [m] is one number or (x, y). ``centre`` [m] is the tip's centre in the sensor's axes,
    counted from the middle of the grid. ``rotation`` [rad] turns the sensor's axes against the
    finger's, counter-clockwise seen along +z. ``blur`` [m] is the standard deviation with which
    the elastomer over the cells spreads a point's pressure. Raises ValueError for values that make
    no grid.
    """

    rows: int
    cols: int
    pitch: float | tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    blur: float = 0.0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1:
            raise ValueError(f"a grid needs rows and columns, got {self.rows} × {self.cols}")
        if not all(0.0 < p <= _PITCH_MAX for p in self.pitches):
            raise ValueError(f"pitch must be in metres, up to {_PITCH_MAX:g}, got {self.pitch}")
        if not all(math.isfinite(c) for c in (*self.centre, self.rotation)):
            raise ValueError("centre and rotation must be finite")
        if (
            not 0.0
            <= self.blur
            <= 0.5 * min(self.rows * self.pitches[1], self.cols * self.pitches[0])
        ):
            raise ValueError(f"blur must be 0 to half the grid's shorter side, got {self.blur}")

    @property
    def pitches(self) -> tuple[float, float]:
        """Cell size (x, y) [m]."""
        if isinstance(self.pitch, tuple):
            return self.pitch
        return self.pitch, self.pitch

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    def on(self, tip: Fingertip) -> Grid:
        """Return the cells as kernels take them, counted from this tip's centre."""
        pitch_x, pitch_y = self.pitches
        x = -0.5 * self.cols * pitch_x - self.centre[0]
        y = -0.5 * self.rows * pitch_y - self.centre[1]
        # In the order of the fields; at once, as setting each takes ten times as long.
        fields = (tip.radius, x, y, pitch_x, pitch_y, self.rows, self.cols)
        return Grid(np.array([fields], Grid.dtype))

    def to_sensor(self, n_x: float, n_y: float) -> tuple[float, float]:
        """Rotate a vector's components from the finger's axes to the sensor's."""
        if self.rotation == 0.0:
            return n_x, n_y
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return c * n_x + s * n_y, c * n_y - s * n_x

    def pressure(
        self,
        tip: Fingertip,
        material: Material,
        d: float,
        tilt_x: float = 0.0,
        tilt_y: float = 0.0,
        gain: float = 1.0,
        out: FloatArray | None = None,
    ) -> FloatArray:
        """Return the pressure [Pa] averaged over each cell, float64 [rows, cols].

        ``d`` [m] is the displacement, the tilts [rad] give the object's normal
        (sin tilt_x, sin tilt_y, …). Accurate to 1e-6 of the modulus, cut cells included; with a
        blur to 5e-4, mostly to 1e-5. A solid tip's is as exact as `solid_data` say, and ends where
        they do. ``out`` is written and returned if given. Raises ValueError
        for a d that is not finite or exceeds the radius, and for tilts whose normal would point
        into the tip.
        """
        n_x, n_y = normal(d, tilt_x, tilt_y, tip.radius)
        if out is None:
            out = np.empty(self.shape)
        elif out.shape != self.shape or out.dtype != np.float64 or not out.flags.c_contiguous:
            raise ValueError(f"out must be a contiguous float64 array of shape {self.shape}")
        if tip.physics == "solid":
            SolidPressure(tip, material, self.images(tip))(
                (d, *self.to_sensor(n_x, n_y)), gain, out
            )
            return out
        work: Any = np.empty(1, Rendering.dtype)  # a record's views take longer than to set fields
        work["d"], work["gain"] = d, gain
        work["n_x"], work["n_y"] = self.to_sensor(n_x, n_y)
        if self.blur == 0.0:
            work["grid"] = self.on(tip).array
            render(work, material.law, np.empty((self.cols + 1, 2)), out)
            return out
        pitch_x, pitch_y = self.pitches
        n = blur_pieces(self.blur / pitch_x), blur_pieces(self.blur / pitch_y)
        stencils, finer = self.finer(n)
        fine = np.empty(finer.shape)
        work["grid"] = finer.on(tip).array
        render(work, material.law, np.empty((finer.cols + 1, 2)), fine)
        out[:] = average(fine, *stencils, n)
        return out

    def images(self, tip: Fingertip) -> FloatArray:
        """Return cells' means of a solid tip's modes and shear [·, cells], see `solid_pressure`."""
        return _images(replace(self, rotation=0.0), tip)

    def finer(self, pieces: tuple[int, int]) -> tuple[tuple[FloatArray, FloatArray], SensorGrid]:
        """Return the blur's stencils in x and y by pieces of cells, and the unblurred grid of all.

        ``pieces`` (x, y) are those of a cell; the grid is as much wider as the stencils reach.
        """
        pitch_x, pitch_y = self.pitches[0] / pieces[0], self.pitches[1] / pieces[1]
        across, along = stencil(self.blur / pitch_x), stencil(self.blur / pitch_y)
        finer = replace(
            self,
            rows=self.rows * pieces[1] + len(along) - 1,
            cols=self.cols * pieces[0] + len(across) - 1,
            pitch=(pitch_x, pitch_y),
            blur=0.0,
        )
        return (across, along), finer


@lru_cache(maxsize=16)  # two fingers' grids, and those that an uncertain place makes of them
def _images(grid: SensorGrid, tip: Fingertip) -> FloatArray:
    if grid.blur == 0.0:
        return images(tip, grid.on(tip))
    n = blur_pieces(grid.blur / grid.pitches[0]), blur_pieces(grid.blur / grid.pitches[1])
    stencils, finer = grid.finer(n)
    fine = images(tip, finer.on(tip)).reshape(-1, *finer.shape)
    return np.stack([average(each, *stencils, n).ravel() for each in fine])


def normal(d: float, tilt_x: float, tilt_y: float, radius: float) -> tuple[float, float]:
    """Return (n_x, n_y) of tilts [rad]. Raises ValueError for tilts of no contact."""
    if not (math.isfinite(d) and math.isfinite(tilt_x) and math.isfinite(tilt_y)):
        raise ValueError(f"d and tilts must be finite, got {d}, {tilt_x}, {tilt_y}")
    if d > radius:
        raise ValueError(f"d = {d} m is more than the tip's radius {radius} m")
    n_x, n_y = math.sin(tilt_x), math.sin(tilt_y)
    if abs(tilt_x) >= 0.5 * math.pi or abs(tilt_y) >= 0.5 * math.pi or n_x**2 + n_y**2 >= 1.0:
        raise ValueError(f"tilts {tilt_x}, {tilt_y} rad don't make a normal out of the tip")
    return n_x, n_y


def stencil(width: float) -> FloatArray:
    """Return the blur's weights over neighbouring cells, float64 [2 n + 1]; ``width`` in cells.

    Samples of the Gaussian: the trapezoid rule, whose error falls like exp(−2π² w²). Below
    three quarters of a cell five weights of the Gaussian's moments up to the fifth, which are exact
    for polynomials of that degree. One weight of 1 without a blur.
    """
    if width == 0.0:
        return np.ones(1)
    if width < _MATCHED:
        square = width * width
        far = (3.0 * square * square - square) / 24.0
        near = 0.5 * square - 4.0 * far
        return np.array([far, near, 1.0 - 2.0 * (near + far), near, far])
    n = math.ceil(_CUTOFF * width)
    weights = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    return np.asarray(weights / weights.sum())


def blur_pieces(width: float) -> int:
    """Return the pieces of a cell's side in the forward model; ``width`` in cells."""
    return min(max(math.ceil(1.0 / width), 2), _PIECES_MAX)


def average(
    fine: FloatArray, across: FloatArray, along: FloatArray, n: tuple[int, int]
) -> FloatArray:
    """Blur ``fine`` by the stencils along x and y and average it over cells of n = (x, y) pieces.

    ``fine`` has the stencils' half lengths more on each side than there are pieces.
    """
    cols = (fine.shape[1] - len(across) + 1) // n[0]
    rows = (fine.shape[0] - len(along) + 1) // n[1]
    # The mean over a cell's pieces goes into the weights, so that only cells are summed.
    half = np.zeros((fine.shape[0], cols))
    for k, weight in enumerate(np.convolve(across, np.full(n[0], 1.0 / n[0]))):
        half += weight * fine[:, k : k + cols * n[0] : n[0]]
    whole = np.zeros((rows, cols))
    for k, weight in enumerate(np.convolve(along, np.full(n[1], 1.0 / n[1]))):
        whole += weight * half[k : k + rows * n[1] : n[1]]
    return whole
