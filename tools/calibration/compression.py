"""Run `calibrate law --compression`: fit a tip's material law to a testing machine's CSV files.

A file contains strain and stress, or displacement and force. A file with displacement and force
also requires the tilt, given in a column or with ``--theta``.
"""

from __future__ import annotations

import csv
import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.own_files import read_file
from softfinger.daemon.perception.calibration_file import Calibration, ModulusStep, now
from softfinger.daemon.perception.prior import CALIBRATED_ERROR
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.compression_fit import (
    CompressionFit,
    Run,
    compare_laws,
    loading,
    rising,
)
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.material_fit import MaterialError
from softfinger.tools.calibration.calibration_plot import Panel, Points

FloatArray = NDArray[np.float64]


class _Quantity(NamedTuple):
    """Column names that a file may use for a quantity, and the SI factor of each unit."""

    words: set[str]
    units: dict[str, float]


class _Test(NamedTuple):
    """Test run, and the name by which messages refer to it."""

    name: str
    run: Run


_QUANTITIES = {
    "strain": _Quantity({"strain", "ε", "epsilon"}, {"%": 0.01, "1": 1.0, "-": 1.0}),
    "stress": _Quantity(
        {"stress", "σ", "sigma"}, {"MPa": 1e6, "kPa": 1e3, "Pa": 1.0, "N/mm²": 1e6, "N/mm2": 1e6}
    ),
    "force": _Quantity(
        {"force", "f", "load"},
        {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216},
    ),
    "tilt": _Quantity(
        {"tilt", "theta", "θ", "angle"},
        {"deg": math.pi / 180.0, "°": math.pi / 180.0, "rad": 1.0},
    ),
    "displacement": _Quantity(
        {"displacement", "d", "depth", "compression", "indentation", "extension", "travel"},
        {"mm": 1e-3, "µm": 1e-6, "um": 1e-6, "m": 1.0, "cm": 1e-2, "in": 25.4e-3},
    ),
}
_EXAMPLE = "`d [mm],F [N],tilt [deg]` or `strain [%],stress [kPa]`"
_NAMED = re.compile(r"^(.*?)\s*(?:[\[(]\s*(.*?)\s*[\])]|[/_]\s*([^\s/_]+))?$")
_SAME_TILT = 2e-4  # maximum tilt difference within a run [rad]
_POINTS = 10  # number of points that represent a fitted law
_BINS = 20  # maximum number of points in a measured stress-strain law
_TOE = 2.0  # slope ratio that indicates a toe region or an offset
# A difference of this size in the information criterion is strong evidence (Kass & Raftery, 1995).
_BETTER = 6.0


def read_csv(path: Path) -> dict[str, FloatArray]:
    """Read the columns that have known names, and convert the values to SI units.

    The separator is a tab, a semicolon or a comma; files with decimal commas must use a tab or a
    semicolon. The unit of a column follows the column name, or is in a separate row below the
    header. Other columns, empty lines and lines that begin with # are ignored. A cell must not
    contain a line break. Raises OSError, or CalibrationError with the line or column.
    """
    try:
        text = read_file(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: not UTF-8 text; expected a CSV file") from None
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1)
             if line.strip(" \t;,") and not line.startswith("#")]  # fmt: skip
    if not lines:
        raise CalibrationError(f"{path}: the file is empty, expected {_EXAMPLE}")
    separator = next((each for each in "\t;" if each in lines[0][1]), ",")
    rows = (csv.reader([line], delimiter=separator, skipinitialspace=True) for _, line in lines)
    try:
        header, *cells = ([cell.strip() for cell in next(row)] for row in rows)
    except csv.Error as error:
        raise CalibrationError(f"{path}: {error}: check the quotation marks") from None
    below = cells[0] if cells and not any(map(_is_number, cells[0])) else []
    columns = _columns(path, header, below)
    found: dict[str, list[float]] = {name: [] for name in columns}
    for (number, _), row in zip(lines[1 + bool(below) :], cells[bool(below) :], strict=True):
        for name, (column, unit) in columns.items():
            cell = row[column] if column < len(row) else ""
            if not _is_number(cell):
                raise CalibrationError(
                    f"{path}: line {number}: {name}: found {cell!r}, expected a number"
                )
            found[name].append(float(cell.replace(",", ".")) * unit)
    return {name: np.array(values) for name, values in found.items()}


