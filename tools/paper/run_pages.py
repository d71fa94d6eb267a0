"""Reproduce Figs. 7, 8 and 10 with the daemon's simulated hand, estimator and contact table.

Each run returns true and estimated values, one row per frame. The figures show the model, the
estimates and their errors. Like the paper's sensor, the simulated sensor has 44 × 44 cells on a 58
mm square and takes 40 ms per scan. The noise of each cell is 0.5 % of the modulus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.types import Contact
from softfinger.tools.benchmarks.rigs import Sections, merged
from softfinger.tools.paper.model_pages import DEPTHS, FORCE, MILLI, MODULUS, TILTS
from softfinger.tools.paper.sheets import (
    DEPTH,
    DOT,
    RELATIVE,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
    summary,
)
from softfinger.tools.style import GREY, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = tuple[tuple[float, float], tuple[float, ...]]  # true (d, θ), then estimates

RADIUS = 0.020  # m
SCAN = 0.040  # s
TILTED = math.radians(11.5)  # rotation of the finger about its root [rad]
ROLLED = math.radians(20.7)  # rotation of the object while it rolls back [rad]
_NOISE = 0.005 * MODULUS  # Pa
_SPEED = 0.002  # compression speed [m/s]
_GAP = 0.5e-3  # gap before compression [m]
_D_MAX = 0.4 * RADIUS
_ROOT_DEPTH = 0.004  # displacement after the finger rotation [m]
_MOTION_MARGIN = math.radians(3.0)
_WIDTH = 0.040
_HALF_SEPARATION = 0.050
_ROLL_STEPS = 104  # number of frames during rolling
_LATE_FRAME_COUNT = 2  # number of frames still in transit when the motion ends
_RELATIVE_D_MIN = 1.0  # displacement above which errors are shown [mm]
_ROLLED_AT = 4  # displacement in the panels that show the whole path [mm]
_PATH = -12.5, 10.5
_SCALES = {"d": 1e3, "theta": 1.0}  # factors for displayed errors
# Settings for an object that `roll` moves over a fixed finger.
ROLLING: Sections = {
    "servos": {"backend": "none"},
    "hand": {"open_angle": (TILTED, 0.0)},
    "simulation": {"compression_speed": 0.0},
}


def run_compression(tilt: float) -> dict[str, FloatArray]:
    """Press an object face tilted by ``tilt`` [rad] onto the tip until d is 8 mm."""
    x = -_HALF_SEPARATION + (RADIUS + 0.5 * _WIDTH + _GAP) / math.cos(tilt)
    sections: Sections = {
        "servos": {"backend": "none"},
        "simulation": {
            "object_position": (x, 0.080),
            "object_angle": tilt,
            "compression_speed": _SPEED,
        },
    }
    seconds = (_D_MAX + _GAP) / math.cos(tilt) / _SPEED
    with Daemon(settings_of(sections), wire=False) as daemon:
        return _columns(_frames(daemon, round(seconds / SCAN)), daemon)


def run_rotation() -> dict[str, FloatArray]:
    """Rotate the finger by 11.5° about its joint axis, from first touch, against a fixed object.

    The tip's distance from the axis is chosen so that d reaches 4 mm. The servo moves the joint.
    Between frames, d and θ are predicted from the joint angle.
    """
    length = _ROOT_DEPTH / math.sin(TILTED)
    sections: Sections = {
        "hand": {"finger_length": length},
        "control": {"move_speed": 0.05},
        "simulation": {"object_position": (-_HALF_SEPARATION + RADIUS + 0.5 * _WIDTH, length)},
    }
    with Daemon(settings_of(sections), wire=False) as daemon:
        loop = daemon.loop
        loop.advance(0.3)
        loop.command({"command": "arm"})
        # The servo yields under load, so command a larger angle.
        loop.command({"command": "move", "left": TILTED + _MOTION_MARGIN})
        assert daemon.hand is not None
        rows: list[Row] = []
        while loop.state.mode == "moving" or not rows:
            loop.advance(0.5 * SCAN)
            truth = float(daemon.hand.d[0]), float(daemon.hand.theta[0])
            if truth[1] > TILTED:
                break
            rows.append((truth, _estimates(loop.state.contacts[0])))
        return _columns(rows, daemon, sign=-1.0)


def run_rolling(depth: int) -> dict[str, FloatArray]:
    """Roll the object over the fixed finger from 11.5° to −9.2° at constant ``depth`` [mm]."""

    def place(hand: SimulatedHand, fraction: float) -> None:
        roll(hand, depth * MILLI, -ROLLED * fraction)

    with Daemon(settings_of(ROLLING), wire=False) as daemon:
        rows = _frames(daemon, _ROLL_STEPS, place)
        return _columns(rows, daemon, f" at {depth} mm", -1.0)


def settings_of(sections: Sections) -> Settings:
    """Return settings for the left finger and the paper's tip and sensor."""
    base: Sections = {
        "scene": {"fingers": ("left",)},
        "tip": {"radius": RADIUS},
        "material": {"law": "constant", "modulus": MODULUS},
        # The sensor is calibrated, so the estimator attributes excess pressure to the tip's
        # stiffness.
        "tactile": {"rate": 1.0 / SCAN, "latency": SCAN, "noise": _NOISE, "gain_error": 1e-3},
        "loop": {"clock": "virtual"},
        "simulation": {
            "tactile_delay": SCAN,
            "tactile_noise": _NOISE,
            "object_height": 0.2,
        },
    }
    return Settings.model_validate(merged(sections, base))


