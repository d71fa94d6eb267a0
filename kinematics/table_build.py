"""How contact tables are fitted to the reference integrals, chosen by cost, and certified."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from kinematics.contact import Fingertip, theta_limits
from kinematics.kernels import kernel
from kinematics.lanes import LANES, STRIDE, TRIANGLE, patch_size, row_lengths
from kinematics.material import Material
from kinematics.quadrature import circle_rule, exact, gauss_rule, ratios
from kinematics.table import (
    CLOSED,
    CORNER,
    CORNER_PIECES,
    CORNER_SIZE,
    CORNER_TERMS,
    FIRST,
    FORM,
    FORMAT,
    FORMS,
    H_PIECES,
    HEADER,
    INVERSE_RADIUS,
    LOWEST,
    MAX_ERROR,
    MODULUS,
    PIECES,
    RADIUS,
    SHIFT,
    SIZE,
    START,
    TOLERANCE,
    VERSION,
    WORST_D,
    WORST_THETA,
    Y_PIECES,
    TableError,
    aligned,
    lookup,
)

FloatArray = NDArray[np.float64]

MEMORY_LIMIT = 256 * 1024  # bytes of a table
_MANTISSA = 52
_OCTAVES = 3  # of h above the corner, where the ratios contain log h
_SAFETY = 0.5  # of the tolerance that the fit's own estimate may use up
_CORNER_DEEPEST = 34  # octaves of h that the corner's fit is sampled over


class Plan(NamedTuple):
    """A form and the grid of its pieces: 2^bits an octave of h, y_pieces over y."""

    form: int
    bits: int
    y_pieces: int


# Cheapest first, as measured; each grid is the one whose pieces suit the degree best.
PLANS = (
    Plan(1, 3, 16),
    Plan(2, 2, 8),
    Plan(3, 1, 8),
    Plan(4, 1, 4),
    Plan(4, 2, 8),
    Plan(5, 1, 4),
    Plan(6, 1, 4),
    Plan(7, 1, 4),
)


@dataclass(frozen=True)
class Law:
    """A material as the quadrature's kernels take it."""

    gauss: FloatArray
    circle: FloatArray
    parts: FloatArray
    modulus: float

    @classmethod
    def of(cls, material: Material) -> Law:
        """Rules and expansions for ``material``."""
        return cls(
            gauss_rule(),
            circle_rule(material.degree),
            material.expansions(),
            material.reference_modulus,
        )


@kernel
def _sample(
    gauss: FloatArray,
    circle: FloatArray,
    parts: FloatArray,
    h: FloatArray,
    y: FloatArray,
    out: FloatArray,
) -> None:
    """Ratios [5, n] at the table's coordinates h in (0, 1) and y in [0, 1]."""
    for i in range(h.shape[0]):
        delta = 1.0 - h[i]
        # 1 − u² with u = h y, written so that nothing cancels when h and y near 1.
        rest = (1.0 - y[i] + delta * y[i]) * (1.0 + h[i] * y[i])
        c = math.sqrt(delta * (1.0 + h[i]) / rest)
        s = h[i] * math.sqrt((1.0 - y[i]) * (1.0 + y[i]) / rest)
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i]) = ratios(
            gauss, circle, parts, delta, h[i], s, c
        )


@kernel
def _errors(
    data: FloatArray,
    gauss: FloatArray,
    circle: FloatArray,
    parts: FloatArray,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
) -> None:
    """Largest relative error [n] of the table's six outputs, each against the integral."""
    for i in range(d.shape[0]):
        f, u, fd, ft, ud, ut, _ = lookup(data, d[i], theta[i])
        e_f, e_u, e_fd, e_ft, e_ud, e_ut = exact(
            gauss, circle, parts, data[RADIUS], data[MODULUS], d[i], theta[i]
        )
        worst = max(abs(f / e_f - 1.0), abs(u / e_u - 1.0))
        worst = max(worst, abs(fd / e_fd - 1.0), abs(ud / e_ud - 1.0))
        if e_ft != 0.0:
            worst = max(worst, abs(ft / e_ft - 1.0), abs(ut / e_ut - 1.0))
        out[i] = worst


def build(tip: Fingertip, material: Material, tolerance: float, form: int | None) -> FloatArray:
    """The array of the cheapest certified table; see ContactTable.build."""
    if not (0.0 < tolerance < 1.0):
        raise TableError(f"the tolerance must lie between 0 and 1, not {tolerance!r}")
    law = Law.of(material)
    best = math.inf
    if material.is_linear and form in (None, CLOSED):
        data = _header(tip, law, Plan(CLOSED, 0, 0), tolerance)
        best = certify(data, law)
        if best <= tolerance:
            return data
    for plan in PLANS:
        if form is not None and plan.form != form:
            continue
        fitted, estimate = fit(tip, law, plan, tolerance)
        if fitted is None:
            best = min(best, estimate)
            continue
        reached = certify(fitted, law)
        if reached <= tolerance:
            return fitted
        best = min(best, reached)
    raise TableError(
        f"no table within {MEMORY_LIMIT // 1024} KiB reaches {tolerance:.3g} for this material; "
        f"the best reached {best:.3g}"
    )