def _columns(path: Path, header: list[str], below: list[str]) -> dict[str, tuple[int, float]]:
    """Return the column index and the unit of each quantity."""
    found: dict[str, tuple[int, float]] = {}
    for k, title in enumerate(header):
        match = _NAMED.match(title)
        assert match is not None
        words = set(re.findall(r"[^\W\d_]+", match[1].lower()))
        name = next((each for each, known in _QUANTITIES.items() if words & known.words), "")
        if not name:
            continue
        if name in found:
            raise CalibrationError(
                f"{path}: found the columns {header[found[name][0]]!r} and {title!r}, expected one "
                f"column with {name}"
            )
        unit = match[2] or match[3] or (below[k].strip("[]()") if k < len(below) else "")
        unit, units = unit.replace("μ", "µ"), _QUANTITIES[name].units
        if unit not in units:
            raise CalibrationError(
                f"{path}: {title!r}: found {f'the unit {unit!r}' if unit else 'no unit'}, expected "
                f"one of {', '.join(units)}, as in {_EXAMPLE}"
            )
        found[name] = k, units[unit]
    if not ({"displacement", "force"} <= set(found) or {"strain", "stress"} <= set(found)):
        raise CalibrationError(
            f"{path}: found the columns {', '.join(map(repr, header))}, expected {_EXAMPLE}"
        )
    return found


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell.replace(",", ".")))
    except ValueError:
        return False


def fit_files(
    calibration: Calibration, settings: Settings, paths: list[Path], theta: list[float]
) -> tuple[Calibration, str, tuple[Panel, ...]]:
    """Fit the material law to a testing machine's files, for the tip model of `tip.physics`.

    ``theta`` contains the tilt of each file [deg], or is empty. Returns the new calibration, the
    summary lines and the panels of the plot. Raises CalibrationError or OSError.
    """
    if settings.tip.physics == "measured":
        raise CalibrationError(
            'law: found tip.physics = "measured", expected "springs" or "solid"; measured curves '
            "require frames"
        )
    if theta and len(theta) != len(paths):
        raise CalibrationError(
            f"--theta: found {len(theta)} values for {len(paths)} files, expected one value for "
            "each file"
        )
    files = [read_csv(path) for path in paths]
    if any({"strain", "stress"} <= file.keys() for file in files):
        if len(files) > 1 or settings.tip.physics != "springs":
            raise CalibrationError(
                'law: strain and stress require a single file and tip.physics = "springs"'
            )
        return _stress_strain(calibration, paths[0], files[0])
    tilts = np.radians(theta or np.zeros(len(files))).tolist()
    tests = [test for each in zip(paths, files, tilts, strict=True) for test in _tests(*each)]
    return _force_law(calibration, settings, tests)


def _tests(path: Path, file: dict[str, FloatArray], theta: float) -> list[_Test]:
    """Split a file into runs, one for each tilt."""
    tilt = file.get("tilt", np.full(len(file["force"]), theta))
    edges = np.flatnonzero(np.abs(np.diff(tilt)) > _SAME_TILT) + 1
    tests = []
    for rows in np.split(np.arange(len(tilt)), edges):
        if not len(rows):
            raise CalibrationError(
                f"{path}: the file does not contain any rows of numbers below the header"
            )
        name = f"{path.name} at {math.degrees(tilt[rows[0]]):.3g}°"
        try:
            run = loading(file["displacement"][rows], file["force"][rows], float(tilt[rows[0]]))
        except CalibrationError as error:
            raise CalibrationError(f"law: {name}: {error}") from None
        tests.append(_Test(name, run))
    return tests


