"""Pages that compare measurements with the contact model: over θ, and on the energy landscape.

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
from softfinger.tools.analysis.plots_data import FloatArray, RecordedRun

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


def time_axis(panel: Axes, t: FloatArray) -> None:
    """Set label and limits of the time axis."""
    panel.set_xlabel("time [s]")
    panel.set_xlim(float(t[0]), float(max(t[-1], t[0] + 1e-3)))


def titled(figure: Figure, run: RecordedRun, text: str) -> None:
    """Write the recording's name and ``text`` above a figure."""
    figure.suptitle(f"{run.name}: {text}", x=0.01, ha="left", fontsize=9.0)


def _some(indices: NDArray[np.intp], count: int = _POINTS) -> NDArray[np.intp]:
    """Return at most ``count`` of these, evenly spaced."""
    if indices.size <= count:
        return indices
    return indices[np.linspace(0, indices.size - 1, count).astype(np.intp)]


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
    beyond = float((np.abs(every - 1.0) > reach).mean())
    if beyond > 0.0:
        gain.set_title(f"{100.0 * beyond:.2g} % beyond the frame", loc="right", fontsize=7.0)
    gain.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.1)
    titled(figure, run, "force and energy against θ")
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
    labels = [f"{depth * 1e3:g} mm" for depth in depths]
    gap, last = 0.045 * panel.get_ylim()[1], 0.0
    for (x, y), text in zip(ends, labels, strict=True):
        if y - last < gap:
            continue
        last = y
        panel.annotate(
            text, (x, y), (2, 2), textcoords="offset points", fontsize=6.5, ha="right", va="bottom"
        )
    panel.legend(loc="upper left", ncols=3, columnspacing=1.0, handletextpad=0.4)
    return ScalarMappable(scale, colours)


def _depths(d: FloatArray) -> FloatArray:
    """A few round displacements [m] that span the measured ones, at least one."""
    largest = max(float(np.quantile(d, 0.995)), 2e-4) * 1e3
    rough = largest / _CURVES
    decade = 10.0 ** np.floor(np.log10(rough))
    step = next(each * decade for each in (1.0, 2.0, 2.5, 5.0, 10.0) if each * decade >= rough)
    depths: FloatArray = np.arange(1, int(np.ceil(largest / step)) + 1) * step * 1e-3
    return depths


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
    time_axis(above, run.t)
    titled(figure, run, "path on the energy landscape")
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
