"""The contact model's run time against its error: every representation, beside SciPy's ways.

All times are of one run in turns, over the same points: d up to 8 mm, |θ| up to 30°, half of the d
spread evenly and half by orders of magnitude down to 1 µm. Errors are the largest relative ones of
the row's outputs over these points, against the integrals with many nodes; a table's certificate
covers its whole domain.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import (
    Fingertip,
    closed_form,
    closed_forms,
)
from softfinger.kinematics.contact.lookup import CLOSED, FORMS, TableError, lookup
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks import contact_kernels, contact_scipy
from softfinger.tools.benchmarks.contact_report import MODES, ContactRow, Timing, aligned_table
from softfinger.tools.benchmarks.interleaved import Subject, interleave
from softfinger.tools.benchmarks.report import Row, row

FloatArray = NDArray[np.float64]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # [Pa]
TIGHT, TIGHTER = 1e-9, 1e-12  # the two tolerances that have aims
_MEMORY = 256.0  # KiB
_REFERENCE_NODES = 40
_SINGLE = 16  # points that single calls from Python go round
_FEW = 8  # points where calls take milliseconds
_TILES = 8  # a batch is this many times the points

Reference = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Effort:
    """How much is measured; the default is the full bench."""

    rounds: int = 25
    points: int = 512  # a power of two
    quick: bool = False  # one size of each of SciPy's methods, two of the tables


@dataclass
class _Case:
    """One row to be: its subjects by mode, and what gives its outputs for the error."""

    name: str
    material: str
    outputs: int
    error: float
    subjects: dict[str, Subject] = field(default_factory=dict)
    nbytes: int | None = None
    build_s: float | None = None
    certificate: float | None = None

    def key(self, mode: str) -> str:
        """The subject's name in the run."""
        return f"{self.material}/{self.name}/{self.outputs}/{mode}"


def measure(effort: Effort | None = None) -> list[ContactRow | Row]:
    """Rows of every representation, then the ratios and times that have an aim."""
    effort = effort or Effort()
    d, theta = points(effort.points)
    constant, law = Material.constant(MODULUS), Material.table_i()
    tight = ContactTable.build(TIP, law, TIGHT)
    tighter = ContactTable.build(TIP, law, TIGHTER)
    cases = [
        *_closed_cases(constant, d, theta),
        *_table_cases(ContactTable.build(TIP, constant), constant, d, theta),
        *_closed_cases(law, d, theta),
    ]
    for form in FORMS[CLOSED + 1 :]:
        if effort.quick and form not in (tight.form, tighter.form):
            continue
        before = time.perf_counter()
        try:
            table = ContactTable.build(TIP, law, 0.5, form=form.name)
        except TableError:
            continue
        cases += _table_cases(table, law, d, theta, time.perf_counter() - before)
    for tolerance, table in ((TIGHT, tight), (TIGHTER, tighter)):
        cases.append(_domain_case(table, tolerance, effort.points))
    for nodes in (18,) if effort.quick else (6, 10, 14, 18):
        cases.append(_quadrature_case(law, nodes, d, theta))
    cases += _scipy_cases(law, d, theta, effort.quick)
    times = interleave({c.key(m): s for c in cases for m, s in c.subjects.items()}, effort.rounds)
    bases = {c.outputs: c for c in cases if c.name == "closed form" and c.material == "constant"}
    rows: list[ContactRow | Row] = [_row(case, bases[case.outputs], times) for case in cases]
    builds = _builds(law, 1 if effort.quick else 5)
    return rows + _aims(cases, bases, times, tight, tighter) + builds


def table(rows: list[ContactRow]) -> str:
    """The representations as an aligned table."""
    return aligned_table(rows)


def plot(rows: list[ContactRow], path: Path) -> None:
    """Run time against error, as a picture. Raises NoMatplotlib without the extra ``plot``."""
    from softfinger.tools.benchmarks.contact_plot import draw

    draw(rows, path)


def points(count: int) -> tuple[FloatArray, FloatArray]:
    """The points d [m] and θ [rad] of all times and errors, the same in every run."""
    rng = np.random.default_rng(3)
    even = rng.uniform(0.0, contact_scipy.DEEPEST, count)
    spread = 10.0 ** rng.uniform(-6.0, np.log10(contact_scipy.DEEPEST), count)
    d = np.where(np.arange(count) % 2 == 0, even, spread)
    return d, rng.uniform(-contact_scipy.STEEPEST, contact_scipy.STEEPEST, count)


