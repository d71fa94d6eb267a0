"""Reference integrals of force and energy for any material law.

Contact tables are fitted to these integrals and checked against them. The springs stand on the base
plane, and the object's face cuts the spherical cap, so

    F = ∬ σ(ε) dx dy,   U = ∬ z w(ε) dx dy,   ε = (n·P − h)/(z cos θ),   P = (x, y, z) on the cap.

The coordinates are t = n·P and the angle φ about the normal n. With lengths divided by a, dx dy = z
dt dφ. The integrals yield the ratio of each quantity to its closed form for a constant modulus E₀.
The ratio is 1 plus a term for the nonlinearity of the material. This form avoids cancellation as d
→ 0.

The integral over φ is exact. The substitution ε dφ = (t − h)/(p cos θ) dχ with p = √(t² − sin² θ)
makes ε linear in cos χ. For a polynomial law, a few nodes are therefore sufficient. The integral
over t is evaluated in y = √(t − sin θ). As a function of y, the integrand is analytic except for
poles at and near y = 0. The range is divided into pieces of at most one octave. The number of
pieces grows logarithmically as the face approaches the rim.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import ClosedForms, Fingertip, closed_forms, flatten
from softfinger.kinematics.contact.material import Material

# Number of Gauss points per piece. With 14 points, ∂F/∂θ has an error of 1e-10. With 18 points,
# only rounding errors remain.
_NODES = 18
# Number of points for laws above degree 8, whose error with 18 points can reach 1e-11.
_NODES_HIGH_DEGREE = 26
_PIECE_MIN = 2.0**-14  # minimum size of the first piece, relative to min(y1, √h)


def gauss_rule(nodes: int = _NODES) -> FloatArray:
    """Return Gauss-Legendre points and weights on [0, 1], float64 [2, nodes]."""
    points, weights = leggauss(nodes)
    return np.ascontiguousarray(np.stack([0.5 * (points + 1.0), 0.5 * weights]))


def circle_rule(degree: int) -> FloatArray:
    """Return cos χ and sin² χ [2, m] of an equal-weight rule that is exact up to ``degree``."""
    count = degree // 2 + 1
    angles = np.pi * (np.arange(count) + 0.5) / count
    return np.stack([np.cos(angles), np.sin(angles) ** 2])


@inner_kernel
def _horner(table: FloatArray, row: int, u: float) -> float:
    order = table.shape[1]
    value: float = table[row, order - 1]
    for j in range(order - 2, -1, -1):
        value = value * u + table[row, j]
    return value


@inner_kernel
def _ratios(
    gauss: FloatArray, circle: FloatArray, polynomials: FloatArray,
    delta: float, h: float, s: float, c: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return the ratios of F, U, ∂F/∂d, ∂F/∂θ and ∂U/∂θ to their closed forms for modulus E₀.

    The integrals use

        v = (t − h)/δ    q = t − h    r² = 1 − t²    p² = t² − s²    ``middle`` = r² c/(t c + p)
        ε = ``mean`` + ``amplitude`` cos χ = q (t + s r cos χ/c)/p²
        k = ``curvature`` = sin² χ t q/p²

    where ⟨·⟩ is the mean over χ at the strain ε, and S_1, W_1, T_1, S_2 and T_2 are the expansions
    of the law from `Material.expansions`:

        F      1 + 2δ ∫ v² ⟨S_1⟩ dv/(c p)          ∂F/∂d   1 + δ ∫ v ⟨T_1⟩ dv/(c p)
        U      1 + 3δ ∫ v³ ⟨W_1⟩ dv/(c p)
        ∂F/∂θ  1 + 2 ∫ v (q ⟨T_1⟩ + T_1(0) middle + q r²/p² ⟨T_2 + k T_2′⟩) dv/(c p)
        ∂U/∂θ  1 + 3 ∫ v² (q ⟨S_1⟩ + S_1(0) middle + q r²/p² ⟨S_2 + k S_2′⟩) dv/(c p)

    The integrals run over v from 0 to 1. The variables t and y are related by t = sin θ + y².

    ``gauss`` [2, n] contains points and weights on [0, 1]. ``circle`` [2, m] contains cos χ and
    sin² χ at equidistant angles. ``polynomials`` contains the expansions of the law. The ratio
    delta = d/a is in (0, 1]. To keep full precision, h = 1 − delta is a separate argument. The last
    two arguments are s = |sin θ| ≤ h and c = cos θ.
    """
    # For h near 1, compute h − s from h² − s² = c² − ρ² to avoid cancellation.
    gap = h - s if h < 0.5 else (c * c - delta * (1.0 + h)) / (h + s)
    y0 = 0.0
    if gap > 0.0:
        y0 = math.sqrt(gap)
    else:
        # Except for rounding, θ is at its limit.
        s = h
        c = math.sqrt(delta * (1.0 + h))
    y1 = math.sqrt(c * c / (1.0 + s))
    span = delta / (y0 + y1)  # y1 − y0
    first_s = polynomials[0, 0]
    first_t = polynomials[2, 0]
    count = circle.shape[1]
    share = 1.0 / count
    nodes = gauss.shape[1]
    # The integrand has poles at y² = −2 sin θ and, if y0 is not 0, at y = 0. If h is 0, there are
    # no poles.
    start = max(2.0 * y0, _PIECE_MIN * min(y1, math.sqrt(h))) if h > 0.0 else y1
    sum_f = 0.0
    sum_u = 0.0
    sum_fd = 0.0
    sum_ft = 0.0
    sum_ut = 0.0
    low = 0.0  # value of y − y0 at the lower end of the piece
    while low < span:
        high = max(start, 2.0 * (y0 + low)) - y0
        if not high < 0.75 * span:
            high = span
        width = high - low
        for i in range(nodes):
            rise = low + width * gauss[0, i]
            y = y0 + rise
            v = rise * (y + y0) / delta
            q = delta * v  # t − h
            t = h + q
            r2 = (span - rise) * (y1 + y) * (1.0 + t)
            p2 = y * y * (t + s)
            p = math.sqrt(p2)
            mean = q * t / p2
            amplitude = q * s * math.sqrt(r2) / (c * p2)
            a_s1 = 0.0
            a_w1 = 0.0
            a_t1 = 0.0
            a_s2 = 0.0
            a_t2 = 0.0
            for j in range(count):
                strain = mean + amplitude * circle[0, j]
                u = min(max(strain, 0.0), 1.0)
                a_s1 += share * _horner(polynomials, 0, u)
                a_w1 += share * _horner(polynomials, 1, u)
                a_t1 += share * _horner(polynomials, 2, u)
                curvature = share * circle[1, j] * t * q / p2
                a_s2 += share * _horner(polynomials, 3, u) + curvature * _horner(polynomials, 4, u)
                a_t2 += share * _horner(polynomials, 5, u) + curvature * _horner(polynomials, 6, u)
            dv = gauss[1, i] * width * 2.0 * y / delta
            scale = dv / (c * p)
            sum_f += scale * v * v * a_s1
            sum_u += scale * v * v * v * a_w1
            sum_fd += scale * v * a_t1
            middle = r2 * c / (t * c + p)
            across = q * r2 / p2
            sum_ft += scale * v * (q * a_t1 + first_t * middle + across * a_t2)
            sum_ut += scale * v * v * (q * a_s1 + first_s * middle + across * a_s2)
        low = high
    return (
        1.0 + 2.0 * delta * sum_f,
        1.0 + 3.0 * delta * sum_u,
        1.0 + delta * sum_fd,
        1.0 + 2.0 * sum_ft,
        1.0 + 3.0 * sum_ut,
    )


