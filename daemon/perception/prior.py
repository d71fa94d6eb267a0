"""Define the priors of a finger's tip modulus, sensor gain and torque constant."""

from __future__ import annotations

from typing import NamedTuple

MODULUS_ERROR = 0.2  # relative modulus error of an uncalibrated tip
CALIBRATED_ERROR = 0.05  # relative modulus error after `softfinger calibrate modulus`
# Typical relative force loss in a hold if `tip.relaxation` is not set. Silicone rubber loses a few
# percent to 15 % within a minute.
RELAXATION_ERROR = 0.07


class Prior(NamedTuple):
    """Priors of one finger's calibration factors, each as (mean, relative standard deviation).

    Remounting a sensor changes its gain by 5 to 32 % (DTIC ADP011007). The torque constant of a
    servo is known to within 10 %.
    """

    modulus: tuple[float, float]
    gain: tuple[float, float]
    torque: tuple[float, float]
