"""The contact model's run time against its error: every representation, beside SciPy's ways.

All times are of one run in turns. Errors and most times are over the same points: d up to 8 mm, |θ|
up to 30°, half of the d spread evenly and half by orders of magnitude down to 1 µm; "whole domain"
is d up to the radius and θ up to its limit. Errors are the largest relative ones, against the
integrals with many nodes; the closed form, which is exact for a constant modulus, counts as a
double's rounding. Ours give force, energy and their four partials, SciPy's force and energy alone,
interpolated as ratios to the closed form in (d, θ²).

A lookup's bound is its polynomials alone: so many coefficients have to be read.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.contact.closed_form import Fingertip, closed_form, closed_forms
from softfinger.kinematics.contact.lookup import (
    LOWEST,
    from_corner,
    from_slab,
    header,
    lookup,
    lookup_at,
)
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks.measuring import (
    Report,
    Row,
    Subject,
    each,
    figure,
    interleave,
    timed,
)

FloatArray = NDArray[np.float64]
Call = Callable[[Any, Any], Any]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LAW = Material.table_i()
DEEPEST, STEEPEST = 0.008, math.radians(30.0)  # m, rad
ERROR = "relative error"
# How a representation is called: by compiled code, with floats, with arrays. Times are ns a point.
LOOP, PYTHON, BATCH = "lookup in compiled code", "lookup from Python", "lookup of arrays"
_CLOSED = "closed form, constant E"
_WHOLE = ", whole domain"
# Tolerances with the aims for six outputs over the closed form, and for the build [s].
_TOLERANCES = {1e-9: (2.0, 0.3), 1e-12: (3.0, 2.0)}
_NODES = 64  # a side, of SciPy's tables
_SINGLE = 16  # points that calls with floats go round


@dataclass
class _Way:
    """A representation: its error, and its subjects by mode."""

    name: str
    error: float
    subjects: dict[str, Subject] = field(default_factory=dict)
    facts: Row = field(default_factory=dict)
    aim: float | None = None  # of a call from Python [ns]


def measure(brief: bool = False, rounds: int = 25, count: int = 512) -> list[Report]:
    """A table for each way of calling, then what has an aim; ``count`` points, a power of two."""
    d, theta = points(count)
    expected = np.stack(integrate(TIP, LAW, d, theta, 40))
    built: dict[float, ContactTable] = {}
    builds: dict[float, list[float]] = {}
    for tolerance in _TOLERANCES:
        build = partial(ContactTable.build, TIP, LAW, tolerance)
        builds[tolerance], built[tolerance] = timed(build, 1 if brief else 5), build()
    ways = list(_ours(built, d, theta, expected))
    ways += _scipy(d, theta, expected)
    subjects = {f"{mode} {way.name}": s for way in ways for mode, s in way.subjects.items()}
    rng = np.random.default_rng(4)
    deep = rng.uniform(0.0, TIP.radius, count)
    domains = {"": (d, theta), _WHOLE: (deep, rng.uniform(-1, 1, count) * TIP.theta_limit(deep))}
    for words, at in domains.items():
        subjects[_CLOSED + words] = Subject(partial(loop, None, *at), count)
        for tolerance, table in built.items():
            subjects[f"{tolerance:g}{words}"] = Subject(partial(loop, table, *at), count)
            subjects[f"{tolerance:g}{words}, alone"] = _alone(table, *at)
    times = interleave(subjects, 10 if brief else rounds)
    page = {
        LOOP: (_CLOSED, "table to"),
        PYTHON: ("table to", "RectBivariateSpline"),
    }
    tables = []
    for mode in (LOOP, PYTHON, BATCH):
        rows = [
            figure(way.name, "ns", times[f"{mode} {way.name}"], way.aim if mode == PYTHON else None)
            | {ERROR: way.error, **way.facts}
            for way in ways
            if mode in way.subjects
        ]
        tables.append(Report(mode, rows, ERROR, page.get(mode, ())))
    aims = []
    for tolerance, (most, seconds) in _TOLERANCES.items():
        name = f"table to {tolerance:g}"
        for words in domains:
            taken = times[f"{tolerance:g}{words}"]
            over, bound = (
                taken / times[_CLOSED + words],
                taken / times[f"{tolerance:g}{words}, alone"],
            )
            aims.append(figure(f"{name}: over the closed form{words}", "×", over, most))
            aims.append(figure(f"{name}: over its polynomials alone{words}", "×", bound, 1.5))
        aims += [
            figure(f"{name}: build", "s", 1e-6 * np.array(builds[tolerance]), seconds),
            figure(f"{name}: bound of the error", "1", [built[tolerance].max_error], tolerance),
            figure(f"{name}: size", "KiB", [built[tolerance].data.nbytes / 1024], 256.0),
        ]
    return [*tables, Report("tables", aims)]


def points(count: int) -> tuple[FloatArray, FloatArray]:
    """The points d [m] and θ [rad] of all times and errors, the same in every run."""
    rng = np.random.default_rng(3)
    even = rng.uniform(0.0, DEEPEST, count)
    spread = 10.0 ** rng.uniform(-6.0, np.log10(DEEPEST), count)
    d = np.where(np.arange(count) % 2 == 0, even, spread)
    return d, rng.uniform(-STEEPEST, STEEPEST, count)


def _error(got: Any, expected: FloatArray) -> float:
    """The largest of as many outputs as there are; none is below a double's rounding."""
    pairs = zip(got, expected, strict=False)
    found = [float(np.max(np.abs((value - true) / true))) for value, true in pairs]
    return max(np.finfo(float).eps, *found)


