"""What the emulated servos move: the interface of every plant, and nothing else."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class JointPlant(Protocol):
    """Joints with their motors. Index 0 is the left finger's joint; positive closes."""

    @property
    def q(self) -> FloatArray:
        """True joint angles [rad] at the time last advanced to."""

    @property
    def dq(self) -> FloatArray:
        """True joint velocities [rad/s]."""

    @property
    def current(self) -> FloatArray:
        """True motor currents [A]."""

    def advance(self, t: float) -> None:
        """Go on to time t [s]; a time that is past does nothing."""

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """What the servo of a joint is told from now on.

        ``mode`` is 5 (current-based position: ``goal_current`` bounds the magnitude), 3 (position:
        likewise, with the model's own limit) or 0 (current: ``goal_current`` is signed).
        """
