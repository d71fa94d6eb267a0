"""Errors of the estimator over the whole envelope: against the Cramér-Rao bound, and its bias.

d 0.5-8 mm, tilts of 0-30° towards all sides, the tip anywhere between the cells, a noise of
0.1-2 % of the modulus. The contacts that come out worst are measured again with fresh noise, so
that the largest figure is not the luckiest of thousands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.tools.benchmarks import accuracy_trials as trials
from softfinger.tools.benchmarks.accuracy_trials import FLOAT, Board, Place
from softfinger.tools.benchmarks.estimator_bounds import LINEAR, SIZE, TIP

FloatArray = NDArray[np.float64]

DEPTHS = (0.0005, 0.00075, 0.001, 0.0015, 0.002, 0.003, 0.004, 0.006, 0.008)  # m
DEGREES = (0.0, 7.5, 15.0, 22.5, 30.0)
DEAD = 0.01  # share of the cells
# 8 bits up to 204 kPa; the envelope's largest pressure is 188 kPa, at 8 mm and 30°.
EIGHT_BITS = Board(pascal_per_count=800.0, full_count=255, threshold=3)
_BAND = 2.576  # standard deviations that hold 99 %


@dataclass(frozen=True)
class Effort:
    """How much is measured; the default is the full campaign."""

    around: int = 16  # azimuths and offsets at each (d, θ)
    frames: int = 2000  # of each contact
    again: int = 12  # contacts of each row that are measured again
    again_frames: int = 40_000
    depths: tuple[float, ...] = DEPTHS
    degrees: tuple[float, ...] = DEGREES
    noises: tuple[float, ...] = trials.noises()


@dataclass(frozen=True)
class Case:
    """One contact at one noise with one way of estimating."""

    place: Place
    noise: float  # Pa
    free: bool
    small: bool
    sigma: FloatArray  # the bound's deviations
    live: NDArray[np.bool_] | None
    board: Board


@dataclass(frozen=True)
class Score:
    """What came of a case: RMS over the bound, NEES a degree of freedom, bias, frames lost."""

    case: Case
    d: float
    tilt_x: float
    tilt_y: float
    nees: float
    d_bias: float  # m
    frames: int
    lost: int  # no valid estimate
    misfits: int  # χ² beyond what noise makes


@dataclass(frozen=True)
class EnvelopeRow:
    """Scores of many cases. RMS errors over the bound: median, and worst as measured again."""

    name: str
    cases: int
    frames: int
    d_median: float
    d_worst: float
    d_where: str
    tilt_median: float
    tilt_worst: float  # of both axes
    tilt_where: str
    seldom: int  # cases seen in less than 99 % of the frames: there what is seen is a choice
    nees: float  # of the others: mean of errorᵀ Σ⁻¹ error a degree of freedom
    nees_least: float
    nees_most: float
    nees_in_band: float  # share of the cases inside the 99 % band of χ²
    lost: int
    misfits: int  # frames whose χ² says that it's another kind of contact
    aim: float

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


@dataclass(frozen=True)
class BiasRow:
    """Bias of d over d, in percent, over many cases: worst place, and worst mean over places."""

    name: str
    cases: int
    frames: int
    rms: float  # over all cases
    worst: float
    deviation: float  # standard deviation of the worst's figure
    where: str
    mean_worst: float  # averaged over azimuths and offsets at one (d, θ, noise)
    lost: int
    misfits: int  # as for EnvelopeRow
    aim: float

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def against_the_bound(effort: Effort, seed: int = 1) -> list[EnvelopeRow]:
    """Rows for all cells and for 1 % dead ones, gain free and known, bound small and elsewhere."""
    rows = []
    for dead, small_aim in ((0.0, 1.10), (DEAD, 1.20)):
        part = replace(effort, around=max(effort.around // 2, 1)) if dead else effort
        scores = _measure(_cases(part, dead, FLOAT, seed), effort.frames, seed)
        for free in (True, False):
            for small in (True, False):
                chosen = [s for s in scores if (s.case.free, s.case.small) == (free, small)]
                if chosen:
                    name = (
                        f"gain {'free' if free else 'known'}, "
                        f"{'the bound is small' if small else 'elsewhere'}"
                        f"{', 1 % dead' if dead else ''}"
                    )
                    aim = small_aim if small else 2.0
                    rows.append(_row(name, chosen, effort, seed + 1, aim))
    return rows


def of_eight_bits(effort: Effort, seed: int = 5) -> list[BiasRow]:
    """Rows for 8-bit counts with a threshold of 3, d from 1 mm up."""
    deep = replace(effort, depths=tuple(d for d in effort.depths if d >= 0.001))
    deep = replace(deep, around=max(effort.around // 2, 1))
    scores = _measure(_cases(deep, 0.0, EIGHT_BITS, seed), effort.frames, seed)
    rows = []
    for free in (True, False):
        for small in (True, False):
            chosen = [s for s in scores if (s.case.free, s.case.small) == (free, small)]
            if not chosen:
                continue
            name = (
                f"8 bits of 800 Pa, 3 counts sent, gain {'free' if free else 'known'}, "
                f"{'the bound is small' if small else 'elsewhere'}"
            )
            rows.append(_bias_row(name, chosen, effort, seed + 1))
    return rows


def _cases(effort: Effort, dead: float, board: Board, seed: int) -> Iterator[Case]:
    random = np.random.default_rng(seed)
    for place in trials.places(effort.depths, effort.degrees, effort.around):
        slopes = trials.jacobian(place)
        live = random.random((SIZE, SIZE)) >= dead if dead else None
        for free in (True, False):
            unit = trials.bound(slopes, 1.0, free, live)
            for noise in effort.noises:
                # What rounding adds to the noise is in the bound that decides what is small.
                whole = noise**2 + board.pascal_per_count**2 / 12.0
                covariance = unit * whole
                small = trials.is_small(place, covariance)
                yield Case(place, noise, free, small, np.sqrt(np.diag(covariance)), live, board)


def _measure(cases: Iterator[Case] | list[Case], frames: int, seed: int) -> list[Score]:
    bank = np.random.default_rng(seed).standard_normal((min(frames, 2000), SIZE, SIZE))
    scores = []
    clean, of = np.empty(0), None
    for case in cases:
        if of is not case.place:
            clean, of = case.place.grid.pressure(TIP, LINEAR, *case.place.truth[:3]), case.place
        scores.append(_score(case, clean, [bank]))
    return scores


def _again(case: Case, frames: int, seed: int) -> Score:
    """The case once more, with noise of its own."""
    random = np.random.default_rng(seed)
    clean = case.place.grid.pressure(TIP, LINEAR, *case.place.truth[:3])
    parts = [min(2000, frames - k) for k in range(0, frames, 2000)]
    return _score(case, clean, (random.standard_normal((n, SIZE, SIZE)) for n in parts))


def _score(case: Case, clean: FloatArray, banks: Any) -> Score:
    more = {} if case.live is None else {"live": case.live}
    made = trials.estimator(case.place, case.noise, case.free, case.board, **more)
    found = np.concatenate(
        [trials.run(made, clean, case.noise, bank, case.board) for bank in banks]
    )
    valid = found[found[:, trials.VALID] > 0.0]
    lost = len(found) - len(valid)
    if not len(valid):
        return Score(case, math.nan, math.nan, math.nan, math.nan, math.nan, len(found), lost, 0)
    n = 4 if case.free else 3
    error = valid[:, :n] - np.array(case.place.truth[:n])
    covariances = valid[:, trials.COVARIANCE :].reshape(-1, 4, 4)[:, :n, :n]
    weighed = np.linalg.solve(covariances, error[:, :, None])[:, :, 0]
    nees = float(np.mean(np.sum(weighed * error, axis=1))) / n
    d, tilt_x, tilt_y = (np.sqrt(np.mean(error**2, axis=0)) / case.sigma).tolist()[:3]
    misfits = int(np.count_nonzero(is_misfit(valid[:, trials.CHI2], valid[:, trials.CELLS])))
    d_bias = float(np.mean(error[:, 0]))
    return Score(case, d, tilt_x, tilt_y, nees, d_bias, len(found), lost, misfits)


def is_misfit(chi2: FloatArray, cells: FloatArray) -> NDArray[np.bool_]:
    """As :attr:`estimation.estimator.ContactEstimate.misfit`, of many."""
    spread = 2.0 / (9.0 * np.maximum(cells - 4.0, 1.0))
    return np.asarray(chi2 > (1.0 - spread + 5.0 * np.sqrt(spread)) ** 3)


def _worst(
    scores: list[Score], value: Callable[[Score], float], effort: Effort, seed: int
) -> tuple[float, Score]:
    """The largest ``value`` of those that came out largest, measured again."""
    ranked = sorted((s for s in scores if math.isfinite(value(s))), key=value, reverse=True)
    fresh = [_again(s.case, effort.again_frames, seed) for s in ranked[: effort.again]]
    top = max(fresh, key=value)
    return value(top), top


def _row(name: str, scores: list[Score], effort: Effort, seed: int, aim: float) -> EnvelopeRow:
    def tilt(score: Score) -> float:
        return max(score.tilt_x, score.tilt_y)

    d_worst, d_top = _worst(scores, lambda s: s.d, effort, seed)
    tilt_worst, tilt_top = _worst(scores, tilt, effort, seed + 1)
    nees = np.array([s.nees for s in scores])
    seen = np.array([s.frames - s.lost for s in scores])
    freedom = np.array([4.0 if s.case.free else 3.0 for s in scores])
    frames = np.array([s.frames for s in scores])
    known = np.isfinite(nees) & (seen >= 0.99 * frames)
    if not known.any():
        nees, known = np.full(len(scores), math.nan), np.ones(len(scores), bool)
    band = _BAND * np.sqrt(2.0 / (freedom[known] * np.maximum(seen[known], 1)))
    return EnvelopeRow(
        name,
        len(scores),
        sum(s.frames for s in scores),
        float(np.nanmedian([s.d for s in scores])),
        d_worst,
        _where(d_top.case),
        float(np.nanmedian([(s.tilt_x, s.tilt_y) for s in scores])),
        tilt_worst,
        _where(tilt_top.case),
        int(np.count_nonzero(seen < 0.99 * frames)),
        float(np.mean(nees[known])),
        float(np.min(nees[known])),
        float(np.max(nees[known])),
        float(np.mean(np.abs(nees[known] - 1.0) <= band)),
        sum(s.lost for s in scores),
        sum(s.misfits for s in scores),
        aim,
    )


def _bias_row(name: str, scores: list[Score], effort: Effort, seed: int) -> BiasRow:
    def bias(score: Score) -> float:
        return abs(score.d_bias) / score.case.place.d

    worst, top = _worst(scores, bias, effort, seed)
    groups: dict[tuple[float, float, float], list[float]] = {}
    for score in scores:
        place = score.case.place
        key = (place.d, place.theta, score.case.noise)
        groups.setdefault(key, []).append(score.d_bias / place.d)
    seen = top.frames - top.lost
    deviation = float(top.d * top.case.sigma[0] / top.case.place.d) / math.sqrt(max(seen, 1))
    return BiasRow(
        name,
        len(scores),
        sum(s.frames for s in scores),
        100.0 * math.sqrt(float(np.nanmean([bias(s) ** 2 for s in scores]))),
        100.0 * worst,
        100.0 * deviation,
        _where(top.case),
        100.0 * max(abs(float(np.nanmean(each))) for each in groups.values()),
        sum(s.lost for s in scores),
        sum(s.misfits for s in scores),
        1.0,
    )


def _where(case: Case) -> str:
    return f"{case.place}, noise {case.noise:.0f} Pa"
