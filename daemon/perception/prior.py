"""Define the priors of a finger's tip modulus, sensor gain and torque constant."""

from __future__ import annotations

from typing import NamedTuple

MODULUS_ERROR = 0.2  # relative modulus error of an uncalibrated tip
CALIBRATED_ERROR = 0.05  # relative modulus error after `softfinger calibrate modulus`
# Assumed relative force loss in a hold if `tip.relaxation` is not set. Simulated tips with unset
# relaxation lose 7 to 17 % (docs/accuracy.md); no real tip has been measured.
RELAXATION_ERROR = 0.07


class Prior(NamedTuple):
    """Priors of one finger's calibration factors, each as (mean, relative standard deviation).

    Remounting a sensor changes its gain by 5 to 32 % (DTIC ADP011007). The torque constant of a
    servo is known to within 10 %.
    """

    modulus: tuple[float, float]
    gain: tuple[float, float]
    torque: tuple[float, float]
