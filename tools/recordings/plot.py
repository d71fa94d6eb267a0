"""Run ``softfinger plot FILE.mcap``: plot a recording versus time, and compare it with the model.

The model uses the recorded settings and calibrations. Force and energy are taken from the recorded
states, and include the modulus factor that was estimated during grips.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError, SettingsError, TactileError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.tools import style
from softfinger.tools.arguments import add_range, range_text, to_stderr
from softfinger.tools.extras import require
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recorded_models
from softfinger.tools.sweep import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from softfinger.daemon.perception.finger_model import FingerModel
    from softfinger.kinematics.contact.table import ContactTable

_EPILOG = """\
pages:
  time       force, object angle, displacement and tilt versus time, with the goals
  angle      force and energy versus θ, with the model's curves
  landscape  the path on the energy landscape U(d, θ), with its local minimum

Requires the extra 'plot'. To plot other fields over time, open the file in Foxglove or
PlotJuggler."""


FloatArray = NDArray[np.float64]

DEGREES = 180.0 / np.pi
LINES: dict[str, dict[str, Any]] = {
    "left": {"color": style.KINDS[0], "linestyle": "-"},
    "right": {"color": style.KINDS[1], "linestyle": (0, (5, 1.5))},
}
_POINTS = 700  # maximum number of points per finger and panel; more points would overlap
# Axis label, scale factor, field of the value, and field of the goal.
_AGAINST_TIME = (
    ("force F [N]", 1.0, "force", "goal_force"),
    ("object angle [°]", DEGREES, "angle", "goal_angle"),
    ("displacement d [mm]", 1e3, "d", ""),
    ("tilt θ [°]", DEGREES, "theta", ""),
)
_CURVES = 5
_GRID = 241  # number of landscape nodes per axis


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: FILE.plots)"
    )
    parser.add_argument(
        "--format",
        nargs="+",
        choices=("png", "svg", "pdf"),
        default=["png"],
        help="format of the files (default: png)",
    )
    add_range(parser)


def run(arguments: argparse.Namespace) -> int:
    """Plot a recording. Raises RecordingError, MissingExtra or OSError."""
    require("plot")  # Report a missing package before reading a long recording.
    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".plots")
    # Before loading the kernels, reject files that are not recordings.
    recording = Recording(path, to_stderr("plot"))
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.processes.compile import build_kernels, print_event

    build_kernels(Settings(), print_event, FRAMES)
    with Progress("plot", recording.size) as progress:
        states = recording.states(arguments.start, arguments.end, progress)
    data = RecordedRun(recording, states, range_text(arguments))
    folder.mkdir(parents=True, exist_ok=True)
    with style.settings():
        for name, draw in PAGES.items():
            figure = draw(data)
            for suffix in arguments.format:
                style.save(figure, folder / f"{name}.{suffix}")
                print(folder / f"{name}.{suffix}")
    return 0


@dataclass(frozen=True)
class RecordedRun:
    """All or part of a recording; ``states`` contains the arrays of `Recording.states`.

    ``where`` names the selected part in error messages.
    """

    recording: Recording
    states: dict[str, NDArray[Any]]
    where: str = ""

    def lacks(self, what: str) -> RecordingError:
        """Return the error that the recording does not contain ``what``."""
        path = self.recording.path
        return RecordingError(f"{path}: the recording does not contain {what}{self.where}")

    @property
    def t(self) -> FloatArray:
        """Time of each state since the recording's first message [s]."""
        return self.states["t"]

    @cached_property
    def fingers(self) -> tuple[str, ...]:
        """Recorded fingers."""
        return tuple(name for name in FINGERS if self.states[f"{name}.valid"].any())

    def touching(self, finger: str) -> NDArray[np.bool_]:
        """Return a mask of the states in which the finger has a valid contact."""
        of = {name: self.states[f"{finger}.{name}"] for name in ("valid", "contact", "d")}
        return np.asarray(of["valid"] & of["contact"] & np.isfinite(of["d"]))

    @cached_property
    def models(self) -> tuple[FingerModel, FingerModel]:
        """Finger models of the recorded settings. Raises RecordingError."""
        try:
            return recorded_models(self.recording)
        except (SettingsError, TactileError, ValueError) as error:
            raise RecordingError(
                f"{self.recording.path}: can't build the contact model from the recorded "
                f"settings: {error}"
            ) from None

    def contacts(self) -> dict[str, ContactTable]:
        """Return the table of each touching finger. Raises RecordingError if there is none."""
        if not self.t.size:
            raise self.lacks("hand/state")
        touched = [name for name in self.fingers if self.touching(name).any()]
        if not touched:
            raise self.lacks("a contact")
        return {name: self.models[FINGERS.index(name)].table for name in touched}