def _force_law(
    calibration: Calibration, settings: Settings, tests: list[_Test]
) -> tuple[Calibration, str, tuple[Panel, ...]]:
    tip, runs = settings.tip, [test.run for test in tests]
    fits, notes = compare_laws(runs, tip.radius, tip.poisson, make_material(settings.material))
    ours = [fit for fit in fits if fit.tip.physics == tip.physics]
    if not ours:
        raise CalibrationError(f"law: {'; '.join(notes)}")
    best, deepest = ours[0], max(run.depth for run in runs)
    force = max(float(np.ptp(run.force)) for run in runs)
    # Residuals that exceed the noise are attributed to the material law.
    misfit = best.residual * math.sqrt(max(1.0 - 1.0 / best.chi2, 0.0)) / force
    count = 0 if _is_constant(best) else _POINTS
    strain = np.linspace(0.0, deepest / tip.radius, count + 1)[1:]
    step = ModulusStep(
        date=now(),
        modulus=best.modulus,
        strain=np.round(strain, 5).tolist(),
        stress=np.round(best.stress(strain), 2).tolist(),
        offset=float(best.zeros[0, 0]),
        residual=math.hypot(best.std, misfit),
    )
    wants = tip_settings(best.tip)
    lines = [
        _fit_line(best, deepest),
        *(_fit_line(fit, deepest) for fit in fits if fit is not best),
    ]
    lines += notes
    if fits[0].score < best.score - _BETTER:
        lines.append(
            f"{_name(fits[0])} fits better, but F alone does not identify a model: compare the "
            "models using sensor frames (`calibrate law --d`), then set tip.physics"
        )
    lines += [_run_line(test, zeros) for test, zeros in zip(tests, best.zeros, strict=True)]
    lines.append(f"for the profile: {_profile_line(wants, step)}")
    return _with_law(calibration, step, wants), "\n  ".join(lines), _panels(best, tests)


def _with_law(calibration: Calibration, step: ModulusStep, wants: dict[str, Any]) -> Calibration:
    changed = {"modulus": step, "wants": wants, "scales": None, "date": now()}
    return calibration.model_copy(update=changed)


def _is_constant(fit: CompressionFit) -> bool:
    return len(fit.factors) == 1 and fit.law.is_linear


def tip_name(tip: Fingertip, law: Material) -> str:
    """Return the name of a tip model in the summary lines."""
    if tip.physics == "solid":
        return f"solid, {tip.base}, {tip.face}, ν {tip.poisson:.3f}"
    return "springs" if law.is_linear else f"springs, law {law.name}"


def tip_settings(tip: Fingertip) -> dict[str, str | float]:
    """Return the ``[tip]`` settings of a tip model."""
    if tip.physics != "solid":
        return {"physics": tip.physics}
    poisson = round(tip.poisson, 3)
    return {"physics": "solid", "base": tip.base, "face": tip.face, "poisson": poisson}


def _name(fit: CompressionFit) -> str:
    if fit.tip.physics == "springs" and fit.law.is_linear:
        return "springs, constant E" if _is_constant(fit) else "springs, E(d)"
    return tip_name(fit.tip, fit.law)


def _fit_line(fit: CompressionFit, deepest: float) -> str:
    if len(fit.factors) > 1:
        mean = float(fit.stress(deepest / fit.tip.radius)) * fit.tip.radius / deepest
        told = (
            f"E = {fit.modulus / 1e6:.4f} MPa at d = 0, {mean / 1e6:.4f} MPa on average up to "
            f"{deepest * 1e3:.1f} mm"
        )
    else:
        told = f"E = {fit.modulus / 1e6:.4f} ± {fit.std * fit.modulus / 1e6:.4f} MPa"
        told += "" if _is_constant(fit) else " at d = 0"
    return (
        f"{_name(fit)}: {told}; standard deviation of F {fit.std:.2%}, residuals "
        f"{fit.residual:.2g} N, χ² {fit.chi2:.2f}"
    )


def _run_line(test: _Test, zeros: FloatArray) -> str:
    run = test.run
    before, pressed = np.count_nonzero(run.before), np.count_nonzero(run.pressed)
    told = (
        f"{test.name}: zero offset of d {zeros[0] * 1e3:.3f} ± {zeros[2] * 1e3:.3f} mm, of F "
        f"{zeros[1]:.3f} ± {zeros[3]:.3f} N; fitted {pressed} rows up to d = "
        f"{(run.d.max() - zeros[0]) * 1e3:.2f} mm and {before} rows before contact; excluded "
        f"{len(run.d) - before - pressed} toe-region rows"
    )
    if run.dropped:
        told += f" and {run.dropped} rows of the unloading"
        told += f" and of {run.cycles - 1} earlier cycles" * (run.cycles > 1)
    return told + "; the zero offset of F was not measured: start the run above the tip" * (
        not before
    )


