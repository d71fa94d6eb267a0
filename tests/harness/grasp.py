"""A grasp: two rotational fingers, two soft tips and the object, in quasi-static balance.

The energy is that of both tips and of gravity. A tip's energy with the shear d_t is

    U(d, θ, d_t) = U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d)

with U₀ and F from the contact table; for a constant modulus it is πE[d³/(3cos²θ) + d² d_t tan θ +
d d_t²], the parallel-distributed model. Its shear force is T = ∂U/∂d_t, its normal force
N = ∂U/∂d − T tan θ. Shears follow the rolling increments of `reference_hand`, which can't be
integrated in general, so that a grasp depends on its path: what moves here moves in small steps
and carries its shears along. Balance is where the energy is stationary along those increments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root

from softfinger import SoftfingerError
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.table import ContactTable
from tests.harness.reference_hand import (
    ReferenceHand,
    contact_jacobian,
    contact_variables,
    rolling_rows,
)

FloatArray = NDArray[np.float64]

_TOLERANCE = 1e-9  # of the contact forces, for balance


class GraspError(SoftfingerError, ValueError):
    """No such grasp: a contact opens, leaves the tip's range, or no balance is found."""


@kernel
def sheared_contact(
    data: FloatArray, d: float, theta: float, shear: float
) -> tuple[float, float, float, float, bool]:
    """(U, ∂U/∂d, ∂U/∂θ, T = ∂U/∂d_t, inside) of a tip with shear ``shear`` [m]; zeros for d ≤ 0."""
    force, energy, force_d, force_theta, energy_d, energy_theta, inside = lookup(data, d, theta)
    if d <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, inside
    sine = math.sin(theta)
    cosine = math.cos(theta)
    bend = shear / d
    stretch = shear * (sine + cosine * bend)
    return (
        energy + force * stretch,
        energy_d + force_d * stretch - force * cosine * bend * bend,
        energy_theta + force_theta * stretch + force * shear * (cosine - sine * bend),
        force * (sine + 2.0 * cosine * bend),
        inside,
    )


@kernel
def grasp_gradient(
    data: FloatArray,
    coordinates: FloatArray,
    start: FloatArray,
    start_shear: FloatArray,
    lengths: FloatArray,
    weight: FloatArray,
    shear: FloatArray,
    gradient: FloatArray,
) -> bool:
    """Gradient at ``coordinates`` [5], rolled there from ``start`` with ``start_shear`` [2].

    ``lengths`` is (B, L, e, a, W), ``weight`` gravity's force on the object (x, y). Writes the
    shears [2], rolled by the rows at the middle of the way, and the gradient [5] along the rows at
    its end. Returns whether both contacts are inside the table and closed.
    """
    half, length, offset, radius, width = lengths
    variables = np.empty(6)
    jacobian = np.empty((6, 5))
    rows = np.empty((2, 5))
    middle = 0.5 * (coordinates + start)
    contact_variables(middle, half, length, offset, radius, width, variables)
    contact_jacobian(middle, half, length, offset, jacobian)
    rolling_rows(variables, jacobian, radius, rows)
    for finger in range(2):
        shear[finger] = start_shear[finger]
        for j in range(5):
            shear[finger] += rows[finger, j] * (coordinates[j] - start[j])
    contact_variables(coordinates, half, length, offset, radius, width, variables)
    contact_jacobian(coordinates, half, length, offset, jacobian)
    rolling_rows(variables, jacobian, radius, rows)
    gradient[:] = 0.0
    gradient[2] = -weight[0]
    gradient[3] = -weight[1]
    sound = True
    for finger in range(2):
        d = variables[finger]
        _, by_d, by_theta, tangential, inside = sheared_contact(
            data, d, variables[2 + finger], shear[finger]
        )
        sound = sound and inside and d > 0.0
        for j in range(5):
            gradient[j] += (
                by_d * jacobian[finger, j]
                + by_theta * jacobian[2 + finger, j]
                + tangential * rows[finger, j]
            )
    return sound


@dataclass(frozen=True)
class GraspState:
    """Joint angles (2,) [rad], object pose (x, y, φ), shears (2,) [m]; never written to."""

    q: FloatArray
    pose: FloatArray
    shear: FloatArray

    @property
    def coordinates(self) -> FloatArray:
        """(q1, q2, x, y, φ)."""
        return np.concatenate((self.q, self.pose))


@dataclass(frozen=True)
class GraspForces:
    """What acts in a grasp, each of shape (2,), left first."""

    force: FloatArray  # F on the tip's base, what a pressure grid sums to [N]
    normal: FloatArray  # N [N]
    tangential: FloatArray  # T [N]
    turning: FloatArray  # ∂U/∂θ, the moment that turns the object against the tip [N·m]
    torque: FloatArray  # what the joints must hold, positive closes [N·m]