def _frames(
    daemon: Daemon, count: int, place: Callable[[SimulatedHand, float], None] | None = None
) -> Iterator[Row]:
    """Yield each frame's true state at the scan time, and the estimate from this frame alone."""
    hand, loop = daemon.hand, daemon.loop
    assert hand is not None
    if place is not None:
        place(hand, 0.0)
        loop.advance(3.0 * SCAN)  # Wait until all older frames have arrived.
    last = loop.state.contacts[0].seq
    for k in range(count + _LATE_FRAME_COUNT):
        if place is not None:
            place(hand, min(k / (count - 1), 1.0))
        loop.advance(SCAN)
        contact = loop.state.contacts[0]
        if contact.seq == last:
            continue
        last = contact.seq
        sample = hand.sample(contact.seq - 1)
        assert sample is not None
        truth = float(sample.d[0]), float(sample.theta[0])
        yield truth, _estimates(contact)


def _estimates(contact: Contact) -> tuple[float, ...]:
    if not contact.contact:
        return 0.0, math.nan, 0.0, 0.0
    return contact.d, contact.theta, contact.force, contact.energy


def _columns(
    rows: Iterable[Row], daemon: Daemon, suffix: str = "", sign: float = 1.0
) -> dict[str, FloatArray]:
    """Return true and estimated values per frame; ``sign`` is the paper's sign of θ."""
    truth, estimates = (np.array(each) for each in zip(*rows, strict=True))
    d, theta = np.maximum(truth[:, 0], 0.0), truth[:, 1]
    contact = daemon.models[0].table(d, theta)
    columns = {}
    for name, unit, factor, true, found in zip(
        ("d", "theta", "F", "U"), ("mm", "deg", "N", "mJ"), (1e3, math.degrees(sign), 1.0, 1e3),
        (d, theta, contact.force, contact.energy), estimates.T, strict=True,
    ):  # fmt: skip
        columns[f"{name}{suffix} [{unit}]"] = factor * true
        columns[f"{name} estimated{suffix} [{unit}]"] = factor * found
    return columns


def roll(hand: SimulatedHand, d: float, angle: float, rolling: float = 1.0) -> None:
    """Place the object as if it had rolled to ``angle`` [rad] at constant ``d`` [m].

    The fraction ``rolling`` of the face motion is pure rolling; the remainder shears the tip.
    """
    q = float(hand.q[0])
    parameters = hand.plant.parameters
    length = parameters.length
    tip = -_HALF_SEPARATION + length * math.sin(q), length * math.cos(q)
    out = RADIUS + 0.5 * _WIDTH - d
    along = rolling * (RADIUS - d) * angle  # tip position along the face [m]
    parameters.script_x = tip[0] + out * math.cos(angle) + along * math.sin(angle)
    hand.object_pose[:] = (
        parameters.script_x,
        tip[1] + out * math.sin(angle) - along * math.cos(angle),
        angle,
    )
    hand.refresh()