def _titled(figure: Figure, run: RecordedRun, text: str) -> None:
    """Add a title with the recording's name and ``text``."""
    figure.suptitle(f"{run.recording.path.name}: {text}", x=0.01, ha="left", fontsize=9.0)


def draw_time(run: RecordedRun) -> Figure:
    """Plot each tip's force, displacement and tilt, and the object's angle, versus time.

    The bands show one standard deviation, and the grey lines show the goals.
    """
    if not run.t.size:
        raise run.lacks("hand/state")
    figure = style.new_figure(7.2, 8.0)
    panels = figure.subplots(len(_AGAINST_TIME), 1, sharex=True)
    for panel, (label, factor, field, goal) in zip(panels, _AGAINST_TIME, strict=True):
        names = [f"{finger}.{field}" for finger in run.fingers]
        if field == "angle":
            names = ["object.angle"]
        for name in names:
            look = LINES.get(name.partition(".")[0], {"color": style.KINDS[2]})
            value, spread = (
                factor * run.states.get(key, np.zeros(len(run.t))) for key in (name, f"{name}_std")
            )
            panel.plot(run.t, value, label=name.partition(".")[0], **look)
            band = {"color": look["color"], "alpha": 0.2, "linewidth": 0.0}
            panel.fill_between(run.t, value - spread, value + spread, **band)
        if goal:
            panel.plot(run.t, factor * run.states[goal], color=style.GREY, label="goal", zorder=1)
        panel.set_ylabel(label)
        panel.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)
    panels[-1].set_xlabel("time [s]")
    _titled(figure, run, "force, angle and displacement versus time")
    return figure


def draw_angle(run: RecordedRun) -> Figure:
    """Plot F, U and the gain versus θ, with model curves of F and U at constant d."""
    tables = run.contacts()
    rows = len(tables)
    figure = style.new_figure(7.2, 1.9 + 3.0 * rows)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[*[1.0] * rows, 0.5])
    gain = figure.add_subplot(grid[rows, :])
    gains = []
    for row, (name, table) in enumerate(tables.items()):
        at = np.flatnonzero(run.touching(name))
        if at.size > _POINTS:
            at = at[np.linspace(0, at.size - 1, _POINTS).astype(np.intp)]
        seen = {each: run.states[f"{name}.{each}"][at]
                for each in ("d", "theta", "force", "energy", "gain")}  # fmt: skip
        for column, (field, label, factor) in enumerate(
            (("force", "force F [N]", 1.0), ("energy", "energy U [mJ]", 1e3))
        ):
            panel = figure.add_subplot(grid[row, column])
            mesh = _against_angle(panel, seen, table, field, factor)
            panel.set(ylabel=label, xlabel="θ [°]", title=f"{name} finger")
        bar = figure.colorbar(mesh, ax=figure.axes[-2:], shrink=0.9)
        bar.set_label("displacement d [mm]")
        look = {"marker": ".", "linestyle": "none", "color": LINES[name]["color"], "alpha": 0.6}
        gain.plot(seen["theta"] * DEGREES, seen["gain"], **look, label=name)
        gains.append(seen["gain"])
    gain.axhline(1.0, color=style.INK, linewidth=0.8)
    gain.set(xlabel="θ [°]", ylabel="measured over\nmodelled pressure")
    reach = max(1.6 * float(np.quantile(np.abs(np.concatenate(gains) - 1.0), 0.98)), 0.01)
    gain.set_ylim(1.0 - reach, 1.0 + reach)
    gain.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.1)
    _titled(figure, run, "force and energy versus θ")
    return figure


def _against_angle(
    panel: Axes, seen: dict[str, FloatArray], table: ContactTable, field: str, factor: float
) -> Any:
    """Draw model curves and recorded points; return the points for the colour bar."""
    from matplotlib.colors import Normalize

    depths = _depths(seen["d"])
    widest = max(1.1 * float(np.abs(seen["theta"]).max()), 5.0 / DEGREES)
    # Omit the yellow end of the colour map, which is too faint in print.
    scale = Normalize(0.0, depths[-1] * 1e3 / 0.85)
    for depth in depths:
        limit = float(table.tip.theta_limit(depth))
        tilt = np.linspace(-min(widest, limit), min(widest, limit), 181)
        curve = getattr(table(depth, tilt), field) * factor
        panel.plot(tilt * DEGREES, curve, color=style.GREY, linewidth=0.9, zorder=1)
        panel.annotate(f"{depth * 1e3:g} mm", (tilt[-1] * DEGREES, curve[-1]), fontsize=7)
    points = panel.scatter(
        seen["theta"] * DEGREES, seen[field] * factor, c=seen["d"] * 1e3, cmap="viridis",
        norm=scale, s=9, linewidths=0.0, zorder=2, rasterized=True, label="recorded",
    )  # fmt: skip
    panel.plot([], [], color=style.GREY, linewidth=0.9, label="model at a fixed d")
    panel.set_ylim(bottom=0.0)
    panel.set_ylim(top=panel.get_ylim()[1] * 1.12)
    panel.margins(x=0.02)
    panel.legend(loc="upper left", ncols=3, columnspacing=1.0, handletextpad=0.4)
    return points


