"""Compute a quasi-static manipulation (section V), and compare it with the simulated hand.

Both tips consist of the paper's springs and stick to the object. The model does not include any
other friction. The energy and the shear rate of a tip with shear ζ are

    U = πE [d³/(3 cos² θ) + d² ζ tan θ + d ζ²]      ζ̇ = −ṡ + (a − d) θ̇ − ḋ tan θ

The shear rate is the rolling speed (a − d) θ̇ minus two terms. ṡ is the sliding speed along the
face. ḋ tan θ is the compression speed's component along a tilted face. The quantities s, d and θ
are defined in `kinematics.hand.geometry`; the right tip's θ is mirrored. The object is in
equilibrium if Σ δU = 0 for each possible motion. With M = ∂U/∂θ, T = ∂U/∂ζ and N = ∂U/∂d − T tan θ,
the condition becomes

    Σ N δd + M δθ + T (−δs + (a − d) δθ) = 0

Every pose in a slow turn satisfies this equilibrium condition. `turned` solves the condition step
by step; the solution does not involve time, mass or damping.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from softfinger.kinematics.hand.geometry import HandGeometry, tip_velocity
from softfinger.tools.paper.model_pages import MODULUS
from softfinger.tools.paper.sheets import FigurePage, FloatArray, Panel, Sheet, summary
from softfinger.tools.simulated_daemon import SimulatedDaemon
from softfinger.tools.style import INK, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORCE, WIDTH = 10.0, 0.040  # force on the base of each tip [N], and object width [m]
REACH = math.radians(8.0)  # maximum object angle in each direction [rad]
ANTISYMMETRIC_ANGLES = (-4, -2, 0, 2, 4)  # degrees
_SWING_TIME = 4.0  # duration of a swing from 0 to REACH [s]
_SIDE_ANGLES = np.radians(np.linspace(-2.5, 2.5, 41))
_STEPS = 64
_FRICTION = 0.6
_SIDES = np.array([1.0, -1.0])
_HAND = HandGeometry()
_GRIP = 3.0  # s
_FREE = {"table_friction": 0.0, "joint_friction": 0.0}


class Held(NamedTuple):
    """Poses of the hand and the object, and the contacts of both tips."""

    q: FloatArray
    pose: FloatArray
    d: FloatArray
    theta: FloatArray
    s: FloatArray
    shear: FloatArray

    def gradient(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return N [N], M [N·m] and T [N] for both tips."""
        d, shear = self.d, self.shear
        tangent, inverse = np.tan(self.theta), 1.0 / np.cos(self.theta) ** 2
        stiff = math.pi * MODULUS
        tangential = stiff * (d**2 * tangent + 2.0 * d * shear)
        along_d = stiff * (d**2 * inverse + 2.0 * d * shear * tangent + shear**2)
        return (
            along_d - tangential * tangent,
            stiff * (2.0 / 3.0 * d**3 * tangent + d**2 * shear) * inverse,
            tangential,
        )

    def energy(self) -> float:
        """Return the sum of U over both tips [J]."""
        d, shear, tangent = self.d, self.shear, np.tan(self.theta)
        parts = d**3 / (3.0 * np.cos(self.theta) ** 2) + d**2 * shear * tangent + d * shear**2
        return float(math.pi * MODULUS * parts.sum())

    def torques(self) -> FloatArray:
        """Return the joint torques [N·m], positive in the closing direction."""
        lengths = _HAND.finger_length, _HAND.finger_offset
        moves = np.array(
            [tip_velocity(q, k, *lengths) for q, k in zip(self.q, _SIDES, strict=True)]
        )
        angle = self.pose[2]
        normal, moment, tangential = self.gradient()
        deeper = _SIDES * (moves @ [math.cos(angle), math.sin(angle)])
        along = moves @ [-math.sin(angle), math.cos(angle)]
        rolls = moment + tangential * (_HAND.tip_radius - self.d)
        return np.asarray(normal * deeper - tangential * along + rolls)

    def unbalanced(self) -> FloatArray:
        """Return four residuals [N]: forces along x and y, moment divided by W, and grip force."""
        normal, moment, tangential = self.gradient()
        angle = self.pose[2]
        across, along = [math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]
        tips = _HAND.tips(self.q) - self.pose[:2]
        out = np.zeros(4)
        out[:2] = -((_SIDES * normal) @ np.outer([1, 1], across)) + tangential.sum() * np.array(
            along
        )
        rolls = moment + tangential * (_HAND.tip_radius - self.d)
        turns = normal * _SIDES * (tips @ along) + tangential * (tips @ across) + _SIDES * rolls
        out[2] = turns.sum() / WIDTH
        force = math.pi * MODULUS * self.d**2 / np.cos(self.theta)
        out[3] = force.mean() - FORCE
        return out