@kernel
def ratios_at(
    gauss: FloatArray, circle: FloatArray, polynomials: FloatArray,
    delta: FloatArray, h: FloatArray, s: FloatArray, c: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Evaluate :func:`_ratios` for arrays δ, h, s and c [n], and write to ``out`` [5, n]."""
    for i in range(delta.shape[0]):
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = _ratios(
            gauss, circle, polynomials, delta[i], h[i], s[i], c[i]
        )


@lru_cache(maxsize=8)
def _rules(material: Material, nodes: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    return gauss_rule(nodes), circle_rule(material.degree), material.expansions()


def ratios(
    material: Material,
    delta: FloatArray,
    h: FloatArray,
    s: FloatArray,
    c: FloatArray,
    nodes: int | None = None,
) -> FloatArray:
    """Return the ratios [5, n] of a material law at δ, h, s and c [n]; see :func:`_ratios`.

    ``nodes`` is the number of Gauss points per piece; by default it depends on the law's degree.
    """
    out = np.empty((5, delta.size))
    usual = _NODES if material.degree <= 8 else _NODES_HIGH_DEGREE
    ratios_at(*_rules(material, nodes or usual), delta, h, s, c, out)
    return out


def integrate(
    tip: Fingertip, material: Material, d: ArrayLike, theta: ArrayLike, nodes: int | None = None
) -> ClosedForms:
    """Integrate force, energy and first partials for any material, with a relative error of 1e-14.

    ``d`` [m] and ``theta`` [rad] are broadcast. The results are zero for d ≤ 0. The results are NaN
    outside the domain, which ends at d = a and at the limit on θ. ``nodes`` is as in
    :func:`ratios`.
    """
    shape, (depth, tilt) = flatten(d, theta)
    radius = tip.radius
    inside = (depth > 0.0) & (depth <= radius) & (np.abs(tilt) <= tip.theta_limit(depth))
    within = np.flatnonzero(inside)
    found = np.full((5, depth.size), np.nan)
    found[:, depth <= 0.0] = 1.0
    found[:, within] = ratios(
        material,
        depth[within] / radius,
        (radius - depth[within]) / radius,
        np.abs(np.sin(tilt[within])),
        np.cos(tilt[within]),
        nodes,
    )
    r_f, r_u, r_fd, r_ft, r_ut = found
    closed = closed_forms(material.reference_modulus, depth, tilt)
    six = (
        each * ratio for each, ratio in zip(closed, (r_f, r_u, r_fd, r_ft, r_f, r_ut), strict=True)
    )
    return ClosedForms(*(row.reshape(shape)[()] for row in six))
