"""Reference model of a grasp, in which two soft tips hold an object at equilibrium.

The energy is the sum of both tips' energies and the potential energy of gravity. With the shear
d_t, a tip's energy is

    U(d, θ, d_t) = U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d)

where U₀ and F are taken from the contact table. For a constant modulus, the parallel-distributed
model gives U = πE[d³/(3cos²θ) + d² d_t tan θ + d d_t²]. The shear force is T = ∂U/∂d_t and the
normal force is N = ∂U/∂d − T tan θ. The shear displacements are computed from the rolling
increments of `reference_hand`. In general, the increments are not integrable, so a grasp depends on
the path of the motion. Motions are therefore divided into small steps, and the shears of the steps
are summed. The grasp is at equilibrium if the energy is stationary along the rolling increments.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger import SoftfingerError
from softfinger.kinematics.contact.table import ContactTable
from tests.harness.reference_hand import ReferenceHand

FloatArray = NDArray[np.float64]

# Equilibrium tolerance relative to the contact forces. Rounding errors are about 1e-14.
_TOLERANCE = 1e-11
_STEP = 1e-6  # step for finite differences of forces [rad or tip radii]


class GraspError(SoftfingerError, ValueError):
    """Error raised if a contact opens or leaves the table's range, or if no equilibrium exists."""


def sheared_contact(
    table: ContactTable, d: Any, theta: Any, shear: Any
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, Any]:
    """Return (U, ∂U/∂d, ∂U/∂θ, ∂U/∂d_t, inside) for the shears [m]; all values are 0 for d ≤ 0."""
    c = table(d, theta, edge=True)
    sine, cosine = np.sin(theta), np.cos(theta)
    bend = np.where(np.greater(d, 0.0), shear / np.where(np.greater(d, 0.0), d, 1.0), 0.0)
    stretch = shear * (sine + cosine * bend)
    return (
        c.energy + c.force * stretch,
        c.energy_d + c.force_d * stretch - c.force * cosine * bend * bend,
        c.energy_theta + c.force_theta * stretch + c.force * shear * (cosine - sine * bend),
        c.force * (sine + 2.0 * cosine * bend),
        c.inside,
    )


@dataclass(frozen=True)
class GraspState:
    """Joint angles (2,) [rad], object pose (x, y, φ) and shears (2,) [m]."""

    q: FloatArray
    pose: FloatArray
    shear: FloatArray

    @property
    def coordinates(self) -> FloatArray:
        """Coordinates (q1, q2, x, y, φ)."""
        return np.concatenate((self.q, self.pose))


@dataclass(frozen=True)
class GraspForces:
    """Forces of a grasp, in arrays of shape (2,) with the left finger first."""

    force: FloatArray  # force F on the tip's base, which is the integral of the pressure [N]
    normal: FloatArray  # N [N]
    tangential: FloatArray  # T [N]
    turning: FloatArray  # ∂U/∂θ, the moment that turns the object relative to the tip [N·m]
    torque: FloatArray  # joint torques at equilibrium, positive when closing [N·m]