def _profile_line(wants: dict[str, Any], step: ModulusStep) -> str:
    values = {f"tip.{name}": value for name, value in wants.items()}
    law: dict[str, Any] = {"law": "constant", "modulus": round(step.modulus, -1)}
    if step.strain:
        law = {"law": "points", "strain": step.strain, "stress": step.stress}
    law["modulus_error"] = round(max(step.residual, CALIBRATED_ERROR), 3)
    values |= {f"material.{name}": value for name, value in law.items()}
    return ", ".join(f"{name} = {json.dumps(value)}" for name, value in values.items())


def _panels(fit: CompressionFit, tests: list[_Test]) -> tuple[Panel, ...]:
    d, force, model = [], [], []
    for test, zeros in zip(tests, fit.zeros, strict=True):
        used = test.run.before | test.run.pressed
        d.append((test.run.d - zeros[0])[used] * 1e3)
        force.append((test.run.force - zeros[1])[used])
        model.append((fit.force(test.run, zeros) - zeros[1])[used])
    x, y, fitted = map(np.concatenate, (d, force, model))
    shown = Points(_name(fit), "d [mm]", "F [N]", x, y, fitted)
    return shown, Points("residuals", "d [mm]", "measured − fit [N]", x, y - fitted)


def _stress_strain(
    calibration: Calibration, path: Path, file: dict[str, FloatArray]
) -> tuple[Calibration, str, tuple[Panel, ...]]:
    """Use the points of a stress-strain curve as the material law."""
    strain, stress = file["strain"], file["stress"]
    try:
        rows, _ = rising(strain)
        x, y = _thinned(strain[rows], stress[rows])
        _check_beginning(x, y)
        material = Material.from_points(x, y)
    except (CalibrationError, MaterialError) as error:
        raise CalibrationError(f"law: {path.name}: {error}") from None
    step = ModulusStep(
        date=now(),
        modulus=material.reference_modulus,
        strain=np.round(x, 5).tolist(),
        stress=np.round(y, 2).tolist(),
        offset=0.0,
        residual=material.worst_force_error,
    )
    wants: dict[str, Any] = {"physics": "springs"}
    line = (
        f"springs, law of {len(x)} points to a strain of {x[-1]:.2f}: E = "
        f"{material.reference_modulus / 1e6:.4f} MPa at zero strain; force "
        f"error up to {material.worst_force_error:.2%}; "
        f"{len(strain) - (rows.stop - rows.start)} unloading rows were excluded\n"
        f"  for the profile: {_profile_line(wants, step)}"
    )
    shown = Points("law", "strain", "stress [kPa]", x, y * 1e-3, material.stress(x) * 1e-3)
    return _with_law(calibration, step, wants), line, (shown,)


def _thinned(strain: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average the points in each strain range, if there are at least 2 × `_BINS` points."""
    if len(strain) < 2 * _BINS:
        return strain, stress
    counts, _ = np.histogram(strain, _BINS)
    used = counts > 0
    x, y = (
        np.histogram(strain, _BINS, weights=each)[0][used] / counts[used]
        for each in (strain, stress)
    )
    return x, y


def _check_beginning(strain: FloatArray, stress: FloatArray) -> None:
    """Raise CalibrationError if the curve has a toe region or does not start at zero."""
    part = (strain > 0.15 * strain[-1]) & (strain < 0.5 * strain[-1])
    first = np.flatnonzero(strain > 0.02 * strain[-1])
    if np.count_nonzero(part) < 2 or not first.size:
        return
    slope, start = np.polyfit(strain[part], stress[part], 1)
    secant = stress[first[0]] / strain[first[0]]
    if secant < slope / _TOE or secant > slope * _TOE:
        raise CalibrationError(
            f"found a modulus of {secant / 1e3:.3g} kPa below a strain of {strain[first[0]]:.3g}, "
            f"but {slope / 1e3:.3g} kPa above this strain, which indicates a toe region or a zero "
            f"offset; expected a curve through the origin: subtract {-start / slope:.3g} from the "
            "strain, and remove the points with negative strain"
        )
