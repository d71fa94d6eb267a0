"""Force and energy as a user of SciPy would get them: integrated, or interpolated from a table.

The tables cover d ≤ 8 mm and |θ| ≤ 30°. ``raw`` ones hold F and U over (d, θ). ``ratio`` ones hold
their ratio to the closed form over (d, θ²): the form that our own tables take, which costs the
closed form besides and keeps the relative error small near d = 0.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip, closed_forms
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate

FloatArray = NDArray[np.float64]

DEEPEST = 0.008  # [m]
STEEPEST = math.radians(30.0)


@dataclass(frozen=True)
class Method:
    """One of SciPy's ways. ``call(d, θ)`` takes numbers, or arrays where ``batch`` says so."""

    name: str
    outputs: int  # 2: F, U; 6: with their partials, in the order of `closed_forms`
    call: Callable[[Any, Any], Any]
    batch: bool = True
    nbytes: int | None = None
    build_s: float | None = None


def methods(tip: Fingertip, material: Material, quick: bool) -> Iterator[Method]:
    """All of them; ``quick``: one size of each. Needs SciPy."""
    yield Method("dblquad", 2, _double_quadrature(tip, material), batch=False)
    for raw, degree, size in ((True, 3, 64), (True, 3, 256), (False, 3, 64), (False, 5, 64)):
        if quick and (raw or degree == 5):
            continue
        nodes = _nodes(tip, material, size, raw)
        kind = f"{'raw' if raw else 'ratio'} {size}², degree {degree}"
        before = time.perf_counter()
        spline = _Splines(nodes, degree, raw, material.reference_modulus)
        spent = time.perf_counter() - before
        name = f"RectBivariateSpline.ev, {kind}"
        for outputs, call in ((2, spline.values), (6, spline.partials)):
            yield Method(name, outputs, call, True, spline.nbytes, spent)
    for form, size in (("linear", 64), ("linear", 256), ("cubic", 64)):
        if quick and size != 64:
            continue
        nodes = _nodes(tip, material, size, raw=False)
        before = time.perf_counter()
        grid = _Grid(nodes, form, material.reference_modulus)
        spent = time.perf_counter() - before
        name = f"RegularGridInterpolator, ratio {size}², {form}"
        yield Method(name, 2, grid.values, True, nodes.nbytes, spent)
    for order, size in ((1, 64), (1, 256), (3, 64), (5, 64)):
        if quick and size != 64:
            continue
        nodes = _nodes(tip, material, size, raw=False)
        before = time.perf_counter()
        image = _Image(nodes, order, material.reference_modulus)
        spent = time.perf_counter() - before
        name = f"map_coordinates, ratio {size}², order {order}"
        yield Method(name, 2, image.values, True, nodes.nbytes, spent)


@dataclass(frozen=True)
class _Nodes:
    """Samples [d, θ or θ²] of F and U, or of their ratios."""

    d: FloatArray
    angle: FloatArray
    force: FloatArray
    energy: FloatArray

    @property
    def nbytes(self) -> int:
        return int(self.force.nbytes + self.energy.nbytes)


def _nodes(tip: Fingertip, material: Material, size: int, raw: bool) -> _Nodes:
    if raw:
        d = np.linspace(0.0, DEEPEST, size)
        angle = np.linspace(-STEEPEST, STEEPEST, size)
        values = integrate(tip, material, d[:, None], angle)
        return _Nodes(d, angle, values.force, values.energy)
    d = np.linspace(1e-9, DEEPEST, size)
    angle = np.linspace(0.0, STEEPEST**2, size)
    theta = np.sqrt(angle)
    values = integrate(tip, material, d[:, None], theta)
    over = closed_forms(material.reference_modulus, d[:, None], theta)
    return _Nodes(d, angle, values.force / over.force, values.energy / over.energy)


def _closed(modulus: float, d: Any, theta: Any) -> tuple[Any, Any]:
    """F and U of the closed form, for numbers or arrays, at the cost that each takes."""
    cosine = math.cos(theta) if isinstance(theta, float) else np.cos(theta)
    force = math.pi * modulus * d * d / cosine
    return force, force * d / (3.0 * cosine)