class Grasp:
    """A hand, its tips' contact table and an object of ``width`` [m] with two parallel faces."""

    def __init__(
        self,
        hand: ReferenceHand,
        table: ContactTable,
        width: float,
        weight: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``weight`` is the force of gravity on the object in the hand's plane (x, y) [N]."""
        self.hand = hand
        self.table = table
        self.width = width
        self._weight = np.array(weight, dtype=np.float64)

    def symmetric(self, d: float) -> GraspState:
        """Return the state in which an upright object indents both tips by ``d`` [m] without shear.

        Raise ValueError if the fingers cannot reach this state. Raise GraspError if the state is
        outside the tip's range.
        """
        q = self.hand.inverse((0.0, 0.0, 0.0), (d, d), self.width)
        # T = 0 gives d_t = −(d/2) tan θ.
        shear = -0.5 * d * np.tan(q) * [1.0, -1.0]
        state = GraspState(q, np.array([0.0, self.hand.tips(q)[0, 1], 0.0]), shear)
        self._check(self._evaluate(state.coordinates, state)[2])
        return state

    def gradient(self, state: GraspState) -> FloatArray:
        """Return the energy's derivatives (5,) along the rolling increments of (q1, q2, x, y, φ).

        At equilibrium, the first two elements are the joint torques, and the last three are zero.
        """
        return self._evaluate(state.coordinates, state)[0]

    def forces(self, state: GraspState) -> GraspForces:
        """Return the joint torques, and the forces and moments of both contacts."""
        d, theta, _ = self.hand.variables(state.coordinates, self.width).T
        _, by_d, turning, tangential, _ = sheared_contact(self.table, d, theta, state.shear)
        normal, torque = by_d - tangential * np.tan(theta), self.gradient(state)[:2]
        return GraspForces(self.table(d, theta).force, normal, tangential, turning, torque)

    def balance(self, state: GraspState, q: ArrayLike | None = None) -> GraspState:
        """Move the joints to ``q`` (2,) in one step and let the object roll to equilibrium.

        Use small steps, because the shears are integrated along a straight path. Raise GraspError
        if a contact opens or leaves the table's range, or if no equilibrium is found.
        """
        x = state.coordinates
        if q is not None:
            x[:2] = q
        # Scale displacements and moments by the tip radius, so that all matrix entries have similar
        # sizes.
        unit = np.array([self.hand.tip_radius, self.hand.tip_radius, 1.0])

        def residual(pose: FloatArray) -> FloatArray:
            gradient = self._evaluate(np.concatenate((x[:2], pose)), state)[0]
            return gradient[2:] * unit / self.hand.tip_radius

        for _ in range(20):
            gradient, shear, sound = self._evaluate(x, state)
            force = np.abs(gradient[:2]).sum() / self.hand.reach + np.abs(self._weight).sum()
            missing = residual(x[2:])
            if np.abs(missing).max() <= _TOLERANCE * force:
                break
            steps = _STEP * np.diag(unit)
            slopes = [residual(x[2:] + each) - residual(x[2:] - each) for each in steps]
            x[2:] -= unit * np.linalg.solve(np.array(slopes).T / (2.0 * _STEP), missing)
        else:
            raise GraspError("no balance found along the rolling increments")
        self._check(sound)
        return GraspState(x[:2].copy(), x[2:].copy(), shear)

    def steer(self, state: GraspState, delta: float) -> GraspState:
        """Return the equilibrium after both fingers rotate by ``delta`` [rad] to the right.

        The joints are then at q1 + δ and q2 − δ. Per radian, the object turns by about 2(a − d + L
        sin q + e cos q)/W in the opposite direction.
        """
        ways = state.q + np.outer(np.arange(1, 17) / 16, [delta, -delta])
        for q in ways:
            state = self.balance(state, q)
        return state

    def _evaluate(
        self, coordinates: FloatArray, start: GraspState
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Return the gradient (5,), the shears (2,), and True if both contacts are valid."""
        moved = coordinates - start.coordinates
        middle = start.coordinates + 0.5 * moved
        shear = start.shear + self.hand.rolling_rows(middle, self.width) @ moved
        d, theta, _ = self.hand.variables(coordinates, self.width).T
        _, *slopes, inside = sheared_contact(self.table, d, theta, shear)
        by_d, by_theta, _ = self.hand.jacobian(coordinates).swapaxes(0, 1)
        rows = (by_d, by_theta, self.hand.rolling_rows(coordinates, self.width))
        gradient = sum(slope @ row for slope, row in zip(slopes, rows, strict=True))
        gradient[2:4] -= self._weight
        return gradient, shear, bool((inside & (d > 0.0)).all())

    @staticmethod
    def _check(sound: bool) -> None:
        if not sound:
            raise GraspError("a contact is open or outside the tip's range")
