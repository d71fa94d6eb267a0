"""The hand's contact Jacobian, rolling constraint and inverse kinematics: what tests compare with.

A tip that rolls without slip shears by

    ḋ_t1 = (a − d1) θ̇1 − ṡ1 − tan θ1 ḋ1        ḋ_t2 = (a − d2) θ̇2 + ṡ2 − tan θ2 ḋ2

where the tan θ term keeps the virtual work consistent. Coordinates are ordered (q1, q2, x, y, φ).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.hand.geometry import HandGeometry, tip_position, tip_velocity, vector

FloatArray = NDArray[np.float64]


@kernel
def contact_variables(
    coordinates: FloatArray,
    half_separation: float,
    length: float,
    offset: float,
    radius: float,
    width: float,
    out: FloatArray,
) -> None:
    """Write (d1, d2, θ1, θ2, s1, s2) of ``coordinates`` [5] into ``out`` [6]."""
    q1 = coordinates[0]
    q2 = coordinates[1]
    angle = coordinates[4]
    nx = math.cos(angle)
    ny = math.sin(angle)
    x1, y1 = tip_position(q1, 1.0, half_separation, length, offset)
    x2, y2 = tip_position(q2, -1.0, half_separation, length, offset)
    x1 -= coordinates[2]
    y1 -= coordinates[3]
    x2 -= coordinates[2]
    y2 -= coordinates[3]
    out[0] = radius + 0.5 * width + x1 * nx + y1 * ny
    out[1] = radius + 0.5 * width - x2 * nx - y2 * ny
    out[2] = angle + q1
    out[3] = angle - q2
    out[4] = y1 * nx - x1 * ny
    out[5] = y2 * nx - x2 * ny


@kernel
def contact_jacobian(
    coordinates: FloatArray,
    half_separation: float,
    length: float,
    offset: float,
    out: FloatArray,
) -> None:
    """Write the derivatives (6, 5) of (d1, d2, θ1, θ2, s1, s2) by ``coordinates`` into ``out``."""
    q1 = coordinates[0]
    q2 = coordinates[1]
    angle = coordinates[4]
    nx = math.cos(angle)
    ny = math.sin(angle)
    x1, y1 = tip_position(q1, 1.0, half_separation, length, offset)
    x2, y2 = tip_position(q2, -1.0, half_separation, length, offset)
    vx1, vy1 = tip_velocity(q1, 1.0, length, offset)
    vx2, vy2 = tip_velocity(q2, -1.0, length, offset)
    x1 -= coordinates[2]
    y1 -= coordinates[3]
    x2 -= coordinates[2]
    y2 -= coordinates[3]
    out[:] = 0.0
    # ∂n/∂φ = t and ∂t/∂φ = −n.
    out[0, 0] = vx1 * nx + vy1 * ny
    out[0, 2] = -nx
    out[0, 3] = -ny
    out[0, 4] = y1 * nx - x1 * ny
    out[1, 1] = -(vx2 * nx + vy2 * ny)
    out[1, 2] = nx
    out[1, 3] = ny
    out[1, 4] = -(y2 * nx - x2 * ny)
    out[2, 0] = 1.0
    out[2, 4] = 1.0
    out[3, 1] = -1.0
    out[3, 4] = 1.0
    out[4, 0] = vy1 * nx - vx1 * ny
    out[4, 2] = ny
    out[4, 3] = -nx
    out[4, 4] = -(x1 * nx + y1 * ny)
    out[5, 1] = vy2 * nx - vx2 * ny
    out[5, 2] = ny
    out[5, 3] = -nx
    out[5, 4] = -(x2 * nx + y2 * ny)


@kernel
def rolling_rows(
    variables: FloatArray, jacobian: FloatArray, radius: float, out: FloatArray
) -> None:
    """Write the rows of ḋ_t1, ḋ_t2 over the coordinates' velocities into ``out`` [2, 5].

    ``variables`` [6] and ``jacobian`` [6, 5] as contact_variables and contact_jacobian write them.
    """
    for finger in range(2):
        arm = radius - variables[finger]
        tangent = math.tan(variables[2 + finger])
        along = 1.0 if finger == 1 else -1.0
        for j in range(5):
            out[finger, j] = (
                arm * jacobian[2 + finger, j]
                + along * jacobian[4 + finger, j]
                - tangent * jacobian[finger, j]
            )


class ReferenceHand(HandGeometry):
    """The hand with its derivatives and its inverse kinematics."""

    def tip_jacobian(self, q: ArrayLike) -> FloatArray:
        """Derivatives [[∂x1/∂q1, ∂y1/∂q1], [∂x2/∂q2, ∂y2/∂q2]] [m/rad]."""
        q1, q2 = vector(q, 2, "q")
        lengths = (self.finger_length, self.finger_offset)
        return np.array([tip_velocity(q1, 1.0, *lengths), tip_velocity(q2, -1.0, *lengths)])

    def jacobian(self, q: ArrayLike, pose: ArrayLike) -> FloatArray:
        """Derivatives (6, 5) of (d1, d2, θ1, θ2, s1, s2) by (q1, q2, x, y, φ)."""
        coordinates = np.concatenate((vector(q, 2, "q"), vector(pose, 3, "pose")))
        out = np.empty((6, 5))
        lengths = (self.half_separation, self.finger_length, self.finger_offset)
        contact_jacobian(coordinates, *lengths, out)
        return out

    def inverse(self, pose: ArrayLike, d: ArrayLike, width: float) -> FloatArray:
        """Joint angles (2,) that press ``d`` (2,) [m] into an object of ``width`` at ``pose``.

        Closed form: O1·n = −B cos φ + L sin θ1 + e cos θ1 and its mirror image. A negative ``d`` is
        a gap. Raises ValueError when a finger can't reach that far.
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
        """ψ with L sin ψ + e cos ψ = ``inward``, on the branch around 0."""
        return math.asin(inward / self.reach) - math.atan2(self.finger_offset, self.finger_length)