def held(q: FloatArray, pose: FloatArray, last: Held | None) -> Held:
    """Return the pose after the tips have rolled from ``last``.

    If ``last`` is None, the tips are not sheared.
    """
    contacts = _HAND.contacts(q, pose, WIDTH)
    theta = _SIDES * contacts.theta
    shear = np.zeros(2)
    if last is not None:
        radius = _HAND.tip_radius - 0.5 * (contacts.d + last.d)
        shear = last.shear - (contacts.s - last.s) + radius * (theta - last.theta)
        shear -= np.tan(0.5 * (theta + last.theta)) * (contacts.d - last.d)
    return Held(q, pose, contacts.d, theta, contacts.s, shear)


def solve(residual: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Find the root near ``start`` by Newton's method. Raises RuntimeError without convergence."""
    x = start.copy()
    for _ in range(30):
        value = residual(x)
        if np.abs(value).max() < 1e-8:
            return x
        steps = 1e-7 * np.eye(x.size)
        slopes = [(residual(x + h) - residual(x - h)) / 2e-7 for h in steps]
        x = x - np.linalg.solve(np.array(slopes).T, value)
    raise RuntimeError(f"found no equilibrium near {start}: residual {residual(x)}")


@cache
def gripped() -> Held:
    """Return the equilibrium pose in which unsheared tips grip an upright object."""

    def met(x: FloatArray) -> Held:
        q = np.full(2, x[0])
        return held(q, np.array([0.0, _HAND.tips(q)[0, 1], 0.0]), None)

    first = met(solve(lambda x: met(x).unbalanced()[3:], np.array([0.15])))
    return turned(first, 0.0)


def turned(last: Held, angle: float) -> Held:
    """Return the equilibrium at the object angle ``angle`` [rad], one step after ``last``."""

    def pose(x: FloatArray) -> Held:
        return held(x[2:], np.array([x[0], x[1], angle]), last)

    return pose(solve(lambda x: pose(x).unbalanced(), np.r_[last.pose[:2], last.q]))


def potential(there: Held, start: Held) -> float:
    """Return V = ΣU − τ (q1 + q2) [J] relative to ``start``, whose mean joint torque is τ."""
    torque = float(start.torques().mean())
    return there.energy() - start.energy() - torque * float((there.q - start.q).sum())


def valley(floor: Held, angle: float, start: Held) -> float:
    """Return V at the object angle ``angle`` [rad], or NaN if a tip would slip.

    V is minimised over all coordinates except the antisymmetric joint angle, which is taken from
    ``floor``. The tips roll to the pose from ``start`` in one step.
    """
    antisymmetric = 0.5 * float(floor.q[0] - floor.q[1])
    torque = float(start.torques().mean())

    def pose(x: FloatArray) -> Held:
        q = np.array([x[2] + antisymmetric, x[2] - antisymmetric])
        return held(q, np.array([x[0], x[1], angle]), start)

    def residual(x: FloatArray) -> FloatArray:
        there = pose(x)
        closing = (there.torques().mean() - torque) / WIDTH
        return np.append(there.unbalanced()[:2], closing)

    there = pose(solve(residual, np.append(floor.pose[:2], floor.q.mean())))
    normal, _, tangential = there.gradient()
    sticks = (np.abs(tangential) < _FRICTION * normal).all()
    return potential(there, start) if sticks else math.nan


def swing() -> list[dict[str, float]]:
    """Rotate the object back and forth in the simulated hand; return one row every 20 ms.

    The holding force deviates by a few percent from `FORCE`. ΣU and T are therefore scaled to
    `FORCE`. ΣU is proportional to F^(3/2), and T is proportional to F.
    """
    sections: dict[str, dict[str, Any]] = {
        "material": {"law": "constant", "modulus": MODULUS},
        "simulation": _FREE,
    }
    rows = []
    with SimulatedDaemon(sections) as hand:
        hand.grasp(FORCE)
        hand.run(_GRIP)
        start, t = hand.state.t, 0.0
        while t < 4.0 * _SWING_TIME:
            t = hand.state.t - start
            wanted = REACH * _triangle(t / _SWING_TIME)
            hand.command("hold", force=FORCE, angle=wanted)
            hand.loop.advance(0.02)
            found = Held(
                np.array(hand.plant.q), np.array(hand.plant.object_pose), np.array(hand.plant.d),
                _SIDES * hand.plant.theta, np.zeros(2), np.zeros(2),
            )  # fmt: skip
            sheared = _SIDES * hand.plant.tangential
            shear = (sheared - found.gradient()[2]) / (2.0 * math.pi * MODULUS * found.d)
            scale = FORCE / hand.plant.force.mean()
            energy = found._replace(shear=shear).energy() * scale**1.5
            row = {
                "t [s]": t,
                "angle [deg]": math.degrees(found.pose[2]),
                "lean [deg]": math.degrees(0.5 * (found.q[0] - found.q[1])),
                "energy of both tips [mJ]": 1e3 * energy,
                "shear force [N]": sheared[0] * scale,
            }
            rows.append(row)
    return rows


def _triangle(turns: float) -> float:
    """Return a triangle wave with period 4 and amplitude 1, rising from 0 at ``turns`` = 0."""
    return 1.0 - abs((turns + 1.0) % 4.0 - 2.0)


@cache
def slow_turn() -> tuple[Sheet, ...]:
    """Return three sheets: the computed path, the plant's path, and V versus the object angle."""
    there = np.linspace(0.0, REACH, _STEPS + 1)[1:]
    back = np.r_[there[-2::-1], -np.linspace(0.0, REACH, _STEPS + 1)]
    start = gripped()
    path = list(itertools.accumulate(np.r_[there, back], turned, initial=start))
    antisymmetric = np.array([0.5 * (each.q[0] - each.q[1]) for each in path])
    equations = {
        "angle [deg]": [math.degrees(each.pose[2]) for each in path],
        "lean [deg]": np.degrees(antisymmetric),
        "energy of both tips [mJ]": [1e3 * each.energy() for each in path],
        "V [mJ]": [1e3 * potential(each, start) for each in path],
        "shear force [N]": [each.gradient()[2][0] for each in path],
    }
    landscape: dict[str, Any] = {}
    for each in ANTISYMMETRIC_ANGLES:
        floor = path[int(np.argmin(np.abs(antisymmetric - math.radians(each))))]
        angles = floor.pose[2] + _SIDE_ANGLES
        landscape[f"angle at {each} deg [deg]"] = np.degrees(angles)
        landscape[f"V at {each} deg [mJ]"] = [1e3 * valley(floor, a, start) for a in angles]
    return (
        Sheet("slow_turn_equations", equations),
        summary("slow_turn_plant", swing()),
        Sheet("slow_turn_landscape", landscape),
    )


def _landscape(axes: Axes, equations: Sheet, _: Sheet, land: Sheet) -> None:
    for lean, look in ordered(ANTISYMMETRIC_ANGLES):
        angle, v = land[f"angle at {lean} deg"], land[f"V at {lean} deg"]
        axes.plot(angle, v, **look, label=f"lean {lean}°")
    axes.plot(equations["angle"], equations["V"], color=INK, lw=2.0, label="slow turn")


def _both(name: str, axes: Axes, equations: Sheet, plant: Sheet, _: Sheet) -> None:
    axes.plot(
        plant["angle"], plant[name], color=KINDS[1], lw=3.0, alpha=0.6, label="simulated hand"
    )
    axes.plot(equations["angle"], equations[name], color=INK, lw=1.0, label="equations")


_ANGLE = "object's angle φ [deg]"
PAGES = {
    "slow_turn": FigurePage(
        "A slow turn on the energy landscape: Sec. V's quasi-static manipulation",
        (8.4, 6.6),
        slow_turn,
        (
            Panel(_landscape, _ANGLE, "V [mJ]", "(a) the valley of the turn", None, (-0.3, 9.0),
                  {"loc": "upper center", "ncols": 3}),
            Panel(partial(_both, "lean"), _ANGLE, "(q1 − q2)/2 [deg]", "(b) the fingers' lean",
                  legend="upper left"),
            Panel(partial(_both, "energy of both tips"), _ANGLE, "ΣU [mJ]", "(c) energy"),
            Panel(partial(_both, "shear force"), _ANGLE, "T [N]", "(d) shear force, left"),
        ),
        rows=2,
        notes=(
            "The paper's springs, stuck to an object of 40 mm, 10 N; no other friction. V: "
            "energy of both tips minus the work of equal joint torques; lines end where a tip "
            "would slip.",
        ),
    )
}  # fmt: skip
