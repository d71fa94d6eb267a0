"""Fit a tip's material law to displacement and force from a testing machine.

The machine presses a platen onto the tip along the platen's normal. The tip sticks to the platen,
so the measured force is ∂U/∂d. The zero offsets of d and F are unknown in each run. The toe of the
curve, where an uneven surface makes first contact, is also unknown.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.contact.closed_form import Base, Face, Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable

FloatArray = NDArray[np.float64]

_UNIT = Material.constant(1.0)
_SLACK = 0.02  # maximum reversal of d due to encoder noise, relative to the range of d
_TURNS = 5  # minimum number of rows per reversal of d; fewer rows indicate a wrong row order
_DEEP = 0.9  # minimum peak of d in a full-depth branch, as a fraction of the range of d
TOE = 0.1  # half width of the toe around the first contact, as a fraction of the depth
# Points above this fraction of the maximum force are used to extrapolate to zero force.
_STEEP = 0.2
_POWER = 0.55  # exponent p for which F^p is nearly linear in d, for springs and for solid rubber
_FEWEST = 6  # minimum number of fitted rows in contact per run
_LOADED = 20.0  # minimum force range of a run, as a multiple of the noise
# Minimum noise due to rounding and interpolation, as a fraction of the maximum force.
_SMOOTHEST = 1e-4
_ROUNDS = 60
_CLIP = 0.02  # maximum change in the zero offset of d per iteration, as a fraction of the depth
_STEP = 1e-8  # step for numerical derivatives [m]
_TOLERANCE = 1e-7  # relative tolerance of the tables
_EDGE = 1.0 - 1e-4  # usable fraction of a table's range, with a margin for the derivative step
_TOO_DEEP = "the run exceeds the depth or tilt range of the model's data"
_NO_BEGINNING = "no zero offset of d fits the run: the run must include the onset of contact"
# Coefficients (c_2, c_3) of three material laws with c_1 = 1. The force for σ = c_1 ε + c_2 ε² +
# c_3 ε³ is a linear combination of the forces for these laws.
_POWERS: tuple[tuple[Fraction, ...], ...] = ((), (Fraction(1),), (Fraction(0), Fraction(1)))


@dataclass(frozen=True)
class Run:
    """Loading branch of one compression at a fixed tilt; d and F have unknown zero offsets."""

    theta: float  # rad
    d: FloatArray  # [n] [m]
    force: FloatArray  # [n] [N]
    begin: float  # value of d at which the curve begins [m]
    cycles: int  # number of branches that reach the full depth
    dropped: int  # number of rows in other branches

    @property
    def depth(self) -> float:
        """Maximum d [m], measured from the beginning of the curve."""
        return float(self.d.max()) - self.begin

    @property
    def toe(self) -> float:
        """Half-width of the toe [m]."""
        return TOE * self.depth

    @property
    def before(self) -> NDArray[np.bool_]:
        """Mask of the rows before first contact."""
        return self.d < self.begin - self.toe

    @property
    def pressed(self) -> NDArray[np.bool_]:
        """Mask of the rows beyond the toe."""
        return self.d > self.begin + self.toe


def loading(d: ArrayLike, force: ArrayLike, theta: float = 0.0) -> Run:
    """Find the loading branch of a test, and the displacement at which the curve begins.

    Rubber softens in its first cycles (Mullins, 1948). The fit therefore uses the last cycle that
    reaches the full depth. The branch ends when d comes within 0.5 % of its maximum, so a hold is
    excluded.

    Parameters
    ----------
    d, force
        Displacement [m] and force [N] in test order, both [n].
    theta
        Tilt of the platen [rad].

    Raises
    ------
    CalibrationError
        If the rows are not in test order, contain only unloading, or do not show a load.
    """
    depth, load = np.asarray(d, np.float64), np.asarray(force, np.float64)
    used, cycles = rising(depth)
    begin = _begin(depth[used], load[used])
    dropped = depth.size - (used.stop - used.start)
    run = Run(theta, depth[used], load[used], begin, cycles, dropped)
    if (count := np.count_nonzero(run.pressed)) < _FEWEST:
        raise CalibrationError(
            f"found {count} loading rows beyond the toe region, expected at least {_FEWEST}"
        )
    if np.ptp(run.force[run.pressed]) < _LOADED * _noise([run]):
        raise CalibrationError(
            f"the force changes by {np.ptp(run.force[run.pressed]):.3g} N, expected at least "
            f"{_LOADED * _noise([run]):.2g} N ({_LOADED:g} times the force noise): check that the "
            "tip was loaded"
        )
    return run


def rising(d: FloatArray) -> tuple[slice, int]:
    """Return the rows of the last full-depth branch, and the number of full-depth branches.

    Raises CalibrationError in the same cases as `loading`.
    """
    span = float(np.ptp(d)) if d.size else 0.0
    if not span > 0.0:
        raise CalibrationError(
            "found the same displacement in all rows, expected a run with increasing displacement"
        )
    turns = _turning_points(d, _SLACK * span)
    if len(turns) - 2 > max(2, d.size // _TURNS):
        raise CalibrationError(
            f"d changes direction {len(turns) - 2} times in {d.size} rows, expected rows in "
            "measurement order: sort the rows by time"
        )
    top = d.max() - (1.0 - _DEEP) * span
    found = [(i, j) for i, j in itertools.pairwise(turns) if d[j] > d[i] and d[j] >= top]
    if not found:
        raise CalibrationError(
            "d only decreases, as it does during unloading; expected a run in which d increases"
        )
    start, peak = found[-1]
    reached = np.argmax(d[start : peak + 1] >= d[peak] - 0.25 * _SLACK * span)
    return slice(start, start + int(reached) + 1), len(found)


def _turning_points(d: FloatArray, slack: float) -> list[int]:
    """Return the indices of the first row, the last row and each ``d`` reversal above ``slack``."""
    turns, extreme, way = [0], 0, 0
    for k in range(1, d.size):
        moved = d[k] - d[extreme]
        if way == 0 and abs(moved) > slack:
            way = 1 if moved > 0.0 else -1
            extreme = k
        elif way * moved > 0.0:
            extreme = k
        elif way and abs(moved) > slack:
            turns.append(extreme)
            way, extreme = -way, k
    turns.append(extreme if way else d.size - 1)
    return turns


def _begin(d: FloatArray, force: FloatArray) -> float:
    """Extrapolate the steep part of the curve to zero force; return d at zero force.

    A line is fitted to a power of the force that is nearly linear in d.
    """
    zero = float(np.median(force[: max(1, force.size // 50)]))
    rise = force - zero
    most = float(rise.max())
    if most <= 0.0 or rise[np.argmax(d)] < 0.5 * most:
        raise CalibrationError(
            "the force does not increase with d; expected positive d and F in compression"
        )
    begin = float(d[0])
    for _ in range(4):  # Each pass improves the zero offset of F.
        steep = rise > _STEEP * most
        if (count := np.count_nonzero(steep)) < 3:
            raise CalibrationError(
                f"found {count} rows above {_STEEP:.0%} of the maximum force, expected at least "
                f"{_FEWEST}"
            )
        slope, start = np.polyfit(d[steep], rise[steep] ** _POWER, 1)
        if not slope > 0.0:
            raise CalibrationError(
                "the force decreases with d; expected positive d and F in compression"
            )
        begin = float(-start / slope)
        before = d < begin - TOE * (d.max() - begin)
        if np.count_nonzero(before) < 3:
            break
        rise = force - float(np.mean(force[before]))
        most = float(rise.max())
    return begin


@dataclass(frozen=True)
class CompressionFit:
    """Fit of one material law to runs of a testing machine.

    If k > 1, ``factors`` are the coefficients of the powers 1 to k of the strain. If k = 1, the
    single factor multiplies the shape ``law``, and ``std`` also applies to the modulus.
    """

    tip: Fingertip
    law: Material
    factors: FloatArray  # [k] [Pa]
    # Maximum relative standard deviation of the force where d exceeds a quarter of its maximum.
    std: float
    # Zero offsets of d [m] and F [N] in each run, and their standard deviations [runs, 4].
    zeros: FloatArray
    residual: float  # rms residual [N]
    chi2: float  # squared ratio of the residual to the scatter about a smooth curve
    score: float  # Bayesian information criterion; the best law has the lowest score

    @property
    def modulus(self) -> float:
        """Modulus at zero strain [Pa]."""
        return float(self.factors[0])

    def stress(self, strain: ArrayLike) -> FloatArray:
        """Return the stress [Pa] at ``strain``."""
        if len(self.factors) > 1:
            return _power_law(self.factors, strain)
        return np.asarray(self.modulus * self.law.stress(strain))

    def force(self, run: Run, zeros: FloatArray) -> FloatArray:
        """Return the modelled force [N] of a run; ``zeros`` contains the run's zero offsets."""
        tables = _tables(self.tip, self.law if len(self.factors) == 1 else None)
        theta = np.full(len(run.d), run.theta)
        return np.asarray(_shapes(tables, run.d - zeros[0], theta)[0] @ self.factors + zeros[1])


