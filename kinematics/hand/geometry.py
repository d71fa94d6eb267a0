"""Planar geometry of two rotational fingers and the object between them.

The origin of the hand plane is midway between the pivots. The x axis points from the left pivot to
the right pivot, and the y axis points away from the palm. The pivots are at (∓B, 0), and positive
joint angles q close the fingers. The tip centres are

    O1 = (−B + L sin q1 + e cos q1,  L cos q1 − e sin q1)       O2 is the mirror image of O1

where L is the finger length and e the finger offset (towards the object at q = 0). The object has
centre G, width W and angle φ. The vector n = (cos φ, sin φ) points from the left to the right face
of the object, and t = (−sin φ, cos φ) is perpendicular to n. For tips of radius a, the contact
variables are

    d1 = a + W/2 + (O1 − G)·n     θ1 = φ + q1     s1 = (O1 − G)·t
    d2 = a + W/2 − (O2 − G)·n     θ2 = φ − q2     s2 = (O2 − G)·t

where d is the normal displacement (positive during contact), θ is the tilt of the object relative
to the tip, and s is the tip position along the face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from softfinger.kinematics.compiled.layout import FloatArray

__all__ = ["HandGeometry"]


def tip_position(
    q: float, side: float, half_separation: float, length: float, offset: float
) -> tuple[float, float]:
    """Return the centre (x, y) [m] of a tip at joint angle ``q`` [rad].

    ``side`` is +1 for the left finger and −1 for the right finger.
    """
    sine = math.sin(q)
    cosine = math.cos(q)
    x = side * (-half_separation + length * sine + offset * cosine)
    return x, length * cosine - offset * sine


def tip_velocity(q: float, side: float, length: float, offset: float) -> tuple[float, float]:
    """Return (∂x/∂q, ∂y/∂q) [m/rad] of a tip centre; see `tip_position` for ``side``."""
    sine = math.sin(q)
    cosine = math.cos(q)
    return side * (length * cosine - offset * sine), -(length * sine + offset * cosine)


@dataclass(frozen=True)
class ContactVariables:
    """Contact variables d [m], θ [rad] and s [m], as arrays (2,) with the left tip first."""

    d: FloatArray
    theta: FloatArray
    s: FloatArray


@dataclass(frozen=True)
class HandGeometry:
    """Hand dimensions [m]: pivot separation 2B, finger length L, offset e, tip radius a."""

    pivot_separation: float = 0.100
    finger_length: float = 0.080
    finger_offset: float = 0.0
    tip_radius: float = 0.020

    def __post_init__(self) -> None:
        for name in ("pivot_separation", "finger_length", "tip_radius"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a positive length, got {value!r}")
        if not math.isfinite(self.finger_offset):
            raise ValueError(f"finger_offset must be finite, got {self.finger_offset!r}")

    @property
    def half_separation(self) -> float:
        """Half the pivot separation, B [m]."""
        return 0.5 * self.pivot_separation

    @property
    def reach(self) -> float:
        """Distance between a finger's pivot and tip centre, √(L² + e²) [m]."""
        return math.hypot(self.finger_length, self.finger_offset)

    def tips(self, q: ArrayLike) -> FloatArray:
        """Return the tip centres [[x1, y1], [x2, y2]] [m] at joint angles ``q`` (2,) [rad]."""
        q1, q2 = vector(q, 2, "q")
        lengths = (self.half_separation, self.finger_length, self.finger_offset)
        return np.array([tip_position(q1, 1.0, *lengths), tip_position(q2, -1.0, *lengths)])

    def contacts(self, q: ArrayLike, pose: ArrayLike, width: float) -> ContactVariables:
        """Return the contact variables at joint angles ``q`` (2,) and object ``pose`` (x, y, φ)."""
        x, y, angle = vector(pose, 3, "pose")
        sign = np.array([1.0, -1.0])
        normal = np.array([math.cos(angle), math.sin(angle)])
        along = np.array([-normal[1], normal[0]])
        from_centre = self.tips(q) - np.array([x, y])
        return ContactVariables(
            self.tip_radius + 0.5 * width + sign * (from_centre @ normal),
            angle + sign * vector(q, 2, "q"),
            from_centre @ along,
        )


def vector(values: ArrayLike, length: int, name: str) -> FloatArray:
    """Return ``values`` as a float64 vector.

    Raises ValueError unless the vector has ``length`` elements.
    """
    out = np.asarray(values, dtype=np.float64)
    if out.shape != (length,):
        raise ValueError(f"{name} must have shape ({length},), got {out.shape}")
    return out