class Grasp:
    """A hand, its tips' contact table and an object of ``width`` [m] between two parallel faces."""

    def __init__(
        self,
        hand: ReferenceHand,
        table: ContactTable,
        width: float,
        weight: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``weight`` is gravity's force on the object in the hand's plane (x, y) [N]."""
        self.hand = hand
        self.table = table
        self.width = width
        self._weight = np.array(weight, dtype=np.float64)
        self._lengths = np.array(
            [
                hand.half_separation,
                hand.finger_length,
                hand.finger_offset,
                hand.tip_radius,
                width,
            ]
        )

    def symmetric(self, d: float) -> GraspState:
        """Both tips pressed by ``d`` [m], the object upright at their height, no shear force.

        Raises ValueError when the fingers can't reach, GraspError outside the tip's range.
        """
        q = self.hand.inverse((0.0, 0.0, 0.0), (d, d), self.width)
        # T = 0 of the tip's energy: d_t = −(d/2) tan θ.
        shear = -0.5 * d * np.tan(q) * [1.0, -1.0]
        state = GraspState(q, np.array([0.0, self.hand.tips(q)[0, 1], 0.0]), shear)
        self._check(self._evaluate(state.coordinates, state)[2])
        return state

    def gradient(self, state: GraspState) -> FloatArray:
        """Derivative (5,) of the energy by (q1, q2, x, y, φ) along the rolling increments.

        The first two are the torques the joints must hold; the last three vanish in balance.
        """
        return self._evaluate(state.coordinates, state)[0]

    def forces(self, state: GraspState) -> GraspForces:
        """Forces and moments of both contacts and the joints' torques."""
        c = self.hand.contacts(state.q, state.pose, self.width)
        looked_up = self.table(c.d, c.theta)
        rows = [
            sheared_contact(self.table.data, c.d[i], c.theta[i], state.shear[i]) for i in range(2)
        ]
        by_d, turning, tangential = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
        normal = by_d - tangential * np.tan(c.theta)
        return GraspForces(looked_up.force, normal, tangential, turning, self.gradient(state)[:2])

    def balance(self, state: GraspState, q: ArrayLike | None = None) -> GraspState:
        """Bring the joints to ``q`` (2,) at once and let the object roll to where it balances.

        Take small steps: the shears roll along one straight way. Raises GraspError when a contact
        opens or leaves the table, or when no balance is found.
        """
        x = state.coordinates
        if q is not None:
            x[:2] = q
        per_force = np.array([1.0, 1.0, 1.0 / self.hand.tip_radius])

        def residual(pose: FloatArray) -> FloatArray:
            return self._evaluate(np.concatenate((x[:2], pose)), state)[0][2:] * per_force

        x[2:] = root(residual, x[2:], tol=1e-14).x
        gradient, shear, sound = self._evaluate(x, state)
        self._check(sound)
        scale = np.abs(gradient[:2]).sum() / self.hand.reach + np.abs(self._weight).sum()
        if np.abs(residual(x[2:])).max() > _TOLERANCE * scale:
            raise GraspError("no balance found along the rolling increments")
        return GraspState(x[:2].copy(), x[2:].copy(), shear)

    def move(self, state: GraspState, q: ArrayLike, steps: int = 32) -> GraspState:
        """Bring the joints to ``q`` (2,) in ``steps`` equal steps, balancing the object in each."""
        target = np.asarray(q, dtype=np.float64)
        start = state.q
        for k in range(1, steps + 1):
            state = self.balance(state, start + (target - start) * (k / steps))
        return state

    def steer(self, state: GraspState, delta: float, steps: int = 32) -> GraspState:
        """Turn both fingers by ``delta`` [rad] to the right (q1 + δ, q2 − δ), in balance.

        The object turns the other way round from the fingers, by about
        2(a − d + L sin q + e cos q)/W for each radian.
        """
        return self.move(state, state.q + np.array([delta, -delta]), steps)

    def _evaluate(
        self, coordinates: FloatArray, start: GraspState
    ) -> tuple[FloatArray, FloatArray, bool]:
        """The gradient (5,), both shears, and whether both contacts are closed and in the table."""
        shear, gradient = np.empty(2), np.empty(5)
        ends = (coordinates, start.coordinates, start.shear)
        sound = grasp_gradient(self.table.data, *ends, self._lengths, self._weight, shear, gradient)
        return gradient, shear, sound

    @staticmethod
    def _check(sound: bool) -> None:
        if not sound:
            raise GraspError("a contact is open or outside the tip's range")
