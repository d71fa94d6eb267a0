"""Draw two figures for tips whose springs are sheared (sections IV-B and V).

The springs of the parallel distributed model have equal lateral and axial stiffness. The energy and
the force of a tip with the shear ζ are

    U = πE [d³/(3 cos² θ) + d² ζ tan θ + d ζ²]      F = πE [d²/cos θ + 2 d ζ sin θ]

F is the sum of the spring forces on the base. A sensor under the tip measures this sum.

`sheared_rolling` shows that shear during rolling moves the minima of F and U to θ < 0. The finger
is tilted to −11.5°. From this tilt, the object rolls to 9.2° at constant displacement d. A fraction
s of the face motion shears the tip; the remainder is pure rolling. The shear is

    ζ = s (a − d) (θ − θ₀),    θ₀ = −11.5°

The terms with ζ sin θ and ζ tan θ have the sign of θ, so F and U reach their minima before the
upright position. ∂U/∂d is the force on the face at fixed tilt and shear. The minimum of ∂U/∂d lies
between the minima of F and U. *Plant* is the simulated tip, which integrates the shear. The force
on the plant's base is N cos θ + T sin θ. This force exceeds F by πE ζ² cos θ, because the plant
shears each spring from its first touch at the contact rim.

`slow_turn` computes a quasi-static manipulation, and compares it with the simulated hand. Both tips
stick to the object. The model does not include any other friction. The shear rate is

    ζ̇ = −ṡ + (a − d) θ̇ − ḋ tan θ

i.e. the rolling speed (a − d) θ̇ minus two terms. ṡ is the sliding speed along the face. ḋ tan θ is
the compression speed's component along a tilted face. The quantities s, d and θ are defined in
`kinematics.hand.geometry`; the right tip's θ is mirrored. The object is in equilibrium if Σ δU = 0
for each possible motion. With M = ∂U/∂θ, T = ∂U/∂ζ and N = ∂U/∂d − T tan θ, the condition becomes

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

from softfinger.daemon.simulation.physics.plant_state import ALONG_SHEAR
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.kinematics.hand.geometry import HandGeometry, tip_velocity
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, MODULUS, TIP
from softfinger.tools.paper.run_pages import ROLLED, ROLLING, TILTED, roll, settings_of
from softfinger.tools.paper.sheets import (
    DOT,
    RELATIVE,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
    summary,
)
from softfinger.tools.simulated_daemon import SimulatedDaemon
from softfinger.tools.style import GREY, INK, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Rolling with shear

SHARES = (0.0, 0.02, 0.05, 0.1)  # values of the fraction s in the figure
_EACH = tuple(k / 100.0 for k in range(11))
DEPTH, SHARE = 6, 0.05  # displacement shown in the figure [mm], and fraction s simulated
_ROLL_STEPS = 208
_FORCE, _SLOPE, _ENERGY = "F on the base", "dU/dd", "U"


def rolled(d: float, share: float, theta: FloatArray) -> dict[str, FloatArray]:
    """Return F [N], ∂U/∂d [N] and U [mJ] at tilts ``theta`` [rad] and constant ``d`` [m]."""
    shear = share * (TIP.radius - d) * (theta + TILTED)
    sine, cosine, tangent = np.sin(theta), np.cos(theta), np.tan(theta)
    stiff = math.pi * MODULUS
    return {
        _FORCE: stiff * (d**2 / cosine + 2.0 * d * shear * sine),
        _SLOPE: stiff * (d**2 / cosine**2 + 2.0 * d * shear * tangent + shear**2),
        _ENERGY: 1e3 * stiff * (d**3 / (3.0 * cosine**2) + d**2 * shear * tangent + d * shear**2),
    }


def plant(d: float, share: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Simulate the tip at ``d`` [m]; return θ [rad], N cos θ + T sin θ [N] and U [mJ]."""
    hand = SimulatedHand(settings_of(ROLLING))
    tip = hand.plant.stages[0].on_object[0]
    rows = []
    for k in range(_ROLL_STEPS + 1):
        before, row = hand.object_pose.copy(), tip.rows[ALONG_SHEAR, 2:].copy()
        roll(hand, d, -ROLLED * k / _ROLL_STEPS, 1.0 - share)
        if k:
            row = 0.5 * (row + tip.rows[ALONG_SHEAR, 2:])
            hand.shear[0] += row @ (hand.object_pose - before)
            hand.refresh()
        theta = float(hand.theta[0])
        base = hand.normal[0] * math.cos(theta) + hand.tangential[0] * math.sin(theta)
        rows.append((-theta, base, 1e3 * tip.energy))
    theta, base, energy = np.array(rows).T
    return theta, base, energy


def angle_of_minimum(theta: FloatArray, values: FloatArray) -> float:
    """Return the angle of the minimum [degrees], from a parabola through three points."""
    k = int(np.clip(np.argmin(values), 1, len(values) - 2))
    near = slice(k - 1, k + 2)
    a, b, _ = np.polyfit(theta[near] - theta[k], values[near], 2)
    return math.degrees(theta[k] - 0.5 * b / a)


