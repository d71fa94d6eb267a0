"""Normal equations of the pressure grid's likelihood, as kernels.

The model of a cell is ``γ · mean(σ(ε)) = γ A (σ(ε̄) + ½ σ''(ε̄) V)``, with A the cell's fraction in
the footprint, ε̄ and V the strain's mean and variance over that fraction; it is exact for a
constant modulus, and to the strain's third moment for any other law. The strain is linear in (u, v,
w) (see footprint.py), so its means are sums of fixed means of g, x g, y g for whole cells; cut
cells are integrated (packing.py). The outline adds no derivative of its own, as σ is 0 there.
"""

from __future__ import annotations

from typing import TypeAlias

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inlined_kernel
from softfinger.kinematics.compiled.simd import Pointer, address
from softfinger.kinematics.contact.lookup import Triple
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.state import (
    ALONG_X,
    ALONG_Y,
    FRACTION,
    LAW_TERMS,
    PLAIN,
    READING,
    VARIANCE,
    WEIGHT,
    EstimatorState,
    Law,
)

# What `compress` makes of the first planes of the packed cells.
STRESS, BY_U, BY_V, BY_W = FRACTION, PLAIN, ALONG_X, ALONG_Y
Two: TypeAlias = tuple[float, float]
Terms: TypeAlias = tuple[Two, Two, Two, Two, Two, Two]  # in pairs

# A cell that can't read below its floor (0, or the smallest count sent) reads more than the
# pressure on average, by E[max(z + e, 0)] − z standard deviations at a pressure of z above it,
# e ~ N(0, 1). Fitted as (1 − z/CLIP_END)² times this polynomial, within 3e-4. E[max(e − z, 0)] is
# the same number. Cells more than CLIP_BELOW below the floor carry next to no information.
CLIP_END = 3.5
CLIP_BELOW = 2.0
CLIP = (0.399207, -0.275277, 0.0188358, 0.0260713, -0.00538491)


def set_law(law: Law, material: Material) -> None:
    """Take the ``material``'s law. Raises ValueError for one of more than LAW_TERMS terms."""
    if material.degree >= LAW_TERMS:
        raise ValueError(f"a law's degree must be below {LAW_TERMS}, got {material.degree}")
    law.bent = not material.is_linear
    law.polynomial[1 : material.degree + 1] = [float(each) for each in material.coefficients]


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
def _two_more(half: float, slope: float, value: float, c: Two, strain: float) -> Triple:
    """Two steps of Horner's scheme for a polynomial, its slope and half its second derivative."""
    half, slope, value = half * strain + slope, slope * strain + value, value * strain + c[1]
    return half * strain + slope, slope * strain + value, value * strain + c[0]


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
    p = address(state.law.polynomial)
    c: Terms = (
        (p[0], p[1]),
        (p[2], p[3]),
        (p[4], p[5]),
        (p[6], p[7]),
        (p[8], p[9]),
        (p[10], p[11]),
    )
    for k in range(state.fit.count):
        # Arrays are read here alone: a function that took one would keep the loop out of lanes.
        fraction = packed[FRACTION * size + k]
        g = packed[PLAIN * size + k]
        g_x = packed[ALONG_X * size + k]
        g_y = packed[ALONG_Y * size + k]
        strain = min(max(1.0 - (u * g - v * g_x - w * g_y), 0.0), 1.0)
        half, slope, stress = _two_more(0.0, 0.0, 0.0, c[5], strain)
        half, slope, stress = _two_more(half, slope, stress, c[4], strain)
        half, slope, stress = _two_more(half, slope, stress, c[3], strain)
        half, slope, stress = _two_more(half, slope, stress, c[2], strain)
        half, slope, stress = _two_more(half, slope, stress, c[1], strain)
        half, slope, stress = _two_more(half, slope, stress, c[0], strain)
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
    for k, value in enumerate((s00, s01, s02, s03, s11, s12, s13, s22, s23, s33)):
        normal[k] = value
    right = address(sums.right)
    for k, value in enumerate((r0, r1, r2, r3)):
        right[k] = value
    sums.misfit = rr
    sums.readings = yy
    sums.weight = ww