def _rms(off: FloatArray) -> float:
    return float(np.sqrt(np.mean(off**2)))


@cache
def compression() -> tuple[Sheet, ...]:
    """Return one sheet per angle, and one sheet of errors for displacements above 1 mm."""
    sheets, rows = [], []
    for tilt in TILTS:
        run = Sheet(f"fig7_run_{tilt}deg", run_compression(float(np.radians(tilt))))
        sheets.append(run)
        force, energy = (_deep_errors(run, symbol) for symbol in "FU")
        rows.append({
            "tilt [deg]": tilt,
            "d at the first estimate [mm]": run["d"][run["d estimated"] > 0.0][0],
            "RMS error of d [um]": _rms(_deep_errors(run, "d")),
            "RMS error of theta [deg]": _rms(_deep_errors(run, "theta")),
            "mean error of F [%]": force.mean(),
            "RMS error of F [%]": _rms(force),
            "RMS error of U [%]": _rms(energy),
        })  # fmt: skip
    return (*sheets, summary("fig7_run_errors", rows))


def _deep_errors(run: Sheet, symbol: str) -> FloatArray:
    """Return the errors for d > 1 mm, in µm (d), degrees (θ) or % (force and energy)."""
    deep = run["d"] > _RELATIVE_D_MIN
    truth, found = run[symbol][deep], run[f"{symbol} estimated"][deep]
    relative = symbol in ("F", "U")
    return np.asarray(
        100.0 * (found / truth - 1.0) if relative else _SCALES[symbol] * (found - truth)
    )


def _forces(axes: Axes, *sheets: Sheet) -> None:
    for (tilt, style), run in zip(ordered(TILTS), sheets, strict=False):
        axes.plot(run["d"], run["F"], **style, label=f"{tilt}°")
        axes.plot(run["d estimated"][::6], run["F estimated"][::6], **DOT)
    axes.plot([], [], **DOT, label="estimated from the frames")


def _errors(symbol: str, axes: Axes, *sheets: Sheet) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    for (tilt, style), run in zip(ordered(TILTS), sheets, strict=False):
        d, off = run["d"][run["d"] > _RELATIVE_D_MIN], _deep_errors(run, symbol)
        axes.plot(d, off, **style | {"linewidth": 0.9}, label=f"{tilt}°")


def _error_panel(symbol: str, title: str, label: str, limit: float) -> Panel:
    legend = {"loc": "lower right", "ncols": 4, "title": "tilt"}
    ends = (0, 8), (-1.3 * limit, limit)
    return Panel(partial(_errors, symbol), DEPTH, label, title, *ends, legend)


@cache
def tilt_and_roll() -> tuple[Sheet, ...]:
    """Return the sheets for the rotation, the rolling, and the minima of F and U."""
    columns: dict[str, FloatArray] = {}
    for depth in DEPTHS:
        columns |= run_rolling(depth)
    rolling, minima = Sheet("fig10_run_rolling", columns), []
    for depth in DEPTHS:
        row: dict[str, float] = {"d [mm]": depth}
        true, found = (
            {each: rolling[f"{each}{of} at {depth} mm"] for each in ("theta", "F", "U")}
            for of in ("", " estimated")
        )
        for each in "FU":
            least, error = _minimum(true["theta"], found[each])
            row[f"angle of the least {each} estimated [deg]"] = least
            row[f"its standard error, {each} [deg]"] = error
        for each in "FU":
            row[f"RMS error of {each} [%]"] = 100.0 * _rms(found[each] / true[each] - 1.0)
        row["RMS error of theta [deg]"] = _rms(found["theta"] - true["theta"])
        minima.append(row)
    rotation = Sheet("fig10_run_rotation", run_rotation())
    return rotation, rolling, summary("fig10_run_minimum", minima)