def reference(material: Material, d: FloatArray, theta: FloatArray) -> FloatArray:
    """The six outputs [6, n]: for a constant modulus the formulas in long double."""
    if material.is_linear:
        depth, tilt = d.astype(np.longdouble), theta.astype(np.longdouble)
        cosine, slope = np.cos(tilt), np.tan(tilt)
        # π to 19 digits; NumPy has it in double precision only.
        pi = np.longdouble(np.pi) + np.longdouble(1.2246467991473532e-16)
        force = pi * np.longdouble(material.reference_modulus) * depth * depth / cosine
        energy = force * depth / (3 * cosine)
        six = (force, energy, 2 * force / depth, force * slope, force / cosine, 2 * energy * slope)
        return np.stack(six)
    return np.stack(integrate(TIP, material, d, theta, _REFERENCE_NODES))


def _error(got: Any, expected: FloatArray, outputs: int) -> float:
    """The largest relative error of the first ``outputs`` rows."""
    worst = 0.0
    for value, true in zip(got[:outputs], expected[:outputs], strict=True):
        worst = max(worst, float(np.max(np.abs((value - true) / true))))
    return worst


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


def _compiled(kernel: Callable[..., object], *arguments: Any) -> Subject:
    """A compiled loop; the last of its arguments is θ."""
    count = arguments[-1].size
    out = np.empty((count, 6))
    return Subject(lambda repeat: kernel(repeat, *arguments, out), count)


def _closed_cases(material: Material, d: FloatArray, theta: FloatArray) -> Iterator[_Case]:
    """The closed form; for a law that is not linear only its error is of interest."""
    modulus = material.reference_modulus
    got, expected = closed_forms(modulus, d, theta), reference(material, d, theta)
    for outputs, word in ((2, "two"), (6, "six")):
        name = "closed form" if material.is_linear else "closed form at its first modulus"
        case = _Case(name, material.name, outputs, _error(got, expected, outputs))
        loop = getattr(contact_kernels, f"closed_loop_{word}")
        chain = getattr(contact_kernels, f"closed_chain_{word}")
        case.subjects["loop"] = _compiled(loop, modulus, d, theta)
        case.subjects["chain"] = _compiled(chain, modulus, d, theta)
        if material.is_linear:
            case.subjects["kernel"] = _single(partial(closed_form, modulus), d, theta)
            case.subjects["python"] = _single(partial(closed_forms, modulus), d, theta)
            case.subjects["batch"] = _batch(partial(closed_forms, modulus), d, theta)
        yield case


def _table_cases(
    table: ContactTable,
    material: Material,
    d: FloatArray,
    theta: FloatArray,
    build_s: float | None = None,
) -> Iterator[_Case]:
    got, expected = table(d, theta), reference(material, d, theta)
    for outputs, word in ((2, "two"), (6, "six")):
        case = _Case(
            f"table, {table.form.name}",
            material.name,
            outputs,
            _error(got, expected, outputs),
            nbytes=table.data.nbytes,
            build_s=build_s,
            certificate=table.max_error,
        )
        loop = getattr(contact_kernels, f"lookup_loop_{word}")
        chain = getattr(contact_kernels, f"lookup_chain_{word}")
        case.subjects["loop"] = _compiled(loop, table.data, d, theta)
        case.subjects["chain"] = _compiled(chain, table.data, d, theta)
        case.subjects["kernel"] = _single(partial(lookup, table.data), d, theta)
        case.subjects["python"] = _single(table, d, theta)
        case.subjects["batch"] = _batch(table, d, theta)
        yield case


def _domain_case(table: ContactTable, tolerance: float, count: int) -> _Case:
    """The same lookup over the whole domain, d up to a: more of the table, and its slow corner."""
    rng = np.random.default_rng(4)
    d = rng.uniform(0.0, TIP.radius, count)
    theta = rng.uniform(-1.0, 1.0, count) * TIP.theta_limit(d)
    error = _error(table(d, theta), reference(Material.table_i(), d, theta), 6)
    case = _Case(
        f"table to {tolerance:g}, points over its whole domain",
        "table_i",
        6,
        error,
        nbytes=table.data.nbytes,
        certificate=table.max_error,
    )
    case.subjects["loop"] = _compiled(contact_kernels.lookup_loop_six, table.data, d, theta)
    case.subjects["chain"] = _compiled(contact_kernels.lookup_chain_six, table.data, d, theta)
    return case


def _quadrature_case(material: Material, nodes: int, d: FloatArray, theta: FloatArray) -> _Case:
    quadrature = partial(integrate, TIP, material, nodes=nodes)
    error = _error(quadrature(d, theta), reference(material, d, theta), 6)
    case = _Case(f"direct quadrature, {nodes} nodes a piece", material.name, 6, error)
    case.subjects["python"] = _single(quadrature, d, theta)
    case.subjects["batch"] = _batch(quadrature, d, theta)
    return case