def _ours(
    built: dict[float, ContactTable], d: FloatArray, theta: FloatArray, expected: FloatArray
) -> Iterator[_Way]:
    constant = Material.constant(MODULUS)
    exact = np.stack(integrate(TIP, constant, d, theta, 40))
    closed = partial(closed_forms, MODULUS)
    yield _way(_CLOSED, closed, d, theta, exact, partial(loop, None, d, theta))
    tables = {"table, constant E": ContactTable.build(TIP, constant)}
    tables |= {f"table to {tolerance:g}": table for tolerance, table in built.items()}
    for name, table in tables.items():
        true = exact if name == "table, constant E" else expected
        way = _way(name, table, d, theta, true, partial(loop, table, d, theta))
        way.facts |= {"error bound": table.max_error, "KiB": table.data.nbytes / 1024}
        way.aim = 800.0
        yield way
        if name == "table to 1e-09":
            pairs = [(table.data, *at) for at in zip(d.tolist(), theta.tolist(), strict=True)]
            kernel = {PYTHON: each(lookup, pairs[:_SINGLE])}
            yield _Way(f"{name}: its kernel alone", way.error, kernel)
    integrated = partial(integrate, TIP, LAW, nodes=18)
    yield _way("quadrature: 18 nodes a piece", integrated, d, theta, expected)


def _way(
    name: str,
    call: Call,
    d: FloatArray,
    theta: FloatArray,
    expected: FloatArray,
    compiled: Callable[[int], FloatArray] | None = None,
) -> _Way:
    """A representation that takes floats and arrays; ``compiled`` repeats all points."""
    way = _Way(name, _error(call(d, theta), expected))
    pairs = list(zip(d[:_SINGLE].tolist(), theta[:_SINGLE].tolist(), strict=True))
    many = (np.tile(d, 8), np.tile(theta, 8))
    if compiled is not None:
        way.subjects[LOOP] = Subject(compiled, d.size)
    way.subjects[PYTHON] = each(call, pairs)
    way.subjects[BATCH] = Subject(each(call, [many]).run, many[0].size)
    return way


def loop(table: ContactTable | None, d: FloatArray, theta: FloatArray, repeat: int) -> FloatArray:
    """``repeat`` times all points by compiled code, of the closed form without a table: [n, 6]."""
    out = np.empty((d.size, 6))
    if table is None:
        closed_loop(repeat, MODULUS, d, theta, out)
    else:
        lookup_loop(repeat, table.data, d, theta, out)
    return out


def _scipy(d: FloatArray, theta: FloatArray, expected: FloatArray) -> Iterator[_Way]:
    """Force and energy as a user of SciPy would get them."""
    try:
        from scipy.interpolate import RectBivariateSpline
    except ImportError:
        print(
            "bench contact: SciPy's rows are left out, since it is not installed; it is in the "
            "extra 'dev': pip install '.[dev]'",
            file=sys.stderr,
        )
        return
    at, squares = np.linspace(1e-9, DEEPEST, _NODES), np.linspace(0.0, STEEPEST**2, _NODES)
    values = integrate(TIP, LAW, at[:, None], np.sqrt(squares))
    over = closed_forms(LAW.reference_modulus, at[:, None], np.sqrt(squares))
    ratios = values.force / over.force, values.energy / over.energy

    for degree in (3, 5):
        f, u = (RectBivariateSpline(at, squares, each, kx=degree, ky=degree) for each in ratios)

        def call(d: Any, theta: Any, f: Any = f, u: Any = u) -> tuple[Any, Any]:
            cosine = math.cos(theta) if isinstance(theta, float) else np.cos(theta)
            force = math.pi * LAW.reference_modulus * d * d / cosine
            square = theta * theta
            return force * f.ev(d, square), force * d / (3.0 * cosine) * u.ev(d, square)

        yield _way(f"RectBivariateSpline: degree {degree}", call, d, theta, expected)


def _alone(table: ContactTable, d: FloatArray, theta: FloatArray) -> Subject:
    """The polynomials of a table at these points: what a lookup reads and multiplies at least."""
    h = 1.0 - d / TIP.radius
    cosine = np.cos(theta)
    y = np.sqrt(np.maximum(cosine**2 + h**2 - 1.0, 0.0)) / (cosine * h)
    out = np.empty((d.size, 5))
    return Subject(lambda n: polynomials_loop(n, table.data, h, np.minimum(y, 1.0), out), d.size)


# Loops that call the contact kernels one by one, as the control loop does. The order of the n
# points, a power of two, jumps about, or the compiler would merge calls into vector instructions.
# The outputs in ``out`` [n, 6] keep it from dropping a call.


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
def polynomials_loop(
    repeat: int, data: FloatArray, h: FloatArray, y: FloatArray, out: FloatArray
) -> None:
    p = address(data)
    form = int(header(p).form)
    i = 0
    for _ in range(repeat * h.shape[0]):
        i = _next(i, h.shape[0])
        if h[i] > LOWEST:
            out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = from_slab(p, form, h[i], y[i])
        else:
            out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = from_corner(p, h[i], y[i])