def _minimum(theta: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Fit a parabola in θ; return the angle of its minimum, and the standard error.

    Without noise, F and U are parabolas in θ to within 0.1 %. The standard error is computed from
    the fit residuals and matches the scatter of runs with ten seeds.
    """
    (a, b, _), covariance = np.polyfit(theta, values, 2, cov=True)
    slope = np.array([0.5 * b / a**2, -0.5 / a, 0.0])
    return float(-0.5 * b / a), float(np.sqrt(slope @ covariance @ slope))


def _along(symbol: str, axes: Axes, rotation: Sheet, rolling: Sheet, _: Sheet) -> None:
    """Draw the rotation and the subsequent rolling at d = 4 mm."""
    for piece, at, color, name in (
        (rotation, "", KINDS[1], "the finger rotates"),
        (rolling, f" at {_ROLLED_AT} mm", KINDS[0], "then the object rolls"),
    ):
        axes.plot(piece[f"theta{at}"], piece[f"{symbol}{at}"], color=color, label=name)
        theta, found = piece[f"theta estimated{at}"], piece[f"{symbol} estimated{at}"]
        axes.plot(theta[::4], found[::4], **DOT, label="estimated" if at else "")


def _over_upright(axes: Axes, _: Sheet, rolling: Sheet, minima: Sheet) -> None:
    angles, errors = minima["angle of the least U estimated"], minima["its standard error, U"]
    for (depth, style), angle, error in zip(ordered(DEPTHS), angles, errors, strict=True):
        theta, model = rolling[f"theta at {depth} mm"], rolling[f"U at {depth} mm"]
        level = float(np.interp(0.0, theta, model))
        found = rolling[f"U estimated at {depth} mm"]
        label = f"{depth} mm: minimum at {angle:.2f}° ± {error:.2f}°".replace("-", "−")
        axes.plot(theta, found / level, **style | {"linewidth": 0.9}, label=label)
        axes.plot(theta, model / level, color=GREY, linewidth=0.7)


def _angle_errors(axes: Axes, _: Sheet, rolling: Sheet, minima: Sheet) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    for depth, style in ordered(DEPTHS):
        theta = rolling[f"theta at {depth} mm"]
        off = rolling[f"theta estimated at {depth} mm"] - theta
        axes.plot(theta, off, **style | {"linewidth": 0.9}, label=f"d = {depth} mm")


PAGES = {
    "fig7_run": FigurePage(
        "Fig. 7 run in simulation: compression to 8 mm, through sensor and estimator",
        (7.6, 6.2),
        compression,
        (
            Panel(_forces, DEPTH, FORCE.axis, "(a) force", (0, 8.2), (0, 78), "upper left"),
            _error_panel("F", "(b) force error", "estimate over model − 1 [%]", 5.0),
            _error_panel("d", "(c) displacement error", "estimate − truth [µm]", 75.0),
            _error_panel("theta", "(d) angle error", "estimate − truth [deg]", 0.5),
        ),
        rows=2,
        notes=(
            "The plant presses the object on the tip at 2 mm/s; 44 × 44 cells on 58 mm, 25 "
            "frames per second, noise of 0.5 % of E in each cell. Errors are shown from 1 mm on. "
            "Each point is the estimate from one frame. Plant and estimator use the same model, so "
            "the paper's constant offset, which comes from the material, does not appear.",
        ),
    ),
    "fig10_run": FigurePage(
        "Figs. 8 to 10 run in simulation: the finger rotates 11.5°, the object rolls 20.7°",
        (7.6, 6.2),
        tilt_and_roll,
        (
            Panel(partial(_along, "F"), RELATIVE, FORCE.axis, "(a) force along the path", _PATH),
            Panel(partial(_along, "U"), RELATIVE, "elastic energy U [mJ]",
                  "(b) energy along the path", _PATH, None, "lower right"),
            Panel(_over_upright, RELATIVE, "U(θ)/U(0)", "(c) energy while rolling, over U(0)",
                  _PATH, (0.86, 1.085), "lower center"),
            Panel(_angle_errors, RELATIVE, "estimate − truth [deg]",
                  "(d) angle error while rolling", _PATH, None,
                  {"loc": "lower right", "ncols": 2}),
        ),
        rows=2,
        notes=(
            "Angles have the paper's sign. Rotation: the servo turns the finger about a root "
            "20.1 mm from the tip's centre, so d increases from 0 to 4 mm; between frames, the "
            "daemon extrapolates its estimates from the joint motion. Rolling: d is constant, and "
            "each estimate uses one frame. Grey: model. The minimum is the minimum of a parabola "
            "fitted to the estimates, ± its standard error.",
        ),
    ),
}  # fmt: skip