@cache
def sheared_rolling() -> tuple[Sheet, ...]:
    """Return model and plant curves at one depth, and the minima at all depths."""
    theta = np.linspace(-TILTED, ROLLED - TILTED, _ROLL_STEPS + 1)
    columns = {"theta [deg]": np.degrees(theta)}
    rows = []
    for depth in DEPTHS:
        d = depth * MILLI
        for share in _EACH:
            curves, row = rolled(d, share, theta), {"d [mm]": depth, "share [%]": 100.0 * share}
            for name, each in curves.items():
                row[f"least {name} [deg]"] = angle_of_minimum(theta, each)
            rows.append(row)
            if depth == DEPTH and share in SHARES:
                columns[f"F on the base, {share:.0%} [N]"] = curves[_FORCE]
                columns[f"U, {share:.0%} [mJ]"] = curves[_ENERGY]
    seen = {depth: plant(depth * MILLI, SHARE) for depth in DEPTHS}
    felt = [
        {
            "d [mm]": depth,
            "share [%]": 100.0 * SHARE,
            "least N cos theta + T sin theta [deg]": angle_of_minimum(tilt, base),
            "least U [deg]": angle_of_minimum(tilt, energy),
        }
        for depth, (tilt, base, energy) in seen.items()
    ]
    tilt, base, energy = seen[DEPTH]
    run = {"theta [deg]": np.degrees(tilt), "F on the base [N]": base, "U [mJ]": energy}
    return (
        Sheet("fig10_shear", columns),
        Sheet("fig10_shear_plant", run),
        summary("fig10_shear_minima", rows),
        summary("fig10_shear_plant_minima", felt),
    )


def _curves(name: str, axes: Axes, model: Sheet, run: Sheet, *_: Sheet) -> None:
    theta = model["theta"]
    upright = float(np.interp(0.0, theta, model[f"{name}, 0%"]))
    for share, style in ordered(SHARES):
        ratio = model[f"{name}, {share:.0%}"] / upright
        axes.plot(theta, ratio, **style, label=f"{share:.0%} shear")
        where = angle_of_minimum(np.radians(theta), ratio)
        axes.plot(where, np.interp(where, theta, ratio), "v", ms=6, color=style["color"])
    axes.plot(run["theta"][::13], run[name][::13] / upright, **DOT, label=f"plant, {SHARE:.0%}")


def _minima(axes: Axes, _model: Sheet, _run: Sheet, minima: Sheet, felt: Sheet) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    for depth, style in ordered(DEPTHS):
        rows = minima["d"] == depth
        axes.plot(
            minima["share"][rows], minima[f"least {_ENERGY}"][rows], **style, label=f"{depth} mm"
        )
    axes.plot(felt["share"], felt["least U"], **DOT, label="plant")


# A slow turn

FORCE, WIDTH = 10.0, 0.040  # force on the base of each tip [N], and object width [m]
REACH = math.radians(8.0)  # maximum object angle in each direction [rad]
ANTISYMMETRIC_ANGLES = (-4, -2, 0, 2, 4)  # degrees
_SWING_TIME = 4.0  # duration of a swing from 0 to REACH [s]
_SIDE_ANGLES = np.radians(np.linspace(-2.5, 2.5, 41))
_TURN_STEPS = 64
_FRICTION = 0.6
_SIDES = np.array([1.0, -1.0])
_HAND = HandGeometry()
_GRIP = 3.0  # s


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
        push = tangential.sum() * np.array(along) - (_SIDES * normal) @ np.outer([1, 1], across)
        rolls = moment + tangential * (_HAND.tip_radius - self.d)
        turns = normal * _SIDES * (tips @ along) + tangential * (tips @ across) + _SIDES * rolls
        force = math.pi * MODULUS * self.d**2 / np.cos(self.theta)
        return np.array([*push, turns.sum() / WIDTH, force.mean() - FORCE])


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
        "simulation": {"table_friction": 0.0, "joint_friction": 0.0},
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
            rows.append({
                "t [s]": t,
                "angle [deg]": math.degrees(found.pose[2]),
                "lean [deg]": math.degrees(0.5 * (found.q[0] - found.q[1])),
                "energy of both tips [mJ]": 1e3 * energy,
                "shear force [N]": sheared[0] * scale,
            })  # fmt: skip
    return rows


def _triangle(turns: float) -> float:
    """Return a triangle wave with period 4 and amplitude 1, rising from 0 at ``turns`` = 0."""
    return 1.0 - abs((turns + 1.0) % 4.0 - 2.0)


@cache
def slow_turn() -> tuple[Sheet, ...]:
    """Return three sheets: the computed path, the plant's path, and V versus the object angle."""
    there = np.linspace(0.0, REACH, _TURN_STEPS + 1)[1:]
    back = np.r_[there[-2::-1], -np.linspace(0.0, REACH, _TURN_STEPS + 1)]
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
    "fig10_shear": FigurePage(
        "Sec. IV-B: the minimum slightly before 0°, from the tip's tangential force",
        (9.6, 4.0),
        sheared_rolling,
        (
            Panel(partial(_curves, _FORCE), RELATIVE, "F(θ)/F(0) without shear",
                  f"(a) force on the base, d = {DEPTH} mm", None, (0.99, 1.07), "upper center"),
            Panel(partial(_curves, _ENERGY), RELATIVE, "U(θ)/U(0) without shear",
                  f"(b) energy, d = {DEPTH} mm", None, (0.98, 1.14), "upper center"),
            Panel(_minima, "share of shear in the motion [%]", "angle of the minimum of U [deg]",
                  "(c) angle of the minimum of U", None, None, "lower left"),
        ),
        notes=(
            "The object rolls from −11.5° to 9.2° at a fixed d. The share s of the motion that "
            "is not rolling shears the tip by s (a − d)(θ + 11.5°). The paper attributes the "
            "shift to lateral springs; these springs, as stiff across their axes as along them, "
            "reproduce it.",
        ),
    ),
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
