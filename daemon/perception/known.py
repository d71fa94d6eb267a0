"""Priors: what is known of a finger's tip, sensor and joint before anything touches."""

from __future__ import annotations

from typing import NamedTuple

MODULUS_ERROR = 0.2  # of a tip whose modulus nobody measured
CALIBRATED_ERROR = 0.05  # of one that `softfinger calibrate modulus` found


class Prior(NamedTuple):
    """One finger's scales: (mean, relative standard deviation).

    A modulus is known to some 20 % before it was calibrated, a sensor's gain changes by 5-32 % when
    it is mounted again (DTIC ADP011007), a torque constant is good to 10 %.
    """

    modulus: tuple[float, float] = (1.0, MODULUS_ERROR)
    gain: tuple[float, float] = (1.0, 0.25)
    torque: tuple[float, float] = (1.0, 0.1)


UNKNOWN = Prior()
