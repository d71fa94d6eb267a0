"""Compiled loops that call the contact kernels one by one, as the control loop's kernels do.

In a ``loop`` the calls are independent, so that the processor overlaps them; the order of the n
points, n a power of two, jumps about so that the compiler can't merge calls into vector
instructions, which a single call has none of. In a ``chain`` each call's arguments wait for the
last call's result. The six outputs go to the point's row of ``out`` [n, 6], which keeps the
compiler from dropping a call's work.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.contact.closed_form import closed_form
from softfinger.kinematics.contact.lookup import lookup_at

FloatArray = NDArray[np.float64]


@kernel
def _next(i: int, count: int) -> int:
    """The next of ``count`` places, a power of two: each once before any comes again."""
    return (5 * i + 1) & (count - 1)


@kernel
def closed_loop(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    i = 0
    for _ in range(repeat * d.shape[0]):
        i = _next(i, d.shape[0])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5] = closed_form(
            modulus, d[i], theta[i]
        )


@kernel
def closed_chain(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    wait = 0.0
    for _ in range(repeat):
        for i in range(d.shape[0]):
            out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], last = closed_form(
                modulus, d[i] + wait, theta[i] + wait
            )
            out[i, 5] = last
            wait = 0.0 * last


@kernel
def lookup_loop(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    p = address(data)
    i = 0
    for _ in range(repeat * d.shape[0]):
        i = _next(i, d.shape[0])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5], _ = lookup_at(
            p, d[i], theta[i]
        )


@kernel
def lookup_chain(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    p = address(data)
    wait = 0.0
    for _ in range(repeat):
        for i in range(d.shape[0]):
            out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], last, _ = lookup_at(
                p, d[i] + wait, theta[i] + wait
            )
            out[i, 5] = last
            wait = 0.0 * last
