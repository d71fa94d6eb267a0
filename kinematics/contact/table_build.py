"""How contact tables are fitted to the reference integrals, chosen by cost, and checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from softfinger.kinematics.compiled.simd import LANES, SHAPES, SIZES, STRIDE
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import (
    CHEAPEST_FIRST,
    CLOSED,
    CORNER_PIECES,
    CORNER_SHAPE,
    FORMS,
    LOWEST,
    OCTAVES,
    START,
    VERSION,
    Form,
    TableError,
    aligned,
    header_of,
    lookup,
)
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import (
    circle_rule,
    gauss_rule,
    integrate,
    nodes_for,
    ratios_at,
)

FloatArray = NDArray[np.float64]

MEMORY_LIMIT = 256 * 1024  # bytes of a table
_HOPE = 3.0  # times the tolerance: a fit's estimate above it is not worth checking
_POINTS = 5000  # that a table is checked at
_SEED = 1  # of these points, so that a table built anew is the same
_CORNER_DEEPEST = 34  # octaves of h that the corner's fit is sampled over


@dataclass(frozen=True)
class Law:
    """A material as the quadrature's kernels take it."""

    material: Material
    gauss: FloatArray
    circle: FloatArray
    parts: FloatArray
    modulus: float

    @classmethod
    def of(cls, material: Material) -> Law:
        """Rules and expansions for ``material``."""
        return cls(
            material,
            gauss_rule(nodes_for(material.degree)),
            circle_rule(material.degree),
            material.expansions(),
            material.reference_modulus,
        )


def build(tip: Fingertip, material: Material, tolerance: float, form: str | None) -> FloatArray:
    """The array of the cheapest table within ``tolerance``; see ContactTable.build."""
    if not (0.0 < tolerance < 1.0):
        raise TableError(f"the tolerance must lie between 0 and 1, not {tolerance!r}")
    names = [known.name for known in FORMS]
    if form is not None and form not in names:
        raise TableError(f"no form is called {form!r}; there are {', '.join(names)}")
    law = Law.of(material)
    best = math.inf
    for number in CHEAPEST_FIRST if form is None else [names.index(form)]:
        if number == CLOSED and not material.is_linear:
            continue
        data = _header(tip, law, number, tolerance)
        if data.nbytes > MEMORY_LIMIT:
            continue
        estimate = _fit(data, law, number, tolerance) if number != CLOSED else 0.0
        if estimate <= _HOPE * tolerance:
            estimate = largest_error(data, law)
            if estimate <= tolerance:
                return data
        best = min(best, estimate)
    raise TableError(
        f"no table within {MEMORY_LIMIT // 1024} KiB reaches {tolerance:.3g} for this material; "
        f"the best reached {best:.4g}"
    )


def _header(tip: Fingertip, law: Law, number: int, tolerance: float) -> FloatArray:
    """The array with its header filled in, coefficients zero."""
    pieces = _h_pieces(FORMS[number]) * FORMS[number].y_pieces
    corner = START + pieces * SIZES[number]
    corner_size = 2 * CORNER_PIECES * SIZES[CORNER_SHAPE] if number != CLOSED else 0
    data = aligned(corner + corner_size)
    header = header_of(data)
    header.format, header.form, header.tolerance, header.corner = VERSION, number, tolerance, corner
    header.radius, header.modulus = tip.radius, law.modulus
    header.inverse_radius = 1.0 / tip.radius
    return data


def _h_pieces(form: Form) -> int:
    return OCTAVES << form.bits


def _h_piece(form: Form, i: int) -> tuple[float, float]:
    octave, part = divmod(i, 1 << form.bits)
    base = 0.5 ** (OCTAVES - octave)
    width = base / (1 << form.bits)
    return base + part * width, base + (part + 1) * width


