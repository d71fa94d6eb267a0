"""Compiled loops that call the contact kernels one by one, as the control loop's kernels do.

In a ``loop`` the calls are independent, so that the processor overlaps them. In a ``chain`` each
call's arguments wait for the last call's result: what one call alone takes. The results are written
to an array, which keeps the compiler from moving a call's work out of the loop or dropping it.
``two`` writes force and energy alone, so that it may drop the partials.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.contact import closed_form
from kinematics.kernels import kernel
from kinematics.lookup import lookup
from kinematics.quadrature import exact

FloatArray = NDArray[np.float64]


@kernel
def closed_loop_two(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], _, _, _, _ = closed_form(modulus, d[k], theta[k])


@kernel
def closed_loop_six(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], out[2], out[3], out[4], out[5] = closed_form(modulus, d[k], theta[k])


@kernel
def closed_chain_two(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    wait = 0.0
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], last, _, _, _, _ = closed_form(modulus, d[k] + wait, theta[k] + wait)
            out[1] = last
            wait = 0.0 * last


@kernel
def closed_chain_six(
    repeat: int, modulus: float, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    wait = 0.0
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], out[2], out[3], out[4], last = closed_form(
                modulus, d[k] + wait, theta[k] + wait
            )
            out[5] = last
            wait = 0.0 * last


@kernel
def lookup_loop_two(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], _, _, _, _, _ = lookup(data, d[k], theta[k])


@kernel
def lookup_loop_six(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], out[2], out[3], out[4], out[5], _ = lookup(data, d[k], theta[k])


@kernel
def lookup_chain_two(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    wait = 0.0
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], last, _, _, _, _, _ = lookup(data, d[k] + wait, theta[k] + wait)
            out[1] = last
            wait = 0.0 * last


@kernel
def lookup_chain_six(
    repeat: int, data: FloatArray, d: FloatArray, theta: FloatArray, out: FloatArray
) -> None:
    wait = 0.0
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], out[2], out[3], out[4], last, _ = lookup(
                data, d[k] + wait, theta[k] + wait
            )
            out[5] = last
            wait = 0.0 * last


@kernel
def exact_loop(
    repeat: int,
    rules: tuple[FloatArray, FloatArray, FloatArray],
    radius: float,
    modulus: float,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
) -> None:
    gauss, circle, parts = rules
    for _ in range(repeat):
        for k in range(d.shape[0]):
            out[0], out[1], out[2], out[3], out[4], out[5] = exact(
                gauss, circle, parts, radius, modulus, d[k], theta[k]
            )


@kernel
def exact_batch(
    rules: tuple[FloatArray, FloatArray, FloatArray],
    radius: float,
    modulus: float,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
) -> None:
    """The integrals at d and θ [n] into ``out`` [6, n]."""
    gauss, circle, parts = rules
    for k in range(d.shape[0]):
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k], out[5, k] = exact(
            gauss, circle, parts, radius, modulus, d[k], theta[k]
        )
