"""Pages of estimates beside the contact model, over θ and on the energy landscape, and of errors.

The model is that of the recording's own settings and calibrations; force and energy are those of
the state: the model times the scale of the tip's modulus that grips have found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.finger_model import FingerModel
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools import style
from softfinger.tools.analysis.plots_data import BoolArray, FloatArray, Missing, RecordedRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DEGREES = 180.0 / np.pi
LINES: dict[str, dict[str, Any]] = {
    "left": {"color": style.KINDS[0], "linestyle": "-"},
    "right": {"color": style.KINDS[1], "linestyle": (0, (5, 1.5))},
}
_POINTS = 700  # of each finger in one panel; more hide each other
_CURVES = 5
_SYMBOLS = {"left": "o", "right": "s"}
_GRID = 241  # of the landscape along each axis
_BINS = 41
# Title, field, factor to the unit shown, unit
_ROWS = (
    ("d", "d", 1e6, "µm"),
    ("θ", "theta", DEGREES, "°"),
    ("force F", "force", 1.0, "N"),
)


def _titled(figure: Figure, run: RecordedRun, text: str) -> None:
    """Write the recording's name and ``text`` above a figure."""
    figure.suptitle(f"{run.name}: {text}", x=0.01, ha="left", fontsize=9.0)


def _some(indices: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return at most so many of these as are shown, evenly spaced."""
    if indices.size <= _POINTS:
        return indices
    return indices[np.linspace(0, indices.size - 1, _POINTS).astype(np.intp)]


def _groups(
    run: RecordedRun, fingers: list[str], models: tuple[FingerModel, FingerModel]
) -> list[tuple[list[str], ContactTable]]:
    """Fingers that share a contact table, and the table."""
    groups: list[tuple[list[str], ContactTable]] = []
    for name in fingers:
        table = models[FINGERS.index(name)].table
        for names, known in groups:
            if known is table or np.array_equal(known.data, table.data):
                names.append(name)
                break
        else:
            groups.append(([name], table))
    return groups


def draw_angle(run: RecordedRun) -> Figure:
    """Draw F and U against θ on curves at fixed d, and measured over modelled pressure."""
    fingers = run.need_contact()
    groups = _groups(run, fingers, run.need_model())
    figure = style.new_figure(7.2, 1.9 + 3.0 * len(groups))
    rows = len(groups)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[*[1.0] * rows, 0.5])
    mesh: Any = None
    for row, (names, table) in enumerate(groups):
        for column, (field, label, factor) in enumerate(
            (("force", "force F [N]", 1.0), ("energy", "energy U [mJ]", 1e3))
        ):
            panel = figure.add_subplot(grid[row, column])
            mesh = _against_angle(panel, run, names, table, field, factor)
            panel.set(ylabel=label, xlabel="θ [°]")
        bar = figure.colorbar(mesh, ax=figure.axes[-2:], shrink=0.9)
        bar.set_label("displacement d [mm]")
    gain = figure.add_subplot(grid[rows, :])
    for name in fingers:
        at = _some(np.flatnonzero(run.touching(name)))
        gain.plot(
            run.states[f"{name}.theta"][at] * DEGREES,
            run.states[f"{name}.gain"][at],
            linestyle="none",
            marker=_SYMBOLS[name],
            markersize=2.2,
            alpha=0.6,
            markeredgewidth=0.0,
            color=LINES[name]["color"],
            label=name,
        )
    gain.axhline(1.0, color=style.INK, linewidth=0.8)
    gain.set(xlabel="θ [°]", ylabel="measured over\nmodelled pressure")
    every = np.concatenate([run.states[f"{name}.gain"][run.touching(name)] for name in fingers])
    reach = max(1.6 * float(np.quantile(np.abs(every - 1.0), 0.98)), 0.01)
    gain.set_ylim(1.0 - reach, 1.0 + reach)
    gain.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.1)
    _titled(figure, run, "force and energy against θ")
    return figure


def _against_angle(
    panel: Axes, run: RecordedRun, names: list[str], table: ContactTable, field: str, factor: float
) -> Any:
    """Points coloured by d over the model's curves; returns the colour bar's mappable."""
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    chosen = {name: _some(np.flatnonzero(run.touching(name))) for name in names}
    d = {name: run.states[f"{name}.d"][at] for name, at in chosen.items()}
    theta = {name: run.states[f"{name}.theta"][at] for name, at in chosen.items()}
    depths = _depths(np.concatenate(list(d.values())))
    widest = max(float(np.abs(each).max()) for each in theta.values())
    widest = max(1.1 * widest, 5.0 / DEGREES)
    colours = matplotlib.colormaps["viridis"]
    scale = Normalize(0.0, depths[-1] * 1e3 / 0.85)  # the yellow end is too faint in print
    ends = []
    for depth in depths:
        limit = float(table.tip.theta_limit(depth))
        tilt = np.linspace(-min(widest, limit), min(widest, limit), 181)
        curve = getattr(table(depth, tilt), field) * factor
        panel.plot(tilt * DEGREES, curve, color=style.GREY, linewidth=0.9, zorder=1)
        ends.append((tilt[-1] * DEGREES, float(curve[-1])))
    for name in names:
        panel.scatter(
            theta[name] * DEGREES,
            run.states[f"{name}.{field}"][chosen[name]] * factor,
            c=d[name] * 1e3,
            cmap=colours,
            norm=scale,
            s=9,
            marker=_SYMBOLS[name],
            linewidths=0.0,
            zorder=2,
            rasterized=True,
        )
        panel.plot(
            [], [], _SYMBOLS[name], color=style.GREY, markersize=3.5, linestyle="none", label=name
        )
    panel.plot([], [], color=style.GREY, linewidth=0.9, label="model at a fixed d")
    panel.set_ylim(bottom=0.0)
    panel.set_ylim(top=panel.get_ylim()[1] * 1.12)
    panel.margins(x=0.02)
    tilts, heights = zip(*ends, strict=True)
    style.label_ends(panel, max(tilts), heights, [f"{depth * 1e3:g} mm" for depth in depths])
    panel.legend(loc="upper left", ncols=3, columnspacing=1.0, handletextpad=0.4)
    return ScalarMappable(scale, colours)


def _depths(d: FloatArray) -> FloatArray:
    """A few round displacements [m] that span the measured ones, at least one."""
    from matplotlib.ticker import MaxNLocator

    largest = max(float(np.quantile(d, 0.995)), 2e-4) * 1e3
    return np.asarray(MaxNLocator(_CURVES).tick_values(0.0, largest)[1:]) * 1e-3


def draw_landscape(run: RecordedRun) -> Figure:
    """Return paths over U(d, θ) with its minimum over θ, and their height above θ = 0 over time."""
    fingers = run.need_contact()
    groups = _groups(run, fingers, run.need_model())
    figure = style.new_figure(7.0, 2.2 + 4.0 * len(groups))
    grid = figure.add_gridspec(len(groups) + 1, 1, height_ratios=[*[1.0] * len(groups), 0.4])
    above = figure.add_subplot(grid[-1])
    for row, (names, table) in enumerate(groups):
        panel = figure.add_subplot(grid[row])
        paths = {name: _path(run, name) for name in names}
        deepest = max(float(np.nanmax(d)) for d, _ in paths.values())
        widest = max(float(np.nanmax(np.abs(theta))) for _, theta in paths.values())
        draw_map(panel, table, 1.15 * deepest, max(1.15 * widest, 10.0 / DEGREES))
        for name, (d, theta) in paths.items():
            draw_path(panel, d, theta, name)
            over = table(d, theta, edge=True).energy - table(d, 0.0, edge=True).energy
            over = np.where(np.isfinite(d), over * 1e3, np.nan)
            above.plot(*run.gapped(over), label=name, **LINES[name])
        for marker, what in (("^", "begins"), ("s", "ends")):
            panel.plot([], [], marker, color=style.GREY, markersize=4, label=what)
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, borderaxespad=0.1)
    above.axhline(0.0, color=style.GREY, linewidth=0.6)
    above.set_ylabel("U less that at θ = 0\nand the same d [mJ]")
    above.set_xlabel("time [s]")
    _titled(figure, run, "path on the energy landscape")
    return figure


def _path(run: RecordedRun, finger: str) -> tuple[FloatArray, FloatArray]:
    """d and θ at each state, NaN without contact."""
    touching = run.touching(finger)
    d = np.where(touching, run.states[f"{finger}.d"], np.nan)
    return d, np.where(touching, run.states[f"{finger}.theta"], np.nan)


def draw_map(panel: Axes, table: ContactTable, deepest: float, widest: float) -> None:
    """Draw U(d, θ) [mJ] to ``deepest`` [m] and ±``widest`` [rad], its minimum over θ, its end."""
    from matplotlib.colors import PowerNorm

    d = np.linspace(0.0, deepest, _GRID)[1:]
    theta = np.linspace(-widest, widest, _GRID)
    limit = table.tip.theta_limit(d)
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
    low = [level for level in levels[1:-1] if level < 0.65 * largest]  # others run out of the frame
    panel.clabel(lines, low, fmt=lambda level: f"{level:.3g} mJ", fontsize=6.5)
    minima = theta[np.argmin(energy, axis=1)]
    local = np.abs(minima) < 0.99 * widest  # a bonded solid tip's energy falls to the sides
    if local.any():
        panel.plot(
            np.where(local, minima, np.nan) * DEGREES,
            d * 1e3,
            color=style.INK,
            linestyle=(0, (1, 1.2)),
            label="local minimum over θ",
        )
    shown = limit < widest
    for side in (-1.0, 1.0):
        if shown.any():
            panel.fill_betweenx(
                d * 1e3,
                side * np.minimum(limit, widest) * DEGREES,
                side * widest * DEGREES,
                facecolor="white",
                edgecolor=style.GREY,
                hatch="xxx",
                linewidth=0.6,
                label="rim of the backing touches" if side > 0 else None,
            )
    panel.set(xlabel="θ [°]", ylabel="displacement d [mm]")
    panel.set_xlim(-widest * DEGREES, widest * DEGREES)
    panel.set_ylim(0.0, deepest * 1e3)
    panel.grid(visible=False)


def draw_path(panel: Axes, d: FloatArray, theta: FloatArray, finger: str) -> None:
    """Draw a finger's path over the map, with its start and end."""
    colour = LINES[finger]["color"]
    panel.plot(theta * DEGREES, d * 1e3, label=f"{finger} finger", **LINES[finger])
    valid = np.flatnonzero(np.isfinite(d))
    for at, marker in ((valid[0], "^"), (valid[-1], "s")):
        panel.plot(
            theta[at] * DEGREES,
            d[at] * 1e3,
            marker,
            color=colour,
            markersize=5,
            markeredgecolor="white",
            linestyle="none",
            clip_on=False,
            zorder=4,
        )


def draw_error(run: RecordedRun) -> Figure:
    """Estimate minus truth over time within ± 2σ as reported, and histograms."""
    run.need_states()
    if not run.truth:
        raise Missing("no hand/truth in it: only simulated hands publish it")
    at, true = run.matched()
    both = {
        name: run.touching(name)[at] & (run.truth[f"true_{name}.d"][true] > 0.0)
        for name in run.fingers
    }
    if not any(each.any() for each in both.values()):
        raise Missing("no contact in it")
    figure = style.new_figure(7.2, 7.6)
    axes = figure.subplots(4, 2, width_ratios=[3.4, 1.0], sharey="row", sharex="col")
    t = run.t[at]
    for panels, (title, field, factor, unit) in zip(axes, _ROWS, strict=False):
        entries = []
        for name, valid in both.items():
            key = f"{name}.{field}"
            error = (run.states[key][at] - run.truth[f"true_{key}"][true]) * factor
            entries.append((name, error, run.states[f"{key}_std"][at] * factor, valid))
        _row(panels, t, entries)
        panels[0].set_ylabel(f"error of {title} [{unit}]")
    error = (run.states["object.angle"][at] - run.truth["true_object.angle"][true]) * DEGREES
    valid = (run.states["object.valid"][at] > 0.0) & np.all(list(both.values()), axis=0)
    _row(axes[3], t, [("object", error, np.full(t.size, np.nan), valid)])
    axes[3, 0].set_ylabel("error of φ [°]")
    axes[3, 1].set_xlabel("share [%]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    more, names = axes[3, 0].get_legend_handles_labels()
    figure.legend(handles + more, labels + names, loc="outside lower center", ncols=5)
    _titled(figure, run, "estimate minus truth; thin lines: ± 2σ as reported")
    figure.align_ylabels()
    axes[3, 0].set_xlabel("time [s]")
    return figure


def _row(
    panels: tuple[Axes, Axes],
    t: FloatArray,
    entries: list[tuple[str, FloatArray, FloatArray, BoolArray]],
) -> None:
    """One quantity: name, error, reported σ and where both are valid, of each finger."""
    panel, side = panels
    known = [error[valid & np.isfinite(error)] for _, error, _, valid in entries]
    together = np.concatenate(known)
    if not together.size:
        return
    limit = 1.3 * float(np.quantile(np.abs(together), 0.995)) or 1e-12
    for k, (name, error, std, valid) in enumerate(entries):
        if not known[k].size:
            continue
        look = LINES.get(name, {"color": style.KINDS[2], "linestyle": "-"})
        panel.plot(t, np.where(valid, error, np.nan), label=name, linewidth=0.7, **look)
        counts, edges = np.histogram(known[k], _BINS, (-limit, limit))
        side.stairs(100.0 * counts / known[k].size, edges, orientation="horizontal", **look)
        text = f"{name}: mean {known[k].mean():.2g}, std {known[k].std():.2g}"
        if np.isfinite(std[valid]).any():
            band = np.where(valid, 2.0 * std, np.nan)
            panel.fill_between(t, -band, band, color=look["color"], alpha=0.15, lw=0.6)
            inside = np.abs(error[valid]) <= 2.0 * std[valid]
            text += f", {100.0 * inside.mean():.1f} % within 2σ"
        panel.text(
            0.52 * k, 1.02, text, transform=panel.transAxes, fontsize=6.8, color=look["color"]
        )
    panel.set_ylim(-limit, limit)
