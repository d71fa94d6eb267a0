"""Force and energy as a user of SciPy would get them: integrated, or interpolated from a table.

The tables cover d ≤ 8 mm and |θ| ≤ 30° and hold F and U over the closed form in (d, θ²): the form
that our own tables take, which costs the closed form besides and keeps the relative error small
near d = 0.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softfinger.kinematics.contact.closed_form import Fingertip, closed_forms
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate

DEEPEST = 0.008  # [m]
STEEPEST = math.radians(30.0)
_SIZE = 64  # nodes a side
Call = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Method:
    """One of SciPy's ways. ``call(d, θ)`` takes numbers, or arrays where ``batch`` says so.

    It gives F and U, or all six outputs in the order of `closed_forms`.
    """

    name: str
    call: Call
    batch: bool = True
    nbytes: float = math.nan
    build_s: float = math.nan


def methods(tip: Fingertip, material: Material) -> Iterator[Method]:
    """All of them. Needs SciPy."""
    yield Method("dblquad, F and U", _double_quadrature(tip, material), batch=False)
    for degree in (3, 5):
        before = time.perf_counter()
        values, partials, nbytes = _splines(tip, material, degree)
        spent = time.perf_counter() - before
        name = f"RectBivariateSpline.ev: {_SIZE}², degree {degree}"
        yield Method(f"{name}, F and U", values, True, nbytes, spent)
        yield Method(name, partials, True, nbytes, spent)
    before = time.perf_counter()
    values, nbytes = _grid(tip, material)
    spent = time.perf_counter() - before
    yield Method(f"RegularGridInterpolator: {_SIZE}², linear, F and U", values, True, nbytes, spent)


def _nodes(tip: Fingertip, material: Material) -> tuple[Any, Any, Any, Any]:
    """d, θ², and the ratios of F and of U [d, θ²] there."""
    d, square = np.linspace(1e-9, DEEPEST, _SIZE), np.linspace(0.0, STEEPEST**2, _SIZE)
    values = integrate(tip, material, d[:, None], np.sqrt(square))
    over = closed_forms(material.reference_modulus, d[:, None], np.sqrt(square))
    return d, square, values.force / over.force, values.energy / over.energy


def _closed(modulus: float, d: Any, theta: Any) -> tuple[Any, Any]:
    """F and U of the closed form, for numbers or arrays, at the cost that each takes."""
    cosine = math.cos(theta) if isinstance(theta, float) else np.cos(theta)
    force = math.pi * modulus * d * d / cosine
    return force, force * d / (3.0 * cosine)


def _double_quadrature(tip: Fingertip, material: Material) -> Call:
    """The double integrals over the footprint, each by `dblquad` at its default tolerances."""
    from scipy.integrate import dblquad

    stress = [float(value) for value in reversed(material.coefficients)]
    work = [value / (j + 1) for value, j in zip(stress, range(len(stress), 0, -1), strict=True)]

    def polynomial(coefficients: list[float], e: float) -> float:
        value = 0.0
        for each in coefficients:
            value = value * e + each
        return value * e

    def call(d: float, theta: float) -> tuple[float, float]:
        a, s, c = tip.radius, math.sin(theta), math.cos(theta)
        h = a - d
        rho = math.sqrt(d * (a + h))

        def pressure(y: float, x: float) -> float:
            return polynomial(stress, 1.0 - (h - x * s) / (c * math.sqrt(a * a - x * x - y * y)))

        def density(y: float, x: float) -> float:
            z = math.sqrt(a * a - x * x - y * y)
            e = 1.0 - (h - x * s) / (c * z)
            return z * polynomial(work, e) * e

        def width(x: float) -> float:
            return math.sqrt(max(rho * rho - ((x - h * s) / c) ** 2, 0.0))

        limits = (h * s - rho * c, h * s + rho * c, lambda x: -width(x), width)
        return dblquad(pressure, *limits)[0], dblquad(density, *limits)[0]

    return call


def _splines(tip: Fingertip, material: Material, degree: int) -> tuple[Call, Call, float]:
    """`RectBivariateSpline`, one of F and one of U: values, partials, bytes."""
    from scipy.interpolate import RectBivariateSpline

    d_nodes, squares, *values = _nodes(tip, material)
    f, u = (RectBivariateSpline(d_nodes, squares, each, kx=degree, ky=degree) for each in values)
    nbytes = sum(part.nbytes for each in (f, u) for part in each.tck)
    modulus = material.reference_modulus

    def two(d: Any, theta: Any) -> tuple[Any, ...]:
        force, energy = _closed(modulus, d, theta)
        square = theta * theta
        return force * f.ev(d, square), energy * u.ev(d, square)

    def six(d: Any, theta: Any) -> tuple[Any, ...]:
        over_f, over_u = _closed(modulus, d, theta)
        square, slope = theta * theta, np.tan(theta)
        ratio_f, ratio_u = f.ev(d, square), u.ev(d, square)
        force = over_f * ratio_f
        return (
            force,
            over_u * ratio_u,
            over_f * (2.0 / d * ratio_f + f.ev(d, square, dx=1)),
            over_f * (slope * ratio_f + 2.0 * theta * f.ev(d, square, dy=1)),
            force / np.cos(theta),
            over_u * 2.0 * (slope * ratio_u + theta * u.ev(d, square, dy=1)),
        )

    return two, six, nbytes


def _grid(tip: Fingertip, material: Material) -> tuple[Call, float]:
    """`RegularGridInterpolator` with both ratios in one call, and its bytes."""
    from scipy.interpolate import RegularGridInterpolator

    d_nodes, squares, *values = _nodes(tip, material)
    both = np.stack(values, axis=-1)
    interpolator = RegularGridInterpolator(
        (d_nodes, squares), both, bounds_error=False, fill_value=None
    )
    modulus = material.reference_modulus

    def call(d: Any, theta: Any) -> tuple[Any, Any]:
        force, energy = _closed(modulus, d, theta)
        ratio = interpolator((d, theta * theta))
        return force * ratio[..., 0], energy * ratio[..., 1]

    return call, both.nbytes
