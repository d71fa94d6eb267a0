"""Pictures of analysed contacts. Nothing here imports matplotlib before something is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softfinger.tools.analysis.contacts import Contacts
from softfinger.tools.paper import style

# Title, value, its standard deviation, factor to what is shown, unit shown.
_PANELS = (
    ("displacement d", "d", "d_std", 1e3, "mm"),
    ("object's angle θ", "theta", "theta_std", 180.0 / np.pi, "°"),
    ("force F", "force", "", 1.0, "N"),
    ("energy U", "energy", "", 1e3, "mJ"),
)


def draw(contacts: list[Contacts], title: str, path: Path) -> None:
    """d and θ with two standard deviations, F and U over time. Raises MissingExtra."""
    with style.settings():
        figure = style.new_figure(7.0, 7.5)
        axes = figure.subplots(len(_PANELS), 1, sharex=True)
        for panel, (name, value, spread, factor, unit) in zip(axes, _PANELS, strict=True):
            for k, each in enumerate(contacts):
                sound = each.valid & each.contact
                shown = np.where(sound, each.values[value] * factor, np.nan)
                colour = style.KINDS[k]
                line = "-" if k == 0 else (0, (5, 1.5))
                panel.plot(each.t, shown, color=colour, linestyle=line, label=each.finger)
                if spread:
                    band = 2.0 * factor * each.values[spread]
                    panel.fill_between(
                        each.t, shown - band, shown + band, color=colour, alpha=0.25, lw=0
                    )
                if value in each.truths:
                    panel.plot(
                        each.t,
                        each.truths[value] * factor,
                        color=style.INK,
                        linestyle=":",
                        label=f"{each.finger}, known",
                    )
            panel.set_ylabel(f"{name} [{unit}]")
        axes[0].set_title(title, loc="left")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=4)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(
            0.0, max([float(each.t.max()) for each in contacts if each.t.size] or [1])
        )
        style.save(figure, path)
