"""Two rotational fingers and the object between them: pure planar geometry, nothing with force.

The hand's plane has its origin midway between the pivots, x from the left pivot to the right one, y
away from the palm. Pivots stand at (∓B, 0); a positive joint angle q closes; the tip centres are

    O1 = (−B + L sin q1 + e cos q1,  L cos q1 − e sin q1)       O2 mirrors it

with finger length L and offset e (towards the object at q = 0). The object has its centre G, width
W and angle φ; n = (cos φ, sin φ) points from its left face to its right one, t = (−sin φ, cos φ).
A tip of radius a touches its face with

    d1 = a + W/2 + (O1 − G)·n     θ1 = φ + q1     s1 = (O1 − G)·t
    d2 = a + W/2 − (O2 − G)·n     θ2 = φ − q2     s2 = (O2 − G)·t

d is the normal displacement (contact where it is positive), θ the tilt of the object against the
tip and s the tip's place along the face. A tip that rolls without slip shears by

    ḋ_t1 = (a − d1) θ̇1 − ṡ1 − tan θ1 ḋ1        ḋ_t2 = (a − d2) θ̇2 + ṡ2 − tan θ2 ḋ2

where the tan θ term keeps the virtual work consistent. Coordinates are ordered (q1, q2, x, y, φ).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.compiled.kernel import kernel

FloatArray = NDArray[np.float64]


@kernel
def tip_position(
    q: float, side: float, half_separation: float, length: float, offset: float
) -> tuple[float, float]:
    """Centre (x, y) [m] of one tip at joint angle ``q`` [rad].

    ``side`` is +1 for the left finger and −1 for the right one.
    """
    sine = math.sin(q)
    cosine = math.cos(q)
    x = side * (-half_separation + length * sine + offset * cosine)
    return x, length * cosine - offset * sine


@kernel
def tip_velocity(q: float, side: float, length: float, offset: float) -> tuple[float, float]:
    """Derivative (∂x/∂q, ∂y/∂q) [m/rad] of the tip's centre; ``side`` as in tip_position."""
    sine = math.sin(q)
    cosine = math.cos(q)
    return side * (length * cosine - offset * sine), -(length * sine + offset * cosine)


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


@kernel
def object_from_contacts(
    q1: float,
    q2: float,
    d1: float,
    d2: float,
    theta1: float,
    theta2: float,
    half_separation: float,
    length: float,
    offset: float,
    radius: float,
) -> tuple[float, float, float]:
    """The object's angle φ̂ [rad] and width W [m] from both contacts, and their disagreement [rad].

    φ̂ = (θ1 + θ2 − q1 + q2)/2, W = d1 + d2 − 2a + (O2 − O1)·n(φ̂). The disagreement is
    θ1 − θ2 − q1 − q2, zero when joints and sensors agree and the faces are parallel. Faces that
    lean towards each other by an angle α (narrower away from the palm) make it −α; φ̂ is then that
    of their bisector, and W, between the points of contact, is off by (2a − d1 − d2)(1 − cos α/2).
    Of a disc φ̂ is the direction of the line between the contacts, not how it is turned.
    """
    angle = 0.5 * (theta1 + theta2 - q1 + q2)
    x1, y1 = tip_position(q1, 1.0, half_separation, length, offset)
    x2, y2 = tip_position(q2, -1.0, half_separation, length, offset)
    width = d1 + d2 - 2.0 * radius + (x2 - x1) * math.cos(angle) + (y2 - y1) * math.sin(angle)
    return angle, width, theta1 - theta2 - q1 - q2


@dataclass(frozen=True)
class ContactVariables:
    """d [m], θ [rad] and s [m] of both tips, each of shape (2,), left first."""

    d: FloatArray
    theta: FloatArray
    s: FloatArray