def _power_law(factors: FloatArray, strain: ArrayLike, derivative: int = 0) -> FloatArray:
    law: Any = np.polynomial.Polynomial([0.0, *factors]).deriv(derivative)
    return np.asarray(law(np.asarray(strain, np.float64)))


def fit_compression(runs: Sequence[Run], tip: Fingertip, law: Material | None) -> CompressionFit:
    """Fit a law, and the zero offsets of d and F in each run, by least squares.

    ``law`` is the shape of the stress-strain law for a modulus of 1 Pa. None selects springs with
    the law σ = c_1 ε + c_2 ε² + c_3 ε³, i.e. a strain-dependent modulus. The standard deviations
    account for correlated residuals. Raises CalibrationError if the runs are too deep for the law
    or contradict the law.
    """
    tables, deepest = _tables(tip, law), max(run.depth for run in runs)
    end = _end(tables[0], tip, max(abs(run.theta) for run in runs))
    if deepest > end:
        raise CalibrationError(_TOO_DEEP)
    used = [run.before | run.pressed for run in runs]
    pairs = [*zip(runs, used, strict=True)]
    d = np.concatenate([run.d[rows] for run, rows in pairs])
    force = np.concatenate([run.force[rows] for run, rows in pairs])
    owner = np.repeat(np.arange(len(runs)), [np.count_nonzero(rows) for rows in used])
    tilt = np.array([run.theta for run in runs])[owner]
    own = (owner[:, None] == np.arange(len(runs))).astype(np.float64)
    begins, count = np.array([run.begin for run in runs]), len(tables)
    longest = _CLIP * np.array([run.depth for run in runs])
    factors: FloatArray | None = None
    for _ in range(_ROUNDS):
        shape, slope = _shapes(tables, np.minimum(d - begins[owner], end), tilt)
        if factors is None:
            columns = np.concatenate([shape, own], axis=1)
            factors = np.linalg.lstsq(columns, force, rcond=None)[0][:count]
        jacobian = np.concatenate([shape, -(slope @ factors)[:, None] * own, own], axis=1)
        solved = np.linalg.lstsq(jacobian, force, rcond=None)[0]
        factors, shift, zeros = np.split(solved, [count, count + len(runs)])
        shift = np.clip(shift, -longest, longest)
        begins = begins + shift
        if (np.abs(shift) < 1e-6 * longest).all():
            break
    else:
        raise CalibrationError(_NO_BEGINNING)
    if any(zero < run.d.min() - run.toe for zero, run in zip(begins, runs, strict=True)):
        raise CalibrationError(_NO_BEGINNING)
    if (np.count_nonzero(own[d > begins[owner]], axis=0) < _FEWEST).any():
        raise CalibrationError(_NO_BEGINNING)
    if (d - begins[owner]).max() > end:
        raise CalibrationError(_TOO_DEEP)
    strains = np.linspace(0.0, deepest / tip.radius, 50)
    if not (_power_law(factors, strains, 1) > 0.0).all():
        raise CalibrationError("the modulus of this model would not be positive")
    left = force - jacobian @ np.concatenate([factors, np.zeros(len(runs)), zeros])
    freedom = max(len(force) - jacobian.shape[1], 1)
    variance = float(left @ left) / freedom
    covariance = variance * _variance_inflation(left) * np.linalg.inv(jacobian.T @ jacobian)
    std = np.sqrt(np.diag(covariance)[count:]).reshape(2, -1)
    return CompressionFit(
        tip=tip,
        law=law or _UNIT,
        factors=factors,
        std=_force_std(tables, factors, covariance[:count, :count], deepest),
        zeros=np.stack([begins, zeros, *std], axis=1),
        residual=math.sqrt(variance),
        chi2=variance / _noise(runs) ** 2,
        score=len(force) * math.log(variance) + jacobian.shape[1] * math.log(len(force)),
    )


