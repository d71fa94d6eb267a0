"""The contact model's run time against its error: every representation, beside SciPy's ways.

All times are of one run in turns, over the same points: d up to 8 mm, |θ| up to 30°, half of the d
spread evenly and half by orders of magnitude down to 1 µm. Errors are the largest relative ones
over these points, against the integrals with many nodes. Outputs are force, energy and their four
partials, unless the row says F and U.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.contact.closed_form import (
    Fingertip,
    closed_form,
    closed_forms,
)
from softfinger.kinematics.contact.lookup import CLOSED, FORMS, TableError, lookup, lookup_at
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks import contact_scipy
from softfinger.tools.benchmarks.framework.interleaved import Subject, interleave
from softfinger.tools.benchmarks.framework.report import Report, Row, figure

FloatArray = NDArray[np.float64]
Built = dict[float, tuple[ContactTable, list[float]]]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # [Pa]
CONSTANT, LAW = Material.constant(MODULUS), Material.table_i()
ERROR = "largest relative error"
# How a representation is called: calls that overlap; calls of which each waits for the last; with
# floats; with arrays. Times are ns a call or, in a batch, a point.
MODES = {
    "loop": "contact, compiled loop",
    "chain": "contact, compiled chain",
    "kernel": "contact, kernel from Python",
    "python": "contact, Python API",
    "batch": "contact, Python API, batch",
}
_CLOSED = "closed form, constant E"
PAGE = {
    MODES["loop"]: (_CLOSED, "table to"),
    MODES["python"]: ("table to", "dblquad", "RectBivariateSpline.ev: 64², degree 5"),
}
# Tolerances with the aims for six outputs over the closed form, and for the build [s].
_TOLERANCES = {1e-9: (2.0, 0.3), 1e-12: (3.0, 2.0)}
_SINGLE = 16  # points that single calls from Python go round
_FEW = 8  # points where calls take milliseconds
_TILES = 8  # a batch is this many times the points


@dataclass
class _Way:
    """A representation: its subjects by mode, and its error."""

    name: str
    error: float
    subjects: dict[str, Subject] = field(default_factory=dict)
    facts: Row = field(default_factory=dict)


def measure(brief: bool = False, rounds: int = 25, count: int = 512) -> list[Report]:
    """One table a way of calling, then what has an aim. ``count`` of points: a power of two."""
    d, theta = points(count)
    built = {tolerance: _built(tolerance, 1 if brief else 5) for tolerance in _TOLERANCES}
    cases = list(_cases(brief, built, d, theta))
    subjects = {
        f"{mode} {case.name}": subject for case in cases for mode, subject in case.subjects.items()
    }
    times = interleave(subjects, 10 if brief else rounds)
    tables = [
        Report(title, [_row(case, mode, times) for case in cases if mode in case.subjects], ERROR)
        for mode, title in MODES.items()
    ]
    return [*tables, Report("contact, what has an aim", list(_aims(built, times)))]


def _built(tolerance: float, repeats: int) -> tuple[ContactTable, list[float]]:
    """Table I's table, and the seconds that it takes to build."""
    samples = []
    for _ in range(repeats):
        before = time.perf_counter()
        table = ContactTable.build(TIP, LAW, tolerance)
        samples.append(time.perf_counter() - before)
    return table, samples


def points(count: int) -> tuple[FloatArray, FloatArray]:
    """The points d [m] and θ [rad] of all times and errors, the same in every run."""
    rng = np.random.default_rng(3)
    even = rng.uniform(0.0, contact_scipy.DEEPEST, count)
    spread = 10.0 ** rng.uniform(-6.0, np.log10(contact_scipy.DEEPEST), count)
    d = np.where(np.arange(count) % 2 == 0, even, spread)
    return d, rng.uniform(-contact_scipy.STEEPEST, contact_scipy.STEEPEST, count)