@dataclass(frozen=True)
class HandGeometry:
    """Lengths of the hand [m]: pivots 2B apart, finger length L, offset e, tip radius a.

    ``q_min`` and ``q_max`` are the joints' limits [rad], left first; unlimited when not given.
    """

    pivot_separation: float = 0.100
    finger_length: float = 0.080
    finger_offset: float = 0.0
    tip_radius: float = 0.020
    q_min: tuple[float, float] = (-math.inf, -math.inf)
    q_max: tuple[float, float] = (math.inf, math.inf)

    def __post_init__(self) -> None:
        for name in ("pivot_separation", "finger_length", "tip_radius"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a positive length, not {value!r}")
        if not math.isfinite(self.finger_offset):
            raise ValueError(f"finger_offset must be finite, not {self.finger_offset!r}")
        for low, high in zip(self.q_min, self.q_max, strict=True):
            if not low < high:
                raise ValueError(f"q_min must be below q_max, not {low!r} and {high!r}")

    @property
    def half_separation(self) -> float:
        """B, half the pivots' separation [m]."""
        return 0.5 * self.pivot_separation

    @property
    def reach(self) -> float:
        """Distance from a pivot to its tip's centre, √(L² + e²) [m]."""
        return math.hypot(self.finger_length, self.finger_offset)

    def within_limits(self, q: ArrayLike) -> bool:
        """Whether both joint angles ``q`` (2,) are within their limits."""
        angles = _vector(q, 2, "q")
        return bool(np.all(angles >= self.q_min) and np.all(angles <= self.q_max))

    def tips(self, q: ArrayLike) -> FloatArray:
        """Tip centres [[x1, y1], [x2, y2]] [m] at joint angles ``q`` (2,) [rad]."""
        q1, q2 = _vector(q, 2, "q")
        lengths = (self.half_separation, self.finger_length, self.finger_offset)
        return np.array([tip_position(q1, 1.0, *lengths), tip_position(q2, -1.0, *lengths)])

    def tip_jacobian(self, q: ArrayLike) -> FloatArray:
        """Derivatives [[∂x1/∂q1, ∂y1/∂q1], [∂x2/∂q2, ∂y2/∂q2]] [m/rad]."""
        q1, q2 = _vector(q, 2, "q")
        lengths = (self.finger_length, self.finger_offset)
        return np.array([tip_velocity(q1, 1.0, *lengths), tip_velocity(q2, -1.0, *lengths)])

    def contacts(self, q: ArrayLike, pose: ArrayLike, width: float) -> ContactVariables:
        """Contact variables at joint angles ``q`` (2,) and object ``pose`` (x, y, φ)."""
        out = np.empty(6)
        contact_variables(self._coordinates(q, pose), *self._lengths(), width, out)
        return ContactVariables(out[0:2], out[2:4], out[4:6])

    def jacobian(self, q: ArrayLike, pose: ArrayLike) -> FloatArray:
        """Derivatives (6, 5) of (d1, d2, θ1, θ2, s1, s2) by (q1, q2, x, y, φ)."""
        out = np.empty((6, 5))
        contact_jacobian(self._coordinates(q, pose), *self._lengths()[:3], out)
        return out

    def rolling(self, q: ArrayLike, pose: ArrayLike, width: float) -> FloatArray:
        """Rows (2, 5) that give (ḋ_t1, ḋ_t2) from the velocities of (q1, q2, x, y, φ)."""
        variables = np.empty(6)
        coordinates = self._coordinates(q, pose)
        contact_variables(coordinates, *self._lengths(), width, variables)
        jacobian = np.empty((6, 5))
        contact_jacobian(coordinates, *self._lengths()[:3], jacobian)
        out = np.empty((2, 5))
        rolling_rows(variables, jacobian, self.tip_radius, out)
        return out

    def inverse(self, pose: ArrayLike, d: ArrayLike, width: float) -> FloatArray:
        """Joint angles (2,) that press ``d`` (2,) [m] into an object of ``width`` at ``pose``.

        Closed form: O1·n = −B cos φ + L sin θ1 + e cos θ1 and its mirror image. A negative ``d`` is
        a gap. Raises ValueError when a finger can't reach that far, or only past its limits.
        """
        x, y, angle = _vector(pose, 3, "pose")
        d1, d2 = _vector(d, 2, "d")
        along = x * math.cos(angle) + y * math.sin(angle)
        face = self.half_separation * math.cos(angle) - self.tip_radius - 0.5 * width
        q = np.array(
            [
                self._angle_for(d1 + face + along) - angle,
                self._angle_for(d2 + face - along) + angle,
            ]
        )
        if not self.within_limits(q):
            raise ValueError(
                f"out of reach: the joints would have to be at {q[0]:.3f} and {q[1]:.3f} rad, "
                f"past their limits"
            )
        return q

    def object_from_contacts(
        self, q: ArrayLike, d: ArrayLike, theta: ArrayLike
    ) -> tuple[float, float, float]:
        """Angle [rad], width [m] and disagreement [rad] of the object held by two contacts."""
        q1, q2 = _vector(q, 2, "q")
        d1, d2 = _vector(d, 2, "d")
        theta1, theta2 = _vector(theta, 2, "theta")
        return object_from_contacts(q1, q2, d1, d2, theta1, theta2, *self._lengths())

    def _angle_for(self, inward: float) -> float:
        """ψ with L sin ψ + e cos ψ = ``inward``, on the branch around 0."""
        ratio = inward / self.reach
        if not -1.0 <= ratio <= 1.0:
            raise ValueError(
                f"out of reach: the tip would have to be {inward:.4f} m from its pivot's line, "
                f"the finger reaches {self.reach:.4f} m"
            )
        return math.asin(ratio) - math.atan2(self.finger_offset, self.finger_length)

    def _lengths(self) -> tuple[float, float, float, float]:
        return self.half_separation, self.finger_length, self.finger_offset, self.tip_radius

    @staticmethod
    def _coordinates(q: ArrayLike, pose: ArrayLike) -> FloatArray:
        return np.concatenate((_vector(q, 2, "q"), _vector(pose, 3, "pose")))


def _vector(values: ArrayLike, length: int, name: str) -> FloatArray:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (length,):
        raise ValueError(f"{name} must have shape ({length},), not {vector.shape}")
    return vector
