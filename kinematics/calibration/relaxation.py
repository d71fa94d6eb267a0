"""The relaxation of a tip, from a press that is held: the strengths of its Prony terms."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.calibration.calibration import CalibrationError

FloatArray = NDArray[np.float64]

_HELD = 2.0  # times the longest term that is to be found, at least, must have been looked at


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Strengths r of F = c F∞ (1 + Σ r_i (1 − h_i/F∞)), ḣ_i = (F∞ − h_i)/τ_i.

    ``residual`` is the r.m.s. of F's relative errors, and ``elastic`` what it is without any r.
    """

    strengths: tuple[float, ...]
    residual: float
    elastic: float
    model: FloatArray  # F by the fit [N]


def followed(t: FloatArray, lasting: FloatArray, time: float) -> FloatArray:
    """Return h of ḣ = (F∞ − h)/τ, 0 at first, for a ``lasting`` F∞ straight between the ``t``."""
    out = np.zeros_like(lasting)
    for k in range(1, t.size):
        step = (t[k] - t[k - 1]) / time
        slope = (lasting[k] - lasting[k - 1]) / step if step > 0.0 else 0.0
        start = out[k - 1] - lasting[k - 1] + slope
        out[k] = lasting[k] - slope + start * np.exp(-step)
    return out


def fit_relaxation(
    t: ArrayLike, lasting: ArrayLike, force: ArrayLike, times: tuple[float, ...]
) -> Relaxation:
    """Fit the strengths, none below 0, to a ``force`` [N] over ``t`` [s] since the first touch.

    ``lasting`` [N] is the force of an elastic tip of any modulus so pressed; ``times`` [s] are the
    terms'. A term shorter than two frames can't be told and is left 0. Raises CalibrationError for
    too short a hold.
    """
    at, elastic, load = (np.asarray(each, np.float64) for each in (t, lasting, force))
    if at.size < 8 or not elastic.max() > 0.0:
        raise CalibrationError("relaxation: expected at least eight frames of one press and hold")
    told = [k for k, time in enumerate(times) if time > 2.0 * (at[-1] - at[0]) / (at.size - 1)]
    if told and at[-1] - at[0] < _HELD * max(times[k] for k in told):
        raise CalibrationError(
            f"relaxation: found {at[-1] - at[0]:.1f} s of press and hold, expected at least "
            f"{_HELD:g} times the longest of tip.relaxation_times, {max(times):g} s"
        )
    weight = 1.0 / np.maximum(load, 0.1 * load.max())
    columns = [elastic, *(elastic - followed(at, elastic, times[k]) for k in told)]
    best: tuple[float, tuple[float, ...], FloatArray] | None = None
    first = 0.0
    # Of so few terms each choice is tried: the best of those whose strengths are all above 0.
    for chosen in itertools.product((False, True), repeat=len(told)):
        used = [0, *(1 + k for k, on in enumerate(chosen) if on)]
        rows = np.stack([columns[k] for k in used], axis=1) * weight[:, None]
        found = np.linalg.lstsq(rows, load * weight, rcond=None)[0]
        error = float(np.sqrt(np.mean((rows @ found - load * weight) ** 2)))
        first = first or error
        if found[0] > 0.0 and (found[1:] >= 0.0).all() and (best is None or error < best[0]):
            strengths = [0.0] * len(times)
            for place, value in zip(used[1:], found[1:], strict=True):
                strengths[told[place - 1]] = float(value / found[0])
            best = error, tuple(strengths), rows @ found / weight
    if best is None:
        raise CalibrationError("relaxation: the force does not rise with the press")
    return Relaxation(best[1], best[0], first, best[2])
