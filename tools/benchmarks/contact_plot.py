"""The picture of `bench contact`: run time against error, one marker a kind of representation."""

from __future__ import annotations

from pathlib import Path

from softfinger.tools.benchmarks.contact_report import ContactRow
from softfinger.tools.paper import style

# Kinds by how a row's name starts, with the legend's words.
KINDS = {
    "table": "contact table",
    "direct quadrature": "direct quadrature",
    "RectBivariateSpline": "RectBivariateSpline.ev",
    "RegularGridInterpolator": "RegularGridInterpolator",
    "map_coordinates": "map_coordinates",
    "dblquad": "dblquad",
}
_PANELS = (
    ("single calls: force and energy", 2, ("loop", "python")),
    ("single calls: with the four partials", 6, ("loop", "python")),
    ("batches: force and energy", 2, ("batch",)),
    ("batches: with the four partials", 6, ("batch",)),
)


def draw(rows: list[ContactRow], path: Path) -> None:
    """Write the picture. Raises NoMatplotlib without the extra ``plot``."""
    with style.settings():
        figure = style.new_figure(8.0, 7.4)
        figure.suptitle("Contact model: run time against error, Table I's law", fontsize=10)
        panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for axes, (title, outputs, modes) in zip(panels, _PANELS, strict=True):
            for kind, (start, words) in enumerate(KINDS.items()):
                for mode in modes:
                    chosen = [
                        each
                        for each in rows
                        if each.name.startswith(start)
                        and "domain" not in each.name
                        and each.material == "table_i"
                        and each.outputs
                        in (outputs, 6 if start == "direct quadrature" else outputs)
                        and mode in each.timings
                    ]
                    chosen.sort(key=lambda each: each.max_error)
                    compiled = mode == "loop"
                    axes.plot(
                        [each.max_error for each in chosen],
                        [each.timings[mode].median_ns for each in chosen],
                        style.MARKERS[kind],
                        linestyle="-" if start in ("table", "direct quadrature") else "none",
                        linewidth=0.8,
                        color=style.KINDS[kind],
                        mfc=style.KINDS[kind] if compiled else "white",
                        ms=6,
                        label=words if mode == modes[-1] else None,
                    )
            base = [
                each.timings[modes[0]].median_ns
                for each in rows
                if each.name == "closed form" and each.outputs == outputs
            ]
            axes.axhline(base[0], color=style.GREY, linestyle="--", linewidth=1.0)
            axes.text(
                0.98, base[0], "closed form, constant E", va="bottom", ha="right", fontsize=7,
                color=style.GREY, transform=axes.get_yaxis_transform(),
            )  # fmt: skip
            axes.set(xscale="log", yscale="log", title=title)
        panels[0].invert_xaxis()
        for axes in panels[2:]:
            axes.set_xlabel("largest relative error [1]  (better to the right)")
        panels[0].set_ylabel("time of a call [ns]")
        panels[2].set_ylabel("time of a point [ns]")
        panels[1].legend(loc="best")
        style.caption(
            figure,
            [
                "Filled: called one by one in a compiled loop. Open: called from Python, or a "
                "batch. Points: d up to 8 mm, |θ| up to 30°. Medians of one run in turns.",
            ],
        )
        style.save(figure, path)
