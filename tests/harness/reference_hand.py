"""Compute the hand's contact Jacobian, rolling constraint and inverse kinematics as a reference.

A tip that rolls without slip is sheared by

    ḋ_t1 = (a − d1) θ̇1 − ṡ1 − tan θ1 ḋ1        ḋ_t2 = (a − d2) θ̇2 + ṡ2 − tan θ2 ḋ2

where the tan θ term makes the virtual work of the contact forces consistent. Coordinates are
ordered (q1, q2, x, y, φ).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.hand.geometry import HandGeometry, tip_velocity, vector

FloatArray = NDArray[np.float64]


class ReferenceHand(HandGeometry):
    """Hand model with derivatives and inverse kinematics."""

    def variables(self, x: Any, width: float) -> Any:
        """Return (d, θ, s) of each tip (2, 3, …) at real or complex coordinates (5, …)."""
        found = []
        for side, q in ((1.0, x[0]), (-1.0, x[1])):
            inwards = self.finger_length * np.sin(q) + self.finger_offset * np.cos(q)
            across = side * (inwards - self.half_separation) - x[2]
            up = self.finger_length * np.cos(q) - self.finger_offset * np.sin(q) - x[3]
            n_x, n_y = np.cos(x[4]), np.sin(x[4])
            d = self.tip_radius + 0.5 * width + side * (across * n_x + up * n_y)
            found.append((d, x[4] + side * q, up * n_x - across * n_y))
        return np.array(found)

    def tip_jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivatives [[∂x1/∂q1, ∂y1/∂q1], [∂x2/∂q2, ∂y2/∂q2]] [m/rad]."""
        q1, q2 = vector(q, 2, "q")
        lengths = (self.finger_length, self.finger_offset)
        return np.array([tip_velocity(q1, 1.0, *lengths), tip_velocity(q2, -1.0, *lengths)])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (2, 3, 5) of each tip's (d, θ, s), computed by complex steps."""
        return np.asarray(self.variables(x[:, None] + 1e-30j * np.eye(5), 0.0).imag / 1e-30)

    def rolling_rows(self, x: FloatArray, width: float) -> FloatArray:
        """Return the rows (2, 5) that map the coordinates' velocities to ḋ_t1 and ḋ_t2."""
        d, theta, _ = self.variables(x, width).T[..., None]
        by_d, by_theta, by_s = self.jacobian(x).swapaxes(0, 1)
        along = np.array([[-1.0], [1.0]])
        return np.asarray((self.tip_radius - d) * by_theta + along * by_s - np.tan(theta) * by_d)

    def inverse(self, pose: ArrayLike, d: ArrayLike, width: float) -> FloatArray:
        """Return the joint angles (2,) for which an object at ``pose`` indents the tips by ``d``.

        The left joint angle is computed from O1·n = −B cos φ + L sin θ1 + e cos θ1. The mirror
        image of this equation gives the right joint angle. The indentations are in metres; a
        negative ``d`` is a gap. Raises ValueError if a finger cannot reach this position.
        """
        x, y, angle = vector(pose, 3, "pose")
        d1, d2 = vector(d, 2, "d")
        along = x * math.cos(angle) + y * math.sin(angle)
        face = self.half_separation * math.cos(angle) - self.tip_radius - 0.5 * width
        return np.array(
            [
                self._angle_for(d1 + face + along) - angle,
                self._angle_for(d2 + face - along) + angle,
            ]
        )

    def _angle_for(self, inward: float) -> float:
        """Return the solution ψ of L sin ψ + e cos ψ = ``inward`` on the branch around 0."""
        return math.asin(inward / self.reach) - math.atan2(self.finger_offset, self.finger_length)