def _scipy_cases(
    material: Material, d: FloatArray, theta: FloatArray, quick: bool
) -> Iterator[_Case]:
    try:
        import scipy  # noqa: F401
    except ImportError:
        print(
            "bench contact: SciPy's rows are left out, since it is not installed; it is in the "
            "extra 'dev': pip install '.[dev]'",
            file=sys.stderr,
        )
        return
    expected = reference(material, d, theta)
    for method in contact_scipy.methods(TIP, material, quick):
        case = _Case(method.name, material.name, method.outputs, 0.0)
        case.nbytes, case.build_s = method.nbytes, method.build_s
        if method.batch:
            case.error = _error(method.call(d, theta), expected, method.outputs)
            case.subjects["python"] = _single(method.call, d, theta)
            case.subjects["batch"] = _batch(method.call, d, theta)
        else:  # so slow that a few points have to do for the error, and one for the time
            got = np.array([method.call(float(d[i]), float(theta[i])) for i in range(_FEW)]).T
            case.error = _error(got, expected[:, :_FEW], method.outputs)
            case.subjects["python"] = _single(method.call, d[:1], theta[:1])
        yield case


def _row(case: _Case, base: _Case, times: dict[str, FloatArray]) -> ContactRow:
    timings = {}
    for mode in MODES:
        if mode in case.subjects:
            taken = times[case.key(mode)]
            ratio = float(np.median(taken / times[base.key(mode)]))
            timings[mode] = Timing(float(taken.min()), float(np.median(taken)), ratio)
    return ContactRow(
        case.name,
        case.material,
        case.outputs,
        case.error,
        case.certificate,
        case.nbytes,
        case.build_s,
        timings,
    )


def _aims(
    cases: list[_Case],
    bases: dict[int, _Case],
    times: dict[str, FloatArray],
    tight: ContactTable,
    tighter: ContactTable,
) -> list[Row]:
    """Ratios of the same rounds, and errors, beside what they are meant to be."""

    def over(case: _Case, mode: str, base: _Case, base_mode: str) -> FloatArray:
        return times[case.key(mode)] / times[base.key(base_mode)]

    by_name = {(case.name, case.material, case.outputs): case for case in cases}
    rows = []
    compared = (
        ("constant E: table", "constant", "closed", 1.2),
        (f"Table I, {TIGHT:g}: table", "table_i", tight.form.name, 2.0),
        (f"Table I, {TIGHTER:g}: table", "table_i", tighter.form.name, 3.0),
    )
    for name, material, form, aim in compared:
        case = by_name[f"table, {form}", material, 6]
        for mode in ("loop", "chain"):
            samples = over(case, mode, bases[6], mode)
            rows.append(row(f"{name} / closed form, {MODES[mode]}", "×", samples, aim))
    closed = by_name["table, closed", "constant", 6]
    rows.append(row("constant E: largest error of the table", "1", [closed.error], 4e-15))
    for tolerance, table in ((TIGHT, tight), (TIGHTER, tighter)):
        name = f"Table I, {tolerance:g}"
        rows.append(row(f"{name}: certified error", "1", [table.max_error], tolerance))
        rows.append(row(f"{name}: memory", "KiB", [table.data.nbytes / 1024], _MEMORY))
    tables = [c for c in cases if c.name.startswith("table, ") and c.outputs == 2]
    tables = [c for c in tables if c.material == "table_i"]
    splines = [c for c in cases if c.name.startswith("RectBivariateSpline") and c.outputs == 2]
    rivals = [(min(splines, key=lambda case: case.error), 0.01)] if splines else []
    rivals += [(case, 1e-5) for case in cases if case.name == "dblquad"]
    for rival, aim in rivals:
        # The fastest of ours that errs no more.
        good = [c for c in tables if c.error <= rival.error] or tables
        mine = min(good, key=lambda case: float(np.median(times[case.key("loop")])))
        name = rival.name.partition(",")[0]
        words = f"{mine.name} ({mine.error:.0e}) / {name} ({rival.error:.0e})"
        rows.append(row(words, "×", over(mine, "loop", rival, "python"), aim))
        rows.append(row("  the same, ours chained", "×", over(mine, "chain", rival, "python")))
        from_python = over(mine, "kernel", rival, "python")
        rows.append(row("  the same, both called from Python", "×", from_python))
    return rows


def _builds(material: Material, repeats: int) -> list[Row]:
    """Seconds to build a table, its kernels compiled."""
    taken: dict[float, list[float]] = {TIGHT: [], TIGHTER: []}
    for _ in range(repeats):
        for tolerance, samples in taken.items():
            before = time.perf_counter()
            ContactTable.build(TIP, material, tolerance)
            samples.append(time.perf_counter() - before)
    aims = {TIGHT: 0.3, TIGHTER: 2.0}
    return [
        row(f"Table I, {tolerance:g}: build", "s", samples, aims[tolerance])
        for tolerance, samples in taken.items()
    ]
