"""The plain records that the pipeline's stages hand to each other, and nothing else.

Per-finger arrays have length 2, left finger first; a finger that the scene lacks stays 0 and is
flagged by ``valid``. SI units. Positive joint angle closes. ``t`` is the clock's time in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FINGERS = ("left", "right")

FloatArray = NDArray[np.float64]


def _pair() -> FloatArray:
    return np.zeros(2)


@dataclass(slots=True)
class Reading:
    """What the servos said. Filled in place by ``Servos.read``."""

    seq: int = 0
    t: float = 0.0
    valid: bool = False
    q: FloatArray = field(default_factory=_pair)  # joint angle [rad]
    dq: FloatArray = field(default_factory=_pair)  # joint velocity [rad/s]
    current: FloatArray = field(default_factory=_pair)  # motor current [A], positive closes
    alert: int = 0  # bit i: servo of finger i reports a hardware error


@dataclass(slots=True)
class Frame:
    """One tactile frame. ``data`` is never written after it was handed over."""

    seq: int
    t_sample: float  # when the board scanned it (middle of the scan, best estimate) [s]
    t_arrival: float  # when it was complete here [s]
    valid: bool
    data: NDArray[np.uint16]  # counts [rows, cols]


@dataclass(slots=True)
class Goal:
    """What the servos shall do. Filled in place by the control law, bounded by safety."""

    seq: int = 0
    t: float = 0.0
    valid: bool = False
    q: FloatArray = field(default_factory=_pair)  # goal angle [rad]
    current: FloatArray = field(default_factory=_pair)  # bound on the current's magnitude [A]
