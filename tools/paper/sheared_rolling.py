"""Show that shear during rolling moves the minima of F and U to θ < 0 (section IV-B).

The finger is tilted to −11.5°. From this tilt, the object rolls to 9.2° at constant displacement d.
A fraction s of the face motion shears the tip; the remainder is pure rolling. The shear is

    ζ = s (a − d) (θ − θ₀),    θ₀ = −11.5°

The springs of the parallel distributed model have equal lateral and axial stiffness. The energy and
the force are

    U = πE [d³/(3 cos² θ) + d² ζ tan θ + d ζ²]      F = πE [d²/cos θ + 2 d ζ sin θ]

F is the sum of the spring forces on the base. A sensor under the tip measures this sum. The terms
with ζ sin θ and ζ tan θ have the sign of θ, so F and U reach their minima before the upright
position. ∂U/∂d is the force on the face at fixed tilt and shear. The minimum of ∂U/∂d lies between
the minima of F and U.

In the figures, *plant* is the simulated tip, which integrates the shear. The force on the plant's
base is N cos θ + T sin θ. This force exceeds F by πE ζ² cos θ, because the plant shears each spring
from its first touch at the contact rim.
"""

from __future__ import annotations

import math
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.plant_state import ALONG_SHEAR
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, MODULUS, TIP
from softfinger.tools.paper.run_pages import ROLLED, TILTED, roll
from softfinger.tools.paper.sheets import (
    DOT,
    RELATIVE,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
    summary,
)
from softfinger.tools.style import GREY, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHARES = (0.0, 0.02, 0.05, 0.1)  # values of the fraction s in the figure
_EACH = tuple(k / 100.0 for k in range(11))
DEPTH, SHARE = 6, 0.05  # displacement shown in the figure [mm], and fraction s simulated
_STEPS = 208
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
    settings = Settings.model_validate(
        {
            "scene": {"fingers": ("left",)},
            "servos": {"backend": "none"},
            "hand": {"open_angle": (TILTED, 0.0)},
            "tip": {"radius": TIP.radius},
            "material": {"law": "constant", "modulus": MODULUS},
            "simulation": {"object_height": 0.2, "compression_speed": 0.0},
        }
    )
    hand = SimulatedHand(settings)
    tip = hand.plant.stages[0].on_object[0]
    rows = []
    for k in range(_STEPS + 1):
        before, row = hand.object_pose.copy(), tip.rows[ALONG_SHEAR, 1:].copy()
        roll(hand, d, -ROLLED * k / _STEPS, 1.0 - share)
        if k:
            row = 0.5 * (row + tip.rows[ALONG_SHEAR, 1:])
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
    theta = np.linspace(-TILTED, ROLLED - TILTED, _STEPS + 1)
    columns = {"theta [deg]": np.degrees(theta)}
    rows = []
    for depth in DEPTHS:
        d = depth * MILLI
        for share in _EACH:
            curves = rolled(d, share, theta)
            angles = {
                f"least {name} [deg]": angle_of_minimum(theta, each)
                for name, each in curves.items()
            }
            rows.append({"d [mm]": depth, "share [%]": 100.0 * share, **angles})
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
}  # fmt: skip