def reference(material: Material, d: FloatArray, theta: FloatArray) -> FloatArray:
    """The six outputs [6, n]: for a constant modulus the formulas in long double."""
    if not material.is_linear:
        return np.stack(integrate(TIP, material, d, theta, 40))
    depth, tilt = d.astype(np.longdouble), theta.astype(np.longdouble)
    cosine, slope = np.cos(tilt), np.tan(tilt)
    # π to 19 digits; NumPy has it in double precision only.
    pi = np.longdouble(np.pi) + np.longdouble(1.2246467991473532e-16)
    force = pi * np.longdouble(material.reference_modulus) * depth * depth / cosine
    energy = force * depth / (3 * cosine)
    six = (force, energy, 2 * force / depth, force * slope, force / cosine, 2 * energy * slope)
    return np.stack(six)


def _error(got: Any, expected: FloatArray) -> float:
    """Of as many outputs as there are."""
    pairs = zip(got, expected, strict=False)
    return max(float(np.max(np.abs((value - true) / true))) for value, true in pairs)


def _cases(brief: bool, built: Built, d: FloatArray, theta: FloatArray) -> Iterator[_Way]:
    error = _error(closed_forms(MODULUS, d, theta), reference(CONSTANT, d, theta))
    calls = partial(closed_form, MODULUS), partial(closed_forms, MODULUS)
    yield _compiled(_Way(_CLOSED, error), CLOSED_KERNELS, MODULUS, calls, d, theta)
    yield _table("table, constant E", ContactTable.build(TIP, CONSTANT), CONSTANT, d, theta)
    for tolerance, (table, _) in built.items():
        yield _table(f"table to {tolerance:g}", table, LAW, d, theta)
        # The whole domain, d up to a: more of the table, and its slow corner.
        rng = np.random.default_rng(4)
        deep = rng.uniform(0.0, TIP.radius, d.size)
        tilt = rng.uniform(-1.0, 1.0, d.size) * TIP.theta_limit(deep)
        case = _table(f"table to {tolerance:g}: whole domain", table, LAW, deep, tilt)
        case.subjects = {"loop": case.subjects["loop"]}
        yield case
    for form in () if brief else FORMS[CLOSED + 1 :]:
        before = time.perf_counter()
        try:
            table = ContactTable.build(TIP, LAW, 0.5, form=form.name)
        except TableError:
            continue
        spent = 1e3 * (time.perf_counter() - before)
        case = _table(f"table {form.name}", table, LAW, d, theta)
        case.facts["build ms"] = spent
        yield case
    expected = reference(LAW, d, theta)
    for nodes in (18,) if brief else (6, 10, 14, 18):
        call = partial(integrate, TIP, LAW, nodes=nodes)
        error = _error(call(d, theta), expected)
        modes = {"python": _single(call, d, theta), "batch": _batch(call, d, theta)}
        yield _Way(f"quadrature: {nodes} nodes a piece", error, modes)
    yield from _scipy(d, theta, expected)


def _compiled(
    case: _Way,
    kernels: dict[str, Callable[..., None]],
    argument: Any,
    calls: tuple[Callable[..., object], Callable[..., object]],
    d: FloatArray,
    theta: FloatArray,
) -> _Way:
    """With the subjects of a compiled representation: ``calls`` as kernel and as Python API."""
    out = np.empty((d.size, 6))
    for mode in ("loop", "chain"):
        run = partial(_run, kernels[mode], argument, d, theta, out)
        case.subjects[mode] = Subject(run, d.size)
    case.subjects["kernel"] = _single(calls[0], d, theta)
    case.subjects["python"] = _single(calls[1], d, theta)
    case.subjects["batch"] = _batch(calls[1], d, theta)
    return case