def _header(tip: Fingertip, law: Law, plan: Plan, tolerance: float) -> FloatArray:
    """The array with its header filled in, coefficients zero."""
    degree, shape = FORMS[plan.form]
    size = patch_size(degree, shape) if plan.form != CLOSED else 0
    h_pieces = _OCTAVES << plan.bits
    start = HEADER + -(-2 * h_pieces // STRIDE) * STRIDE
    corner = start + h_pieces * plan.y_pieces * size
    total = corner + CORNER_PIECES * CORNER_SIZE if plan.form != CLOSED else HEADER
    data = aligned(total)
    lowest = 0.5**_OCTAVES
    shift = _MANTISSA - plan.bits
    data[[FORMAT, FORM, TOLERANCE]] = VERSION, plan.form, tolerance
    data[[RADIUS, MODULUS, INVERSE_RADIUS]] = tip.radius, law.modulus, 1.0 / tip.radius
    if plan.form != CLOSED:
        data[[LOWEST, SHIFT]] = lowest, shift
        data[FIRST] = int(np.float64(lowest).view(np.int64)) >> shift
        data[[H_PIECES, Y_PIECES, SIZE]] = h_pieces, plan.y_pieces, size
        data[[PIECES, START, CORNER]] = h_pieces * plan.y_pieces, start, corner
        for i in range(h_pieces):
            low, high = _h_piece(plan, i)
            data[HEADER + 2 * i : HEADER + 2 * i + 2] = (low + high) / 2, 2 / (high - low)
    return data


def _h_piece(plan: Plan, i: int) -> tuple[float, float]:
    octave, part = divmod(i, 1 << plan.bits)
    base = 0.5 ** (_OCTAVES - octave)
    width = base / (1 << plan.bits)
    return base + part * width, base + (part + 1) * width


def fit(
    tip: Fingertip, law: Law, plan: Plan, tolerance: float
) -> tuple[FloatArray | None, float]:
    """Fit one plan: (array, estimate), or (None, estimate) as soon as it can't meet the tolerance.

    The estimate is the largest sum of the discarded Chebyshev coefficients over the ratio.
    """
    data = _header(tip, law, plan, tolerance)
    if data.nbytes > MEMORY_LIMIT:
        return None, math.inf
    degree, shape = FORMS[plan.form]
    count = degree + 3  # two more than needed, which tell what is left out
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    size, start, corner = (int(data[i]) for i in (SIZE, START, CORNER))
    estimate = 0.0
    # From the domain's deep end, where the pieces are hardest: plans that fail, fail soon.
    for i in reversed(range(int(data[H_PIECES]))):
        low, high = _h_piece(plan, i)
        h = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        for j in range(plan.y_pieces):
            y = (j + 0.5 * (nodes + 1.0)) / plan.y_pieces
            values = _ratios_at(law, h[:, None], y[None, :])
            terms = np.einsum("ai,bj,kij->kab", inverse, inverse, values)
            scale = np.abs(values).min(axis=(1, 2))
            estimate = max(estimate, _discarded(terms, scale, degree, shape))
            if estimate > _SAFETY * tolerance:
                return None, estimate
            at = start + (i * plan.y_pieces + j) * size
            data[at : at + size] = _patch(terms, degree, shape)
    for j in range(CORNER_PIECES):
        numbers, misfit = _corner(law, j)
        estimate = max(estimate, misfit)
        at = corner + j * CORNER_SIZE
        data[at : at + CORNER_SIZE] = numbers
    return (data if estimate <= _SAFETY * tolerance else None), estimate


def _ratios_at(law: Law, h: FloatArray, y: FloatArray) -> FloatArray:
    """Ratios [5, …] at broadcast h and y."""
    heights, places = np.broadcast_arrays(h, y)
    out = np.empty((LANES, heights.size))
    _sample(law.gauss, law.circle, law.parts, heights.ravel(), places.ravel(), out)
    return out.reshape(LANES, *heights.shape)


def _corner(law: Law, piece: int) -> tuple[FloatArray, float]:
    """One piece over y of the corner: its numbers, and the largest relative misfit at its nodes.

    A and B of R = A + B log h are found by least squares in h at each node of y. Only their sum is
    well determined; since it is found linearly, it is interpolated in y as R itself would be.
    """
    rows, columns = CORNER_TERMS
    lowest = 0.5**_OCTAVES
    nodes = np.cos(np.pi * (np.arange(columns) + 0.5) / columns)
    y = (piece + 0.5 * (nodes + 1.0)) / CORNER_PIECES
    near = 0.5 * lowest * (1.0 + np.cos(np.pi * (np.arange(3 * rows) + 0.5) / (3 * rows)))
    h = np.concatenate([near, lowest * 0.5 ** np.arange(1, _CORNER_DEEPEST, 1.0)])
    values = np.moveaxis(_ratios_at(law, h[:, None], y[None, :]), 0, 1).reshape(h.size, -1)
    basis = chebyshev.chebvander(2.0 * h / lowest - 1.0, rows - 1)
    matrix = np.concatenate([basis, basis * np.log(h)[:, None]], axis=1)
    found = np.linalg.lstsq(matrix, values, rcond=1e-14)[0]
    misfit = float(np.max(np.abs(matrix @ found / values - 1.0)))
    terms = found.reshape(2, rows, LANES, columns)
    in_y = _to_powers(columns) @ np.linalg.inv(chebyshev.chebvander(nodes, columns - 1))
    powers = np.einsum("ai,bj,pikj->abpk", _to_powers(rows), in_y, terms)
    return powers[::-1, ::-1].reshape(-1), misfit


def _to_powers(count: int) -> FloatArray:
    """Matrix from ``count`` Chebyshev coefficients to those of rising powers."""
    columns = [chebyshev.cheb2poly(row) for row in np.eye(count)]
    return np.stack([np.pad(column, (0, count - len(column))) for column in columns], axis=1)


def _discarded(terms: FloatArray, scale: FloatArray, degree: int, shape: int) -> float:
    count = terms.shape[-1]
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    outside = i + j > degree if shape == TRIANGLE else np.maximum(i, j) > degree
    return float(np.max((np.abs(terms) * outside).sum(axis=(1, 2)) / scale))


def _patch(terms: FloatArray, degree: int, shape: int) -> FloatArray:
    """Chebyshev coefficients [5, ≥ n, ≥ n] as the numbers that `lanes.patch` reads."""
    kept = terms[:, : degree + 1, : degree + 1].copy()
    lengths = row_lengths(degree, shape)
    for i in range(degree + 1):
        kept[:, i, lengths[degree - i] :] = 0.0
    change = _to_powers(degree + 1)
    powers = np.einsum("ai,bj,kij->abk", change, change, kept)
    rows: list[Any] = []
    for i in range(degree, -1, -1):
        rows.extend(powers[i, j] for j in range(lengths[degree - i] - 1, -1, -1))
    out = np.zeros((len(rows), STRIDE))
    out[:, :LANES] = rows
    return out.reshape(-1)


def certify(data: FloatArray, law: Law, points: int = 8000, seed: int | None = None) -> float:
    """Prove the table on random points and the domain's corners; writes the result to its header.

    A third of the points are dense over the domain; the others crowd, by orders of magnitude, at
    d → 0, at d → a, at θ → 0 and at θ's limit, and at two of these at once. Returns the largest
    relative error.
    """
    radius = float(data[RADIUS])
    d, theta = hard_points(radius, points, np.random.default_rng(seed))
    out = np.empty(d.size)
    _errors(data, law.gauss, law.circle, law.parts, d, theta, out)
    worst = int(np.argmax(np.where(np.isnan(out), np.inf, out)))
    error = float(out[worst])
    if math.isnan(error):
        raise TableError(f"the table gives no number at d = {d[worst]!r}, θ = {theta[worst]!r}")
    data[[MAX_ERROR, WORST_D, WORST_THETA]] = error, d[worst], theta[worst]
    return error


def hard_points(
    radius: float, points: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random d [m] and θ [rad] over the domain, crowded at its edges and corners."""
    which = rng.integers(0, 9, points)
    small = 10.0 ** rng.uniform(-9.0, -0.3, points)
    even = rng.uniform(0.0, 1.0, points)
    d = np.where(which < 3, small, np.where(which < 5, 1.0 - small, even)) * radius
    d = np.maximum(d, 1e-9 * radius)
    limit = theta_limits(radius, d)
    near = 10.0 ** rng.uniform(-12.0, 0.0, points)
    kind = np.where(which % 3 == 0, rng.uniform(0.0, 1.0, points), 1.0 - near)
    kind = np.where(rng.integers(0, 8, points) == 0, near, kind)
    kind = np.where(rng.integers(0, 30, points) == 0, 1.0, kind)
    theta = np.minimum(limit * kind, limit) * rng.choice([-1.0, 1.0], points)
    return d, theta
