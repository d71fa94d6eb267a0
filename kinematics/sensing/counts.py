"""Conversion of a calibrated sensor's counts to pressures: kernels over a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel

FloatArray = NDArray[np.float64]


@kernel
def to_pressure(
    counts: NDArray[np.uint16],
    zero: FloatArray,
    gain: FloatArray,
    curve: FloatArray,
    out: FloatArray,
) -> None:
    """Convert counts [rows, cols] to Pa: x = max(counts − zero, 0)·gain, then the curve of x.

    ``curve`` is (exponent b, c_1, c_2, c_3): p = c_1 x^b for b ≠ 1, else c_1 x + c_2 x² + c_3 x³.
    """
    exponent, c1, c2, c3 = curve[0], curve[1], curve[2], curve[3]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            x = max(float(counts[i, j]) - zero[i, j], 0.0) * gain[i, j]
            if exponent == 1.0:
                out[i, j] = x * (c1 + x * (c2 + x * c3))
            else:
                out[i, j] = c1 * x**exponent if x > 0.0 else 0.0
