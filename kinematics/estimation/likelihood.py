"""Normal equations of the pressure grid's likelihood, as kernels.

The model of a cell is ``γ · mean(σ(ε)) = γ A (σ(ε̄) + ½ σ''(ε̄) V)``, with A the cell's fraction in
the footprint, ε̄ and V the strain's mean and variance over that fraction; it is exact for a
constant modulus, and to the strain's third moment for any other law. The strain is linear in (u, v,
w) (see footprint.py), so its means are sums of fixed means of g, x g, y g for whole cells; cut
cells are integrated (packing.py). The outline adds no derivative of its own, as σ is 0 there.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inlined_kernel
from softfinger.kinematics.compiled.simd import Pointer, address
from softfinger.kinematics.estimation.state import (
    ALONG_X,
    ALONG_Y,
    FRACTION,
    LAW_PIECES,
    LAW_TERMS,
    PLAIN,
    READING,
    VARIANCE,
    WEIGHT,
    EstimatorState,
    Law,
)
from softfinger.kinematics.sensing.footprint import FloatArray

# What `compress` makes of the first planes of the packed cells.
STRESS, BY_U, BY_V, BY_W = FRACTION, PLAIN, ALONG_X, ALONG_Y
Eight: TypeAlias = tuple[float, float, float, float, float, float, float, float]

# A cell that can't read below its floor (0, or the smallest count sent) reads more than the
# pressure on average, by E[max(z + e, 0)] − z standard deviations at a pressure of z above it,
# e ~ N(0, 1). Fitted as (1 − z/CLIP_END)² times this polynomial, within 3e-4. E[max(e − z, 0)] is
# the same number. Cells more than CLIP_BELOW below the floor carry next to no information.
CLIP_END = 3.5
CLIP_BELOW = 2.0
CLIP = (0.399207, -0.275277, 0.0188358, 0.0260713, -0.00538491)


def set_law(law: Law, coefficients: FloatArray) -> None:
    """Convert any material's law [pieces, order] to one of two forms.

    A law of one polynomial of at most LAW_TERMS terms is kept; any other becomes LAW_PIECES cubics
    by value and slope at the pieces' ends, within 1e-9 of a smooth law.
    """
    pieces, order = coefficients.shape
    law.is_polynomial = pieces == 1 and order <= LAW_TERMS
    law.bent = not law.is_polynomial or bool(coefficients[0, 2:].any())
    if law.is_polynomial:
        law.polynomial[:order] = coefficients[0]
        return
    strain = np.linspace(0.0, 1.0, LAW_PIECES + 1)
    index = np.minimum((strain * pieces).astype(int), pieces - 1)
    t = strain * pieces - index
    value = np.zeros_like(strain)
    slope = np.zeros_like(strain)
    for j in range(order - 1, -1, -1):
        slope = slope * t + value
        value = value * t + coefficients[index, j]
    slope *= pieces / LAW_PIECES
    law.cubics[:, 0] = value
    law.cubics[:, 1] = slope
    rise = np.diff(value)
    law.cubics[:-1, 2] = 3.0 * rise - 2.0 * slope[:-1] - slope[1:]
    law.cubics[:-1, 3] = slope[:-1] + slope[1:] - 2.0 * rise


@fast_inner_kernel
def footprint_energy(state: EstimatorState, packed: Pointer) -> tuple[float, float]:
    """Return Σ W p² [Pa²] and Σ W over the packed cells."""
    size = state.model.rows * state.model.cols
    energy = 0.0
    number = 0.0
    for k in range(state.fit.count):
        weight = packed[WEIGHT * size + k]
        energy += weight * packed[READING * size + k] * packed[READING * size + k]
        number += weight
    return energy, number


@inlined_kernel
def _polynomial(c: Eight, strain: float) -> tuple[float, float, float]:
    """A polynomial, its slope and half its second derivative."""
    value, slope, half = c[7], 0.0, 0.0
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[6]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[5]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[4]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[3]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[2]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[1]
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[0]
    return value, slope, half


@inlined_kernel
def _compared(
    stress: float,
    gain: float,
    reading: float,
    saturation: float,
    floor: float,
    clip: float,
    clipped: bool,
) -> tuple[float, float, float]:
    """(reading − model, the model's response to pressure, 1 for a cell that counts)."""
    model = gain * stress
    residual = max(reading, floor) - model
    response = 1.0
    lower = floor
    if clipped:
        # As much below the floor as above it, a cell reads as much more than the larger of both.
        depth = (model - floor) * (1.0 / clip)
        z = min(abs(depth), CLIP_END)
        above = 1.0 - z * (1.0 / CLIP_END)
        base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
        rise = CLIP[1] + z * (2.0 * CLIP[2] + z * (3.0 * CLIP[3] + z * 4.0 * CLIP[4]))
        rise = above * (above * rise - (2.0 / CLIP_END) * base)
        residual = max(reading, floor) - max(model, floor) - clip * above * above * base
        response = 1.0 + rise if depth >= 0.0 else -rise
        lower = floor - CLIP_BELOW * clip
    counts = ((reading < saturation) | (model < saturation)) & (model >= lower)
    return residual, response, 1.0 if counts else 0.0


@fast_inner_kernel
def compress(state: EstimatorState, packed: Pointer) -> None:
    """Put the material into the packed cells, in place.

    STRESS takes the mean stress over each cell, BY_U, BY_V and BY_W its derivatives by −u, v and w:
    σ' times the means of g, x g and y g.
    """
    u = state.fit.face.u
    v = state.fit.face.v
    w = state.fit.face.w
    size = state.model.rows * state.model.cols
    # It doesn't change within the loop, of which the compiler makes two.
    polynomial = state.law.is_polynomial
    p = address(state.law.polynomial)
    c = (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7])
    cubics = address(state.law.cubics)
    for k in range(state.fit.count):
        # Arrays are read here alone: a function that took one would keep the loop out of lanes.
        fraction = packed[FRACTION * size + k]
        g = packed[PLAIN * size + k]
        g_x = packed[ALONG_X * size + k]
        g_y = packed[ALONG_Y * size + k]
        strain = min(max(1.0 - (u * g - v * g_x - w * g_y), 0.0), 1.0)
        if polynomial:
            stress, slope, half = _polynomial(c, strain)
        else:
            t = strain * LAW_PIECES
            piece = np.int32(t)
            t -= piece
            at = 4 * piece
            c1 = cubics[at + 1]
            c2 = cubics[at + 2]
            c3 = cubics[at + 3]
            stress = cubics[at] + t * (c1 + t * (c2 + t * c3))
            slope = (c1 + t * (2.0 * c2 + t * 3.0 * c3)) * LAW_PIECES
            half = (c2 + 3.0 * t * c3) * (LAW_PIECES * LAW_PIECES)
        # From a strain of 1 on the stress stays, and what varies there doesn't show.
        half = half if strain < 1.0 else 0.0
        stress = fraction * (stress + half * packed[VARIANCE * size + k])
        slope *= fraction
        packed[STRESS * size + k] = stress
        packed[BY_U * size + k] = slope * g
        packed[BY_V * size + k] = slope * g_x
        packed[BY_W * size + k] = slope * g_y


