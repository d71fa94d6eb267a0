"""Run ``softfinger figures``: compute the paper's figures and write them as CSV and PNG.

If an erratum in the paper affects a figure, the caption states the correction.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from softfinger.tools.paper.sheets import FigurePage

NAMES = (
    *("fig3", "fig4a", "fig4b", "fig5a", "fig5b"),
    *("fig7", "fig7_run", "fig10", "fig10_run", "fig10_shear", "fig11"),
)
BY_NAME = ("slow_turn",)  # figures that are slow to compute, and are drawn only on request


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help=f"figures: {', '.join(NAMES)} (default: all of these); {', '.join(BY_NAME)} (takes "
        "a minute)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("figures"),
        metavar="DIR",
        help="output folder, created if it does not exist (default: figures)",
    )


def pages() -> dict[str, FigurePage]:
    """Return all figures by name."""
    from softfinger.tools.paper import experiment_pages, model_pages, run_pages, sheared_pages

    modules = (model_pages, experiment_pages, run_pages, sheared_pages)
    found = {name: page for each in modules for name, page in each.PAGES.items()}
    return {name: found[name] for name in (*NAMES, *BY_NAME)}


def run(arguments: argparse.Namespace) -> int:
    """Write the data and, if matplotlib is installed, the figures. Raises OSError."""
    known = (*NAMES, *BY_NAME)
    unknown = [name for name in arguments.names if name not in known]
    if unknown:
        print(f"figures: found {unknown[0]!r}, expected one of {', '.join(known)}", file=sys.stderr)
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    write({name: pages()[name] for name in arguments.names or NAMES}, arguments.out)
    return 0


def write(chosen: dict[str, FigurePage], folder: Path) -> None:
    """Write the chosen figures to ``folder`` and print each file path. Raises OSError."""
    from softfinger.tools import style
    from softfinger.tools.extras import MissingExtra
    from softfinger.tools.paper.sheets import errata_sheet

    numbers = {name: page.sheets() for name, page in chosen.items()}
    for sheets in numbers.values():
        for each in sheets:
            print(each.write(folder))
    if any(page.errata for page in chosen.values()):
        print(errata_sheet(chosen).write(folder))
    try:
        with style.settings():
            for name, page in chosen.items():
                figure = style.new_figure(*page.size)
                page.draw(figure, numbers[name])
                style.save(figure, folder / f"{name}.png")
                print(folder / f"{name}.png")
    except MissingExtra as error:
        print(f"figures: only the CSV files were written; {error}", file=sys.stderr)