def _run(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call it with the last argument, the repeats, first."""
    *others, repeat = arguments
    kernel(repeat, *others)


def _table(
    name: str, table: ContactTable, material: Material, d: FloatArray, theta: FloatArray
) -> _Way:
    facts = {"error bound": table.max_error, "KiB": table.data.nbytes / 1024}
    case = _Way(name, _error(table(d, theta), reference(material, d, theta)), facts=facts)
    return _compiled(
        case, LOOKUP_KERNELS, table.data, (partial(lookup, table.data), table), d, theta
    )


def _scipy(d: FloatArray, theta: FloatArray, expected: FloatArray) -> Iterator[_Way]:
    try:
        import scipy  # noqa: F401
    except ImportError:
        print(
            "bench contact: SciPy's rows are left out, since it is not installed; it is in the "
            "extra 'dev': pip install '.[dev]'",
            file=sys.stderr,
        )
        return
    for method in contact_scipy.methods(TIP, LAW):
        facts: Row = {}
        if method.batch:
            facts = {"KiB": method.nbytes / 1024, "build ms": 1e3 * method.build_s}
            error = _error(method.call(d, theta), expected)
            modes = {"python": _single(method.call, d, theta)}
            modes["batch"] = _batch(method.call, d, theta)
        else:  # so slow that a few points have to do for the error, and one for the time
            got = np.array([method.call(float(d[i]), float(theta[i])) for i in range(_FEW)]).T
            error = _error(got, expected[:, :_FEW])
            modes = {"python": _single(method.call, d[:1], theta[:1])}
        yield _Way(method.name, error, modes, facts)


def _single(call: Callable[..., object], d: FloatArray, theta: FloatArray) -> Subject:
    """Calls from Python with plain floats."""
    pairs = list(zip(d[:_SINGLE].tolist(), theta[:_SINGLE].tolist(), strict=True))

    def run(repeat: int) -> None:
        for _ in range(repeat):
            for depth, tilt in pairs:
                call(depth, tilt)

    return Subject(run, len(pairs))


def _batch(call: Callable[..., object], d: FloatArray, theta: FloatArray) -> Subject:
    """Calls with several times all points at once, counted by the point."""
    depth, tilt = np.tile(d, _TILES), np.tile(theta, _TILES)

    def run(repeat: int) -> None:
        for _ in range(repeat):
            call(depth, tilt)

    return Subject(run, depth.size)


def _row(case: _Way, mode: str, times: dict[str, FloatArray]) -> Row:
    taken, base = times[f"{mode} {case.name}"], times[f"{mode} {_CLOSED}"]
    row = figure(case.name, "ns", taken)
    del row["aim ≤"]
    return row | {"× closed form": float(np.median(taken / base)), ERROR: case.error} | case.facts


def _aims(built: Built, times: dict[str, FloatArray]) -> Iterator[Row]:
    """Ratios of the same rounds, errors found and builds, beside their aims."""
    names = {"table, constant E": 1.2}
    names |= {f"table to {tolerance:g}": aims[0] for tolerance, aims in _TOLERANCES.items()}
    for name, aim in names.items():
        for mode in ("loop", "chain"):
            ratio = times[f"{mode} {name}"] / times[f"{mode} {_CLOSED}"]
            yield figure(f"{name}: over the closed form, {mode}", "×", ratio, aim)
    for tolerance, (table, samples) in built.items():
        name = f"table to {tolerance:g}"
        yield figure(f"{name}: build", "s", samples, _TOLERANCES[tolerance][1])
        yield figure(f"{name}: bound of the error", "1", [table.max_error], tolerance)
        yield figure(f"{name}: memory", "KiB", [table.data.nbytes / 1024], 256.0)


# Loops that call the contact kernels one by one, as the control loop does. In a ``loop`` the calls
# are independent, so that the processor overlaps them; the order of the n points, a power of
# two, jumps about, or the compiler would merge calls into vector instructions. In a ``chain`` each
# call's arguments wait for the last one's result. The outputs in ``out`` [n, 6] keep the compiler
# from dropping a call.


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


CLOSED_KERNELS = {"loop": closed_loop, "chain": closed_chain}
LOOKUP_KERNELS = {"loop": lookup_loop, "chain": lookup_chain}
