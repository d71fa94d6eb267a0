"""Frames of other contact models, estimated as the linear one: how far off, and whether it shows.

A fit's χ² a degree of freedom is beyond what noise makes above the limit of
:func:`benchmarks.accuracy_envelope.is_misfit`. Whether a wrong model goes beyond it depends
on the noise that hides it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from softfinger.tools.benchmarks import accuracy_trials as trials
from softfinger.tools.benchmarks.accuracy_envelope import is_misfit
from softfinger.tools.benchmarks.accuracy_trials import Place
from softfinger.tools.benchmarks.estimator_bounds import OTHER_MODELS, SIZE, frame_of

CONTACTS = (
    (0.001, 0.0),
    (0.002, 0.0),
    (0.002, 15.0),
    (0.004, 0.0),
    (0.004, 15.0),
    (0.008, 0.0),
    (0.008, 30.0),
)


@dataclass(frozen=True)
class MismatchRow:
    """One contact of another model at one noise, estimated as linear with the gain free."""

    name: str
    d: float  # truth [m]
    theta: float  # truth [rad]
    noise: float  # Pa
    d_error: float  # mean [m]
    theta_error: float  # mean [rad]
    told: float  # median of the standard deviation that is reported of d [m]
    chi2: float  # median, a degree of freedom
    misfits: float  # share of frames that χ² flags
    invalid: float  # share of frames without a valid estimate

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def mismatches(frames: int, noises: tuple[float, ...], seed: int = 23) -> list[MismatchRow]:
    """Each other model at each contact and noise."""
    bank = np.random.default_rng(seed).standard_normal((frames, SIZE, SIZE))
    rows = []
    for model in OTHER_MODELS:
        for d, degrees in CONTACTS:
            place = Place(d, math.radians(degrees), 0.0, (0.0, 0.0))
            clean = frame_of(model, place.grid, d, place.theta)
            for noise in noises:
                found = trials.run(trials.estimator(place, noise, True), clean, noise, bank)
                valid = found[found[:, trials.VALID] > 0.0]
                if not len(valid):
                    continue
                flagged = is_misfit(valid[:, trials.CHI2], valid[:, trials.CELLS])
                rows.append(
                    MismatchRow(
                        model,
                        d,
                        place.theta,
                        noise,
                        float(np.mean(valid[:, trials.D])) - d,
                        float(np.mean(valid[:, trials.TILT_X])) - place.theta,
                        float(np.median(np.sqrt(valid[:, trials.COVARIANCE]))),
                        float(np.median(valid[:, trials.CHI2])),
                        float(np.mean(flagged)),
                        1.0 - len(valid) / frames,
                    )
                )
    return rows