def _fit(data: FloatArray, law: Law, number: int, tolerance: float) -> float:
    """Fill in a form's coefficients; returns the largest relative error to be expected.

    That is the largest sum of the discarded Chebyshev coefficients, over the ratio. Gives up as
    soon as it is too large for the tolerance.
    """
    form, columns = FORMS[number], SHAPES[number]
    # Two more than needed in each direction, to estimate what is left out.
    x, in_x = _nodes(columns[0] + 2)
    y, in_y = _nodes(len(columns) + 2)
    kept = np.zeros((x.size, y.size), dtype=np.bool_)
    for j, count in enumerate(columns):
        kept[:count, j] = True
    at = START
    estimate = 0.0
    for i in range(_h_pieces(form)):
        low, high = _h_piece(form, i)
        h = 0.5 * (low + high) + 0.5 * (high - low) * x
        for j in range(form.y_pieces):
            places = (j + 0.5 * (y + 1.0)) / form.y_pieces
            values = _ratios_at(law, h[:, None], places[None, :])
            terms = np.einsum("ai,bj,kij->kab", in_x, in_y, values, optimize=True)
            size = np.abs(values)
            size[3] = np.maximum(size[3], size[0])
            lost = (np.abs(terms) * ~kept).sum(axis=(1, 2)) / size.min(axis=(1, 2))
            estimate = max(estimate, float(lost.max()))
            if estimate > _HOPE * tolerance:
                return estimate
            numbers = _powers(terms * kept, columns)
            data[at : at + numbers.size] = numbers
            at += numbers.size
    for j in range(CORNER_PIECES):
        numbers, misfit = _corner(law, j)
        estimate = max(estimate, misfit)
        data[at : at + numbers.size] = numbers
        at += numbers.size
    return estimate


@cache
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev nodes on [−1, 1] and the matrix from values there to Chebyshev coefficients."""
    nodes: FloatArray = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    return nodes, np.asarray(inverse, dtype=np.float64)


def _powers(terms: FloatArray, columns: tuple[int, ...]) -> FloatArray:
    """Chebyshev coefficients [5, x, y] as the numbers that `compiled.simd` evaluates."""
    rising = np.einsum(
        "ai,bj,kij->kab",
        _to_powers(terms.shape[1]),
        _to_powers(terms.shape[2]),
        terms,
        optimize=True,
    )
    out = np.zeros((sum(columns), STRIDE))
    at = 0
    for j, count in enumerate(columns):
        out[at : at + count, :LANES] = rising[:, count - 1 :: -1, j].T
        at += count
    return out.reshape(-1)


def _ratios_at(law: Law, h: FloatArray, y: FloatArray) -> FloatArray:
    """Ratios [5, …] at the table's broadcast coordinates h in (0, 1) and y in [0, 1]."""
    h, y = np.broadcast_arrays(h, y)
    delta = 1.0 - h
    # 1 − u² with u = h y, written so that nothing cancels when h and y near 1.
    rest = (1.0 - y + delta * y) * (1.0 + h * y)
    c = np.sqrt(delta * (1.0 + h) / rest)
    s = h * np.sqrt((1.0 - y) * (1.0 + y) / rest)
    out = np.empty((LANES, h.size))
    ratios_at(law.gauss, law.circle, law.parts, delta.ravel(), h.ravel(), s.ravel(), c.ravel(), out)
    return out.reshape(LANES, *h.shape)


