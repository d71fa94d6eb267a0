"""The forward model: what a pressure grid of given cells under a soft tip would read.

Holds the sensor's geometry (`SensorGrid`) and the rendering of a contact on it. Every cell reads
the pressure averaged over its area; sensor imperfections (noise, counts, dead cells) are not here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.blur import average, parts, stencil
from softfinger.kinematics.sensing.cell_integrals import (
    MAX_BREAKS,
    NODE_ROWS,
    NODES_A_CELL,
    STRESS,
    WEIGHT,
    evaluate,
    push_cut,
    push_whole,
)
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    band_columns,
    extremes,
    line_span,
    plane,
)

NODES = 512 + NODES_A_CELL
OWNERS = 256


def render_scratch(grid: SensorGrid) -> tuple[FloatArray, IntArray, FloatArray]:
    """Scratch arrays for :func:`render`, reusable from call to call."""
    return (
        np.empty((NODE_ROWS, NODES)),
        np.empty((2, OWNERS), dtype=np.int64),
        np.empty((grid.cols + 1, 2)),
    )


@inner_kernel
def _flush(
    nodes: FloatArray,
    count: int,
    owners: IntArray,
    waiting: int,
    u: float,
    v: float,
    w: float,
    a: float,
    law: FloatArray,
    gain: float,
    out: FloatArray,
) -> None:
    """Sum the nodes of the ``waiting`` cells into ``out``; owners are (cell, end of its nodes)."""
    evaluate(nodes, count, u, v, w, a, law)
    cols = out.shape[1]
    node = 0
    for k in range(waiting):
        total = 0.0
        while node < owners[1, k]:
            total += nodes[WEIGHT, node] * nodes[STRESS, node]
            node += 1
        cell = owners[0, k]
        out[cell // cols, cell % cols] = gain * total


@kernel
def render(
    geometry: Geometry,
    law: FloatArray,
    gain: float,
    d: float,
    n_x: float,
    n_y: float,
    scratch: tuple[FloatArray, IntArray, FloatArray],
    out: FloatArray,
) -> None:
    """Write the pressure [Pa] of a contact, averaged over each cell, into ``out`` [rows, cols].

    ``geometry`` is :meth:`SensorGrid.geometry`, ``law`` the material's, (n_x, n_y) the first two
    components of the object's outward normal in the sensor's axes, ``scratch`` as
    :func:`render_scratch` gives it. d ≤ 0 gives zeros. Beyond the domain's limit the footprint ends
    at the rim and the strain stays ≤ 1.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    nodes, owners, columns = scratch
    rows, cols = out.shape
    out[:] = 0.0
    if not (d > 0.0 and n_x * n_x + n_y * n_y < 1.0):
        return
    u, v, w = plane(a, min(d, a), n_x, n_y)
    ends = extremes(u, v, w, a)
    if not ends[0] < ends[1]:
        return
    breaks = np.empty(MAX_BREAKS)
    first_row = min(max(math.floor((ends[0] - y_first) / pitch_y), 0), rows)
    last_row = min(max(math.ceil((ends[1] - y_first) / pitch_y), first_row), rows)
    for j in range(cols + 1):
        columns[j, 0], columns[j, 1] = line_span(u, w, v, a, x_first + j * pitch_x)
    count = 0
    waiting = 0
    above = line_span(u, v, w, a, y_first + first_row * pitch_y)
    for i in range(first_row, last_row):
        y0 = y_first + i * pitch_y
        y1 = y_first + (i + 1) * pitch_y
        below = above
        above = line_span(u, v, w, a, y1)
        first, inner_first, inner_last, last = band_columns(
            u, v, w, a, ends, below, above, y0, y1, x_first, pitch_x, cols
        )
        for j in range(first, last):
            x0 = x_first + j * pitch_x
            x1 = x_first + (j + 1) * pitch_x
            if inner_first <= j < inner_last:
                count = push_whole(nodes, count, a, x0, x1, y0, y1)
            else:
                left = (columns[j, 0], columns[j, 1])
                right = (columns[j + 1, 0], columns[j + 1, 1])
                count = push_cut(
                    nodes, count, u, v, w, a, ends, x0, x1, y0, y1, left, right, breaks
                )
            owners[0, waiting] = i * cols + j
            owners[1, waiting] = count
            waiting += 1
            if count > NODES - NODES_A_CELL or waiting == OWNERS:
                _flush(nodes, count, owners, waiting, u, v, w, a, law, gain, out)
                count = 0
                waiting = 0
    _flush(nodes, count, owners, waiting, u, v, w, a, law, gain, out)


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
        if not all(math.isfinite(p) and p > 0.0 for p in self.pitches):
            raise ValueError(f"pitch must be positive, got {self.pitch}")
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

    def geometry(self, tip: Fingertip) -> Geometry:
        """(a, x and y of the first cell's corner from the tip's centre, pitch x, pitch y) [m]."""
        pitch_x, pitch_y = self.pitches
        return (
            float(tip.radius),
            -0.5 * self.cols * pitch_x - self.centre[0],
            -0.5 * self.rows * pitch_y - self.centre[1],
            float(pitch_x),
            float(pitch_y),
        )

    def to_sensor(self, n_x: float, n_y: float) -> tuple[float, float]:
        """A vector's components along the finger's axes → along the sensor's."""
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
        """Pressure [Pa] averaged over each cell, float64 [rows, cols].

        ``d`` [m] is the displacement, the tilts [rad] give the object's normal
        (sin tilt_x, sin tilt_y, …). Accurate to 1e-6 of the modulus, cut cells included; with a
        blur to 5e-4, mostly to 1e-5. ``out`` is written and returned if given. Raises ValueError
        for a d that is not finite or exceeds the radius, and for tilts whose normal would point
        into the tip.
        """
        n_x, n_y = normal(d, tilt_x, tilt_y, tip.radius)
        if out is None:
            out = np.empty(self.shape)
        elif out.shape != self.shape or out.dtype != np.float64 or not out.flags.c_contiguous:
            raise ValueError(f"out must be a contiguous float64 array of shape {self.shape}")
        s_x, s_y = self.to_sensor(n_x, n_y)
        contact = (float(gain), float(d), s_x, s_y)
        if self.blur == 0.0:
            scratch = render_scratch(self)
            render(self.geometry(tip), material.law, *contact, scratch, out)
            return out
        pitch_x, pitch_y = self.pitches
        n = parts(self.blur / pitch_x), parts(self.blur / pitch_y)
        stencils, finer = self.finer(n)
        fine = np.empty(finer.shape)
        render(finer.geometry(tip), material.law, *contact, render_scratch(finer), fine)
        out[:] = average(fine, *stencils, n)
        return out

    def finer(self, parts: tuple[int, int]) -> tuple[tuple[FloatArray, FloatArray], SensorGrid]:
        """The blur's stencils along x and y in parts of cells, and the unblurred grid of all parts.

        ``parts`` (x, y) are those of a cell; the grid is as much wider as the stencils reach.
        """
        pitch_x, pitch_y = self.pitches[0] / parts[0], self.pitches[1] / parts[1]
        across, along = stencil(self.blur / pitch_x), stencil(self.blur / pitch_y)
        finer = replace(
            self,
            rows=self.rows * parts[1] + len(along) - 1,
            cols=self.cols * parts[0] + len(across) - 1,
            pitch=(pitch_x, pitch_y),
            blur=0.0,
        )
        return (across, along), finer


def normal(d: float, tilt_x: float, tilt_y: float, radius: float) -> tuple[float, float]:
    """(n_x, n_y) of tilts [rad], after checking that the contact is one. Raises ValueError."""
    if not (math.isfinite(d) and math.isfinite(tilt_x) and math.isfinite(tilt_y)):
        raise ValueError(f"d and tilts must be finite, got {d}, {tilt_x}, {tilt_y}")
    if d > radius:
        raise ValueError(f"d = {d} m is more than the tip's radius {radius} m")
    n_x, n_y = math.sin(tilt_x), math.sin(tilt_y)
    if abs(tilt_x) >= 0.5 * math.pi or abs(tilt_y) >= 0.5 * math.pi or n_x**2 + n_y**2 >= 1.0:
        raise ValueError(f"tilts {tilt_x}, {tilt_y} rad don't make a normal out of the tip")
    return n_x, n_y
