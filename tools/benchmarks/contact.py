"""The contact table's run time against its error, beside the closed form and SciPy's splines.

All times are of one run in turns, in ns a point. Errors and times are over the same points: d up to
8 mm, |θ| up to 30°, half of the d spread evenly and half by orders of magnitude down to 1 µm.
Errors are the largest relative ones, against the integrals with many nodes; the closed form, which
is exact for a constant modulus, counts as a double's rounding. Ours give force, energy and their
four partials, SciPy's force and energy alone, interpolated as ratios to the closed form in (d, θ²).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.contact.closed_form import Fingertip, closed_form, closed_forms
from softfinger.kinematics.contact.lookup import lookup_at
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks.measuring import Report, Subject, each, figure, interleave

FloatArray = NDArray[np.float64]

TIP = Fingertip(radius=0.020)
MODULUS = 0.304e6  # Pa
LAW = Material.table_i()
DEEPEST, STEEPEST = 0.008, math.radians(30.0)  # m, rad
ERROR = "relative error"
_AIM = 800.0  # ns a call of a table from Python
_NODES = 64  # a side, of SciPy's tables
_SINGLE = 16  # points that calls with floats go round


def measure(brief: bool = False, rounds: int = 25, count: int = 512) -> list[Report]:
    """Return times by compiled code and from Python, with errors; ``count``: a power of two."""
    d, theta = points(count)
    expected = np.stack(integrate(TIP, LAW, d, theta, 40))
    tables = {f"table to {each:g}": ContactTable.build(TIP, LAW, each) for each in (1e-9, 1e-12)}
    calls: dict[str, Callable[..., Any]] = {**tables, **_scipy()}
    errors = {name: _error(call(d, theta), expected) for name, call in calls.items()}
    closed = "closed form, constant E"
    compiled = {
        name: Subject(partial(loop, table, d, theta), count)
        for name, table in {closed: None, **tables}.items()
    }
    single = list(zip(d[:_SINGLE].tolist(), theta[:_SINGLE].tolist(), strict=True))
    python = {f"{name}, called": each(call, single) for name, call in calls.items()}
    times = interleave(compiled | python, 10 if brief else rounds)
    errors[closed] = float(np.finfo(float).eps)
    return [
        Report(
            "lookup in compiled code",
            [figure(name, "ns", times[name], **{ERROR: errors[name]}) for name in compiled],
            ERROR,
        ),
        Report(
            "lookup from Python",
            [
                figure(
                    name,
                    "ns",
                    times[f"{name}, called"],
                    _AIM if name in tables else None,
                    **{ERROR: errors[name]},
                )
                for name in calls
            ],
            ERROR,
        ),
    ]


def points(count: int) -> tuple[FloatArray, FloatArray]:
    """Return the points d [m] and θ [rad] of all times and errors, the same in every run."""
    rng = np.random.default_rng(3)
    even = rng.uniform(0.0, DEEPEST, count)
    spread = 10.0 ** rng.uniform(-6.0, np.log10(DEEPEST), count)
    d = np.where(np.arange(count) % 2 == 0, even, spread)
    return d, rng.uniform(-STEEPEST, STEEPEST, count)


def _error(got: Any, expected: FloatArray) -> float:
    """The largest of as many outputs as there are."""
    pairs = zip(got, expected, strict=False)
    return max(float(np.max(np.abs((value - true) / true))) for value, true in pairs)


def _scipy() -> dict[str, Callable[..., Any]]:
    """Force and energy as a user of SciPy would get them, by degree."""
    try:
        from scipy.interpolate import RectBivariateSpline
    except ImportError:
        print(
            "bench contact: SciPy's rows are left out, since it is not installed; it is in the "
            "extra 'dev': pip install '.[dev]'",
            file=sys.stderr,
        )
        return {}
    at, squares = np.linspace(1e-9, DEEPEST, _NODES), np.linspace(0.0, STEEPEST**2, _NODES)
    values = integrate(TIP, LAW, at[:, None], np.sqrt(squares))
    over = closed_forms(LAW.reference_modulus, at[:, None], np.sqrt(squares))
    ratios = values.force / over.force, values.energy / over.energy

    def splines(degree: int) -> Callable[..., Any]:
        f, u = (RectBivariateSpline(at, squares, each, kx=degree, ky=degree) for each in ratios)

        def call(d: Any, theta: Any) -> tuple[Any, Any]:
            cosine = math.cos(theta) if isinstance(theta, float) else np.cos(theta)
            force = math.pi * LAW.reference_modulus * d * d / cosine
            square = theta * theta
            return force * f.ev(d, square), force * d / (3.0 * cosine) * u.ev(d, square)

        return call

    return {f"RectBivariateSpline: degree {degree}": splines(degree) for degree in (3, 5)}


# Loops that call the contact kernels one by one, as the control loop does. The order of the n
# points, a power of two, jumps about, or the compiler would merge calls into vector instructions.
# The outputs in ``out`` [n, 6] keep it from dropping a call.


def loop(table: ContactTable | None, d: FloatArray, theta: FloatArray, repeat: int) -> FloatArray:
    """Look up all points ``repeat`` times by compiled code, by the closed form without a table."""
    out = np.empty((d.size, 6))
    if table is None:
        closed_loop(repeat, MODULUS, d, theta, out)
    else:
        lookup_loop(repeat, table.data, d, theta, out)
    return out


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
