"""What a soft, resistive pressure sensor does to the pressure before it is counted, as kernels.

Here live the operators that spread pressure to other cells (the elastomer's blur, the lines'
crosstalk) and those with a memory in each cell (hysteresis, creep, drift), without any settings.
The numbers that go with them are our own choice; the forms are the usual ones.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.sensing.footprint import Grid

FloatArray = NDArray[np.float64]

PLAYS = 4
_LEAST = 0.75  # parts: a narrower Gaussian is no longer told by samples of it
_REACH = 6.0  # standard deviations


def parts_for(deviation: float, pitch: float) -> int:
    """Parts that a cell's side is cut into for :func:`blur`: fewer where the blur is wide."""
    return 2 if deviation >= 0.5 * pitch else 3


def stencil(deviation: float, pitch: float, parts: int) -> FloatArray:
    """Weights of a Gaussian's point spread over neighbouring parts of a cell, float64 [2 n + 1].

    ``deviation`` and ``pitch`` in m. A cell's reading is c(x) = (p ∗ box)(x), and the blurred one
    ∫ G(t) c(x − t) dt: its trapezoid sum with a step of a part, whose error falls like
    exp(−2π² w²/step²). Below three quarters of a step, three weights of the same variance. Within
    2e-4 of the modulus with :func:`parts_for`'s parts.
    """
    width = deviation / pitch * parts
    if width < _LEAST:
        beside = 0.5 * width * width
        return np.array([beside, 1.0 - 2.0 * beside, beside])
    n = math.ceil(_REACH * width)
    weights = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    return np.asarray(weights / weights.sum())


class Blur:
    """The finer grid that a blurred frame is rendered on, and its stencils.

    The elastomer over the cells spreads a point's pressure with the standard deviation ``width``
    [m]. ``grid`` is that of the cells; ``fine`` [rows, cols] on ``fine_grid`` is to be rendered,
    the stencils' reach beyond the sensor's edge included.
    """

    def __init__(self, grid: Grid, width: float) -> None:
        pitch_x, pitch_y = grid.pitch_x, grid.pitch_y
        parts_x, parts_y = parts_for(width, pitch_x), parts_for(width, pitch_y)
        self.parts = (parts_x, parts_y)
        self.across = stencil(width, pitch_x, parts_x)
        self.along = stencil(width, pitch_y, parts_y)
        margin_x, margin_y = len(self.across) // 2, len(self.along) // 2
        fine = self.fine_grid = Grid()
        fine.radius = grid.radius
        fine.rows = grid.rows * parts_y + 2 * margin_y
        fine.cols = grid.cols * parts_x + 2 * margin_x
        fine.pitch_x, fine.pitch_y = pitch_x / parts_x, pitch_y / parts_y
        fine.x = grid.x - margin_x * fine.pitch_x
        fine.y = grid.y - margin_y * fine.pitch_y
        self.fine = np.zeros((fine.rows, fine.cols))
        self._half = np.zeros((fine.rows, grid.cols))

    def apply(self, out: FloatArray) -> None:
        """Write ``fine``, blurred and averaged over each cell, into ``out`` [rows, cols]."""
        blur(self.fine, self.across, self.along, *self.parts, self._half, out)


@kernel
def blur(
    fine: FloatArray,
    across: FloatArray,
    along: FloatArray,
    parts_x: int,
    parts_y: int,
    half: FloatArray,
    out: FloatArray,
) -> None:
    """Spread ``fine`` by the stencils and average it over the cells of ``out`` [rows, cols].

    ``fine`` has parts_y × parts_x a cell and the stencils' half lengths more on each side; ``half``
    [rows of fine, cols] is scratch.
    """
    rows, cols = out.shape
    for i in range(fine.shape[0]):
        empty = True
        for j in range(fine.shape[1]):
            empty = empty and fine[i, j] == 0.0
        for j in range(cols):
            total = 0.0
            if not empty:
                for k in range(across.shape[0]):
                    part = 0.0
                    for m in range(parts_x):
                        part += fine[i, j * parts_x + k + m]
                    total += across[k] * part
            half[i, j] = total / parts_x
    out[:] = 0.0
    for i in range(rows):
        for k in range(along.shape[0]):
            weight = along[k] / parts_y
            for m in range(parts_y):
                row = i * parts_y + k + m
                for j in range(cols):
                    out[i, j] += weight * half[row, j]


