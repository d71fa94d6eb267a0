"""What a soft, resistive pressure sensor does to the pressure before it is counted.

Each operator works in place on arrays [rows, cols]. Hysteresis, creep and drift have a memory in
each cell. The forms are the usual ones; the numbers in the profiles are our own choice.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel

FloatArray = NDArray[np.float64]

PLAYS = 4


def hysteresis(pressure: FloatArray, excess: float, plays: FloatArray) -> None:
    """Let each cell read more while it is unloaded than while it was loaded.

    A Prandtl-Ishlinskii sum of PLAYS generalised play operators: a cell's output is the mean of
    their states ``plays`` [PLAYS, rows, cols]. Each follows the pressure p upwards at once and
    downwards only once it is above (1 + h_k) p, with h_k spread evenly over 0 … 2·excess. So the
    loading curve is the pressure itself, the unloading one ends at (1 + excess) p, loops close,
    inner loops lie within, and no pressure reads 0 whatever came before.
    """
    widths = 2.0 * excess * (np.arange(PLAYS) + 0.5) / PLAYS
    np.minimum(plays, (1.0 + widths)[:, None, None] * pressure, out=plays)
    np.maximum(plays, pressure, out=plays)
    plays.mean(axis=0, out=pressure)


def creep(
    pressure: FloatArray,
    share: float,
    time: float,
    elapsed: float,
    before: FloatArray,
    crept: FloatArray,
) -> None:
    """Let each cell's reading creep up under a lasting pressure, and back after it.

    A standard linear solid: reading = p + share · z with dz/dt = (p − z)/time. Solved exactly for a
    pressure that went straight from ``before`` to now in ``elapsed`` [s]; ``before`` and ``crept``
    (z) are the cells' memory.
    """
    ratio = elapsed / time
    decay = math.exp(-ratio)
    # Mean of the decay over the interval, 1 − r/2 + … where the interval is short.
    mean = -math.expm1(-ratio) / ratio if ratio > 0.0 else 1.0
    crept *= decay
    crept += (mean - decay) * before + (1.0 - mean) * pressure
    before[:] = pressure
    pressure += share * crept


def drift(
    offset: FloatArray, deviation: float, time: float, elapsed: float, normals: FloatArray
) -> None:
    """Let each cell's zero drift: an Ornstein-Uhlenbeck process.

    ``offset`` starts at 0 with a fresh tare and ends up with the standard ``deviation``, forgetting
    over ``time`` [s]; ``normals`` are standard normal numbers.
    """
    kept = math.exp(-elapsed / time)
    offset *= kept
    offset += deviation * math.sqrt(1.0 - kept * kept) * normals


def crosstalk(signal: FloatArray, share: float, rows: FloatArray, cols: FloatArray) -> None:
    """What every cell of each line reads too much: ``share`` of its line's mean signal.

    Cells of a resistive matrix share their drive and sense lines, and current leaks along them.
    ``rows`` [rows] and ``cols`` [cols] take the lines' parts.
    """
    np.multiply(share, signal.mean(axis=1), out=rows)
    np.multiply(share, signal.mean(axis=0), out=cols)


@kernel
def count(
    signal: FloatArray,
    offset: FloatArray,
    lines: tuple[FloatArray, FloatArray],
    live: FloatArray,
    noise: float,
    normals: FloatArray,
    ends: tuple[int, int],
    out: NDArray[np.uint16],
) -> None:
    """Round signal + offset + both ``lines``' crosstalk + noise to counts, into ``out``.

    All in counts. Cells of ``live`` 0 read 0; ``ends`` are the smallest count that is sent, below
    which goes 0, and the largest there is.
    """
    rows, cols = lines
    least, full = ends
    height, width = out.shape
    for i in range(height):
        for j in range(width):
            value = signal[i, j] + offset[i, j] + rows[i] + cols[j] + noise * normals[i, j] + 0.5
            value = min(max(value, 0.0), full + 0.5)
            value = value if live[i, j] > 0.0 and value >= least else 0.0
            out[i, j] = np.uint16(value)