def _double_quadrature(tip: Fingertip, material: Material) -> Callable[[float, float], Any]:
    """The double integrals over the footprint, each by `dblquad` at its default tolerances."""
    from scipy.integrate import dblquad

    stress = [float(value) for value in reversed(material.coefficients)]
    work = [value / (j + 1) for value, j in zip(stress, range(len(stress), 0, -1), strict=True)]

    def call(d: float, theta: float) -> tuple[float, float]:
        a, s, c = tip.radius, math.sin(theta), math.cos(theta)
        h = a - d
        rho = math.sqrt(d * (a + h))

        def strain(z: float, x: float) -> float:
            return 1.0 - (h - x * s) / (c * z)

        def pressure(y: float, x: float) -> float:
            e = strain(math.sqrt(a * a - x * x - y * y), x)
            value = 0.0
            for each in stress:
                value = value * e + each
            return value * e

        def density(y: float, x: float) -> float:
            z = math.sqrt(a * a - x * x - y * y)
            e = strain(z, x)
            value = 0.0
            for each in work:
                value = value * e + each
            return z * value * e * e

        def width(x: float) -> float:
            return math.sqrt(max(rho * rho - ((x - h * s) / c) ** 2, 0.0))

        limits = (h * s - rho * c, h * s + rho * c, lambda x: -width(x), width)
        return dblquad(pressure, *limits)[0], dblquad(density, *limits)[0]

    return call


class _Splines:
    """`RectBivariateSpline`: one of F and one of U."""

    def __init__(self, nodes: _Nodes, degree: int, raw: bool, modulus: float) -> None:
        from scipy.interpolate import RectBivariateSpline

        self._raw = raw
        self._modulus = modulus
        self._force = RectBivariateSpline(nodes.d, nodes.angle, nodes.force, kx=degree, ky=degree)
        self._energy = RectBivariateSpline(nodes.d, nodes.angle, nodes.energy, kx=degree, ky=degree)
        self.nbytes = sum(part.nbytes for each in (self._force, self._energy) for part in each.tck)

    def values(self, d: Any, theta: Any) -> tuple[Any, Any]:
        if self._raw:
            return self._force.ev(d, theta), self._energy.ev(d, theta)
        force, energy = _closed(self._modulus, d, theta)
        square = theta * theta
        return force * self._force.ev(d, square), energy * self._energy.ev(d, square)

    def partials(self, d: Any, theta: Any) -> tuple[Any, ...]:
        cosine = np.cos(theta)
        if self._raw:
            force = self._force.ev(d, theta)
            return (
                force,
                self._energy.ev(d, theta),
                self._force.ev(d, theta, dx=1),
                self._force.ev(d, theta, dy=1),
                force / cosine,
                self._energy.ev(d, theta, dy=1),
            )
        over_f, over_u = _closed(self._modulus, d, theta)
        square, slope = theta * theta, np.tan(theta)
        ratio_f, ratio_u = self._force.ev(d, square), self._energy.ev(d, square)
        force = over_f * ratio_f
        return (
            force,
            over_u * ratio_u,
            over_f * (2.0 / d * ratio_f + self._force.ev(d, square, dx=1)),
            over_f * (slope * ratio_f + 2.0 * theta * self._force.ev(d, square, dy=1)),
            force / cosine,
            over_u * 2.0 * (slope * ratio_u + theta * self._energy.ev(d, square, dy=1)),
        )


class _Grid:
    """`RegularGridInterpolator` with both ratios in one call.

    The cubic one is solved directly: its default, an iterative solver, leaves an error of 7e-5.
    """

    def __init__(self, nodes: _Nodes, form: str, modulus: float) -> None:
        from scipy.interpolate import RegularGridInterpolator
        from scipy.sparse.linalg import spsolve

        self._modulus = modulus
        both = np.stack([nodes.force, nodes.energy], axis=-1)
        more = {"solver": spsolve} if form == "cubic" else {}
        self._both = RegularGridInterpolator(
            (nodes.d, nodes.angle), both, method=form, bounds_error=False, fill_value=None, **more
        )

    def values(self, d: Any, theta: Any) -> tuple[Any, Any]:
        force, energy = _closed(self._modulus, d, theta)
        ratio = self._both((d, theta * theta))
        return force * ratio[..., 0], energy * ratio[..., 1]


class _Image:
    """`map_coordinates` on each ratio, prefiltered once.

    It knows no edge that suits the ratios: mirrored ones limit what a higher order gains.
    """

    def __init__(self, nodes: _Nodes, order: int, modulus: float) -> None:
        from scipy.ndimage import spline_filter

        self._modulus = modulus
        self._order = order
        self._first = nodes.d[0]
        self._per_d = (nodes.d.size - 1) / (nodes.d[-1] - nodes.d[0])
        self._per_angle = (nodes.angle.size - 1) / nodes.angle[-1]
        self._tables = [
            spline_filter(each, order, mode="mirror") if order > 1 else each
            for each in (nodes.force, nodes.energy)
        ]

    def values(self, d: Any, theta: Any) -> tuple[Any, Any]:
        from scipy.ndimage import map_coordinates

        force, energy = _closed(self._modulus, d, theta)
        at = np.array([(d - self._first) * self._per_d, theta * theta * self._per_angle])
        at = at.reshape(2, -1)
        ratio_f, ratio_u = (
            map_coordinates(each, at, order=self._order, mode="mirror", prefilter=False)
            for each in self._tables
        )
        return force * ratio_f, energy * ratio_u