@fast_inner_kernel
def accumulate(state: EstimatorState, packed: Pointer) -> None:
    """Sum up one Gauss-Newton step over the pressed cells, into ``state.fit.sums``.

    Columns of the Jacobian are (mean stress, σ' g, σ' x g, σ' y g), that is ∂/∂gain and, but for a
    factor ∓gain, ∂/∂(u, v, w). A full cell counts only while the model stays below its end. No
    reading is less than ``signal.floor``; with ``fit.clip`` > 0 cells end there, without it a cell
    that the model puts below the floor doesn't count.
    """
    gain = state.fit.gain
    saturation = state.signal.saturation
    floor = state.signal.floor
    clip = state.fit.clip
    size = state.model.rows * state.model.cols
    clipped = clip > 0.0
    s00 = s01 = s02 = s03 = s11 = s12 = s13 = s22 = s23 = s33 = 0.0
    r0 = r1 = r2 = r3 = rr = yy = ww = 0.0
    for k in range(state.fit.count):
        stress = packed[STRESS * size + k]
        a1 = packed[BY_U * size + k]
        a2 = packed[BY_V * size + k]
        a3 = packed[BY_W * size + k]
        reading = packed[READING * size + k]
        residual, response, counts = _compared(
            stress, gain, reading, saturation, floor, clip, clipped
        )
        squares = packed[WEIGHT * size + k] * reading * reading
        weight = packed[WEIGHT * size + k] * counts
        if clipped:
            stress *= response
            a1 *= response
            a2 *= response
            a3 *= response
        w0 = weight * stress
        w1 = weight * a1
        w2 = weight * a2
        w3 = weight * a3
        s00 += w0 * stress
        s01 += w0 * a1
        s02 += w0 * a2
        s03 += w0 * a3
        s11 += w1 * a1
        s12 += w1 * a2
        s13 += w1 * a3
        s22 += w2 * a2
        s23 += w2 * a3
        s33 += w3 * a3
        r0 += w0 * residual
        r1 += w1 * residual
        r2 += w2 * residual
        r3 += w3 * residual
        rr += weight * residual * residual
        yy += squares
        ww += weight
    sums = state.fit.sums
    normal = address(sums.normal)
    normal[0] = s00
    normal[1] = s01
    normal[2] = s02
    normal[3] = s03
    normal[4] = s11
    normal[5] = s12
    normal[6] = s13
    normal[7] = s22
    normal[8] = s23
    normal[9] = s33
    right = address(sums.right)
    right[0] = r0
    right[1] = r1
    right[2] = r2
    right[3] = r3
    sums.misfit = rr
    sums.readings = yy
    sums.weight = ww