def compare_laws(
    runs: Sequence[Run], radius: float, poisson: float, material: Material
) -> tuple[list[CompressionFit], list[str]]:
    """Fit spring and solid rubber models to runs; return the fits (best first) and notes.

    Springs are fitted with a constant and with a strain-dependent modulus. If ``material`` is
    nonlinear, springs are also fitted with the shape of the material's law. Poisson's ratio of
    solid rubber is not fitted, because F(d) does not determine this ratio.
    """
    springs, solid = Fingertip(radius), Fingertip(radius, "solid", poisson)
    tried: list[tuple[str, Fingertip, Material | None]] = [("springs", springs, _UNIT)]
    if not material.is_linear:
        unit = tuple(each / material.coefficients[0] for each in material.coefficients)
        tried.append(("springs", springs, Material(unit, material.name)))
    tried.append(("springs, E(d)", springs, None))
    for base in get_args(Base):
        for face in get_args(Face):
            tip = replace(solid, base=base, face=face)
            tried.append((f"solid, {base}, {face}", tip, _UNIT))
    fits, notes = [], []
    for name, tip, law in tried:
        try:
            fits.append(fit_compression(runs, tip, law))
        except CalibrationError as error:
            notes.append(f"{name}: not compared: {error}")
    if not fits:
        raise CalibrationError("; ".join(notes))
    return sorted(fits, key=lambda fit: fit.score), notes