def _corner(law: Law, piece: int) -> tuple[FloatArray, float]:
    """One piece over y of the corner: its numbers, and the largest relative misfit at its nodes.

    A and B of R = A + B log h are found by least squares in h at each node of y. Only their sum is
    well determined; since it is found linearly, it is interpolated in y as R itself would be.
    """
    shape = SHAPES[CORNER_SHAPE]
    rows, columns = shape[0], len(shape)
    nodes, in_y = _nodes(columns)
    y = (piece + 0.5 * (nodes + 1.0)) / CORNER_PIECES
    near, _ = _nodes(2 * rows)
    h = np.concatenate(
        [0.5 * LOWEST * (near + 1.0), LOWEST * 0.5 ** np.arange(1, _CORNER_DEEPEST, 1.0)]
    )
    values = np.moveaxis(_ratios_at(law, h[:, None], y[None, :]), 0, 1).reshape(h.size, -1)
    basis = chebyshev.chebvander(2.0 * h / LOWEST - 1.0, rows - 1)
    matrix = np.concatenate([basis, basis * np.log(h)[:, None]], axis=1)
    found = np.linalg.lstsq(matrix, values, rcond=1e-14)[0]
    size = np.abs(values).reshape(h.size, LANES, columns)
    size[:, 3] = np.maximum(size[:, 3], size[:, 0])
    misfit = float(np.max(np.abs(matrix @ found - values) / size.reshape(h.size, -1)))
    terms = found.reshape(2, rows, LANES, columns)
    # From values at the nodes of y to coefficients.
    terms = np.einsum("bj,pikj->pkib", in_y, terms, optimize=True)
    return np.concatenate([_powers(part, shape) for part in terms]), misfit


@cache
def _to_powers(count: int) -> FloatArray:
    """Matrix from ``count`` Chebyshev coefficients to those of rising powers."""
    columns = [chebyshev.cheb2poly(row) for row in np.eye(count)]
    return np.stack([np.pad(column, (0, count - len(column))) for column in columns], axis=1)


def largest_error(data: FloatArray, law: Law) -> float:
    """Largest relative error at random points, the same for each table; written to its header.

    A third of the points are dense over the domain; the others crowd, by orders of magnitude, at
    d → 0, at d → a, at θ → 0 and at θ's limit, and at two of these at once. Between the points the
    table may err a little more.
    """
    header = header_of(data)
    radius = header.radius
    d, theta = hard_points(radius, _POINTS, np.random.default_rng(_SEED))
    out = _errors(data, law, d, theta)
    worst = int(np.argmax(np.where(np.isnan(out), np.inf, out)))
    error = float(out[worst])
    if math.isnan(error):
        raise TableError(f"the table gives no number at d = {d[worst]!r}, θ = {theta[worst]!r}")
    header.max_error, header.worst_d, header.worst_theta = error, d[worst], theta[worst]
    return error


def _errors(data: FloatArray, law: Law, d: FloatArray, theta: FloatArray) -> FloatArray:
    """Largest relative error [n] of the table's six outputs, each against the integral.

    ∂F/∂θ may pass through zero where a law softens; it counts relative to F tan θ if that is more.
    """
    found = np.array([lookup(data, *at)[:6] for at in zip(d.tolist(), theta.tolist(), strict=True)])
    exact = np.stack(integrate(Fingertip(header_of(data).radius), law.material, d, theta))
    scale = np.abs(exact)
    scale[3] = np.maximum(scale[3], np.abs(exact[0] * np.tan(theta)))
    lost = np.abs(found.T - exact)
    # Both vanish with θ.
    lost[[3, 5]] = np.where(theta == 0.0, 0.0, lost[[3, 5]])
    scale[[3, 5]] = np.where(theta == 0.0, 1.0, scale[[3, 5]])
    worst: FloatArray = np.max(lost / scale, axis=0)
    return worst


def hard_points(
    radius: float, points: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random d [m] and θ [rad] over the domain, crowded at its edges and corners."""
    which = rng.integers(0, 9, points)
    small = 10.0 ** rng.uniform(-9.0, -0.3, points)
    even = rng.uniform(0.0, 1.0, points)
    d = np.where(which < 3, small, np.where(which < 5, 1.0 - small, even)) * radius
    d = np.maximum(d, 1e-9 * radius)
    limit = Fingertip(radius).theta_limit(d)
    near = 10.0 ** rng.uniform(-12.0, 0.0, points)
    kind = np.where(which % 3 == 0, rng.uniform(0.0, 1.0, points), 1.0 - near)
    kind = np.where(rng.integers(0, 8, points) == 0, near, kind)
    kind = np.where(rng.integers(0, 30, points) == 0, 1.0, kind)
    theta = np.minimum(limit * kind, limit) * rng.choice([-1.0, 1.0], points)
    return np.asarray(d), np.asarray(theta)