@kernel
def hysteresis(pressure: FloatArray, excess: float, plays: FloatArray) -> None:
    """Let each cell read more while it is unloaded than while it was loaded, in place.

    A Prandtl-Ishlinskii sum of PLAYS generalised play operators: a cell's output is the mean of
    their states ``plays`` [PLAYS, rows, cols]. Each follows the pressure p upwards at once and
    downwards only once it is above (1 + h_k) p, with h_k spread evenly over 0 … 2·excess. So the
    loading curve is the pressure itself, the unloading one ends at (1 + excess) p, loops close,
    inner loops lie within, and no pressure reads 0 whatever came before.
    """
    rows, cols = pressure.shape
    count = plays.shape[0]
    for i in range(rows):
        for j in range(cols):
            value = pressure[i, j]
            total = 0.0
            for k in range(count):
                high = (1.0 + 2.0 * excess * (k + 0.5) / count) * value
                plays[k, i, j] = max(value, min(high, plays[k, i, j]))
                total += plays[k, i, j]
            pressure[i, j] = total / count


@kernel
def creep(
    pressure: FloatArray,
    share: float,
    time: float,
    elapsed: float,
    before: FloatArray,
    crept: FloatArray,
) -> None:
    """Let each cell's reading creep up under a lasting pressure, and back after it, in place.

    A standard linear solid: reading = p + share · z with dz/dt = (p − z)/time. Solved exactly for a
    pressure that went straight from ``before`` to now in ``elapsed`` [s]; ``before`` and ``crept``
    (z) [rows, cols] are the cells' memory.
    """
    rows, cols = pressure.shape
    ratio = elapsed / time
    decay = math.exp(-ratio)
    # Mean of the decay over the interval, 1 − r/2 + … where the interval is short.
    mean = -math.expm1(-ratio) / ratio if ratio > 0.0 else 1.0
    for i in range(rows):
        for j in range(cols):
            value = pressure[i, j]
            crept[i, j] = decay * crept[i, j] + (mean - decay) * before[i, j] + (1.0 - mean) * value
            before[i, j] = value
            pressure[i, j] = value + share * crept[i, j]


@kernel
def drift(
    offset: FloatArray, deviation: float, time: float, elapsed: float, normals: FloatArray
) -> None:
    """Let each cell's zero wander, in place: an Ornstein-Uhlenbeck process.

    ``offset`` [rows, cols] starts at 0 with a fresh tare and ends up with the standard
    ``deviation``, forgetting over ``time`` [s]; ``normals`` are standard normal numbers.
    """
    kept = math.exp(-elapsed / time)
    fresh = deviation * math.sqrt(1.0 - kept * kept)
    rows, cols = offset.shape
    for i in range(rows):
        for j in range(cols):
            offset[i, j] = kept * offset[i, j] + fresh * normals[i, j]


@kernel
def crosstalk(signal: FloatArray, share: float, rows: FloatArray, cols: FloatArray) -> None:
    """What every cell of each line reads too much: ``share`` of its line's mean signal.

    Cells of a resistive matrix share their drive and sense lines, and the current past them finds
    its way. ``signal`` [rows, cols]; ``rows`` and ``cols`` take the lines' parts.
    """
    height, width = signal.shape
    cols[:] = 0.0
    for i in range(height):
        total = 0.0
        for j in range(width):
            total += signal[i, j]
            cols[j] += signal[i, j]
        rows[i] = share * total / width
    for j in range(width):
        cols[j] *= share / height


@kernel
def count(
    signal: FloatArray,
    offset: FloatArray,
    rows: FloatArray,
    cols: FloatArray,
    live: FloatArray,
    noise: float,
    normals: FloatArray,
    ends: tuple[int, int],
    out: NDArray[np.uint16],
) -> None:
    """Round signal + offset + both lines' crosstalk + noise to counts, into ``out`` [rows, cols].

    All in counts. Cells of ``live`` 0 read 0; ``ends`` are the smallest count that is sent, below
    which goes 0, and the largest there is.
    """
    least, full = ends
    height, width = out.shape
    for i in range(height):
        for j in range(width):
            value = signal[i, j] + offset[i, j] + rows[i] + cols[j] + noise * normals[i, j] + 0.5
            value = min(max(value, 0.0), full + 0.5)
            value = value if live[i, j] > 0.0 and value >= least else 0.0
            out[i, j] = np.uint16(value)