def _end(table: ContactTable, tip: Fingertip, theta: float) -> float:
    """Return a table's maximum d [m] at ``theta``, or 0 if ``theta`` is outside the table."""
    if tip.physics == "solid":
        return _EDGE * table.header.deepest if theta <= table.header.tilt else 0.0
    return _EDGE * tip.radius * min(7.0 / 8.0, 1.0 - math.sin(theta))


def _tables(tip: Fingertip, law: Material | None) -> list[ContactTable]:
    """Return the tables whose forces the fit combines linearly."""
    if law is not None:
        return [ContactTable.build(tip, law, _TOLERANCE)]
    return [ContactTable.build(tip, Material((Fraction(1), *each)), _TOLERANCE) for each in _POWERS]


def _shapes(
    tables: Sequence[ContactTable], d: FloatArray, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the normal force for each power of the strain, and its ∂/∂d, both [n, k]."""
    touching, depth = d > 0.0, np.maximum(d, _STEP)

    def forces(at: FloatArray) -> FloatArray:
        first, *others = [table(at, theta).energy_d * touching for table in tables]
        return np.stack([first, *(each - first for each in others)], axis=1)

    here = forces(depth)
    return here, (forces(depth + _STEP) - here) / _STEP


def _variance_inflation(left: FloatArray) -> float:
    """Return the factor by which lag-1 correlation of the residuals increases the variance."""
    lag = float(left[1:] @ left[:-1]) / float(left @ left)
    lag = min(max(lag, 0.0), 0.99)
    return (1.0 + lag) / (1.0 - lag)


def _force_std(
    tables: Sequence[ContactTable], factors: FloatArray, covariance: FloatArray, deepest: float
) -> float:
    d = np.linspace(0.25 * deepest, deepest, 16)
    shape, _ = _shapes(tables, d, np.zeros(len(d)))
    variance = np.einsum("ni,ij,nj->n", shape, covariance, shape)
    return float((np.sqrt(variance) / (shape @ factors)).max())


def _noise(runs: Sequence[Run]) -> float:
    """Return the scatter [N] of the force about a smooth curve through each run."""
    squares, freedom, most = 0.0, 0, 0.0
    for run in runs:
        d, force = run.d[run.pressed], run.force[run.pressed]
        degree = min(7, len(d) // 3)
        curve: Any = np.polynomial.Chebyshev.fit(d, force, degree)
        left = force - curve(d)
        squares += float(left @ left)
        freedom += len(d) - degree - 1
        most = max(most, float(np.ptp(force)))
    return max(math.sqrt(squares / max(freedom, 1)), _SMOOTHEST * most)