def _depths(d: FloatArray) -> FloatArray:
    """Return round values of the displacement [m] that span the measured range."""
    from matplotlib.ticker import MaxNLocator

    largest = max(float(np.quantile(d, 0.995)), 2e-4) * 1e3
    return np.asarray(MaxNLocator(_CURVES).tick_values(0.0, largest)[1:]) * 1e-3


def draw_landscape(run: RecordedRun) -> Figure:
    """Draw each tip's path on a map of U(d, θ), and plot U(d, θ) − U(d, 0) versus time."""
    tables = run.contacts()
    figure = style.new_figure(7.0, 2.2 + 4.0 * len(tables))
    panels = figure.subplots(len(tables) + 1, 1, height_ratios=[*[1.0] * len(tables), 0.4])
    above = panels[-1]
    for panel, (name, table) in zip(panels, tables.items(), strict=False):
        touching = run.touching(name)
        d, theta = (
            np.where(touching, run.states[f"{name}.{each}"], np.nan) for each in ("d", "theta")
        )
        widest = max(1.15 * float(np.nanmax(np.abs(theta))), 10.0 / DEGREES)
        draw_map(panel, table, 1.15 * float(np.nanmax(d)), widest)
        panel.plot(theta * DEGREES, d * 1e3, label=f"{name} finger", **LINES[name])
        first, last = np.flatnonzero(touching)[[0, -1]]
        for at, marker, label in ((first, "^", "begins"), (last, "s", "ends")):
            look = {"color": LINES[name]["color"], "markersize": 5, "markeredgecolor": "white"}
            look |= {"linestyle": "none", "clip_on": False, "zorder": 4}
            panel.plot(theta[at] * DEGREES, d[at] * 1e3, marker, **look, label=label)
        over = table(d, theta, edge=True).energy - table(d, 0.0, edge=True).energy
        over = np.where(np.isfinite(d), over * 1e3, np.nan)
        above.plot(run.t, over, label=name, **LINES[name])
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, borderaxespad=0.1)
    above.axhline(0.0, color=style.GREY, linewidth=0.6)
    above.set_ylabel("U(d, θ) − U(d, 0) [mJ]")
    above.set_xlabel("time [s]")
    _titled(figure, run, "path on the energy landscape")
    return figure


def draw_map(panel: Axes, table: ContactTable, deepest: float, widest: float) -> None:
    """Draw U(d, θ) [mJ] for d ≤ ``deepest`` [m] and |θ| ≤ ``widest`` [rad].

    The minimum of U over θ is also drawn.
    """
    from matplotlib.colors import PowerNorm

    d = np.linspace(0.0, deepest, _GRID)[1:]
    theta = np.linspace(-widest, widest, _GRID)
    contact = table(d[:, None], theta[None, :], edge=True)
    energy = np.ma.masked_where(~contact.inside, contact.energy * 1e3)
    largest = float(energy.max())
    round_ones = {float(f"{largest * (k / 8.0) ** 2:.2g}") for k in range(8)}
    levels = np.array([*sorted(round_ones), largest])
    panel.contourf(
        theta * DEGREES,
        d * 1e3,
        energy,
        levels,
        cmap="Greys",
        norm=PowerNorm(0.5, 0.0, 2.2 * largest),
    )
    lines = panel.contour(
        theta * DEGREES, d * 1e3, energy, levels[1:-1], colors=style.GREY, linewidths=0.5
    )
    # Labels at higher levels would extend beyond the axes.
    low = [level for level in levels[1:-1] if level < 0.65 * largest]
    panel.clabel(lines, low, fmt=lambda level: f"{level:.3g} mJ", fontsize=6.5)
    minima = theta[np.argmin(energy, axis=1)]
    # The energy of a bonded solid tip decreases with |θ|, so there is no local minimum.
    local = np.abs(minima) < 0.99 * widest
    if local.any():
        panel.plot(
            np.where(local, minima, np.nan) * DEGREES,
            d * 1e3,
            color=style.INK,
            linestyle=(0, (1, 1.2)),
            label="local minimum over θ",
        )
    panel.set(xlabel="θ [°]", ylabel="displacement d [mm]")
    panel.set_xlim(-widest * DEGREES, widest * DEGREES)
    panel.set_ylim(0.0, deepest * 1e3)
    panel.grid(visible=False)


PAGES = {"time": draw_time, "angle": draw_angle, "landscape": draw_landscape}
