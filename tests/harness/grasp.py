"""A grasp: two rotational fingers, two soft tips and the object, in quasi-static balance.

The energy is that of both tips and of gravity. A tip's energy with the shear d_t is

    U(d, θ, d_t) = U₀(d, θ) + F(d, θ) (sin θ d_t + cos θ d_t²/d)

with U₀ and F from the contact table; for a constant modulus it is πE[d³/(3cos²θ) + d² d_t tan θ +
d d_t²], the parallel-distributed model. Its shear force is T = ∂U/∂d_t, its normal force
N = ∂U/∂d − T tan θ. Shears follow the rolling increments of `reference_hand`, which can't be
integrated in general, so that a grasp depends on its path: what moves here moves in small steps
and carries its shears along. Balance is where the energy is stationary along those increments.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger import SoftfingerError
from softfinger.kinematics.contact.table import ContactTable
from tests.harness.reference_hand import ReferenceHand

FloatArray = NDArray[np.float64]

_TOLERANCE = 1e-11  # of the contact forces, for balance: rounding leaves some 1e-14 of them
_STEP = 1e-6  # of a turn [rad], and of a way in tip radii: for differences of forces


class GraspError(SoftfingerError, ValueError):
    """No such grasp: a contact opens, leaves the tip's range, or no balance is found."""


def sheared_contact(
    table: ContactTable, d: Any, theta: Any, shear: Any
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, Any]:
    """(U, ∂U/∂d, ∂U/∂θ, T = ∂U/∂d_t, inside) of tips with shears ``shear`` [m]; zeros for d ≤ 0."""
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
        d, theta, _ = self.hand.variables(state.coordinates, self.width).T
        _, by_d, turning, tangential, _ = sheared_contact(self.table, d, theta, state.shear)
        normal, torque = by_d - tangential * np.tan(theta), self.gradient(state)[:2]
        return GraspForces(self.table(d, theta).force, normal, tangential, turning, torque)

    def balance(self, state: GraspState, q: ArrayLike | None = None) -> GraspState:
        """Bring the joints to ``q`` (2,) at once and let the object roll to where it balances.

        Take small steps: the shears roll along one straight way. Raises GraspError when a contact
        opens or leaves the table, or when no balance is found.
        """
        x = state.coordinates
        if q is not None:
            x[:2] = q
        # Ways in tip radii and moments over them, so that no row or column outweighs another.
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
        """Turn both fingers by ``delta`` [rad] to the right (q1 + δ, q2 − δ), in balance.

        The object turns the other way round from the fingers, by about
        2(a − d + L sin q + e cos q)/W for each radian.
        """
        ways = state.q + np.outer(np.arange(1, 17) / 16, [delta, -delta])
        for q in ways:
            state = self.balance(state, q)
        return state

    def _evaluate(
        self, coordinates: FloatArray, start: GraspState
    ) -> tuple[FloatArray, FloatArray, bool]:
        """The gradient (5,), both shears, and whether both contacts are closed and in the table."""
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
