"""Pictures of a recording, by the names of their pages.

matplotlib is imported when one is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.tools.analysis.plots_data import Missing, Run
from softfinger.tools.analysis.plots_error import draw_error
from softfinger.tools.analysis.plots_model import draw_angle, draw_landscape
from softfinger.tools.analysis.plots_time import draw_joints, draw_time
from softfinger.tools.analysis.plots_timing import draw_timing
from softfinger.tools.paper import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGES: dict[str, Callable[[Run], Figure]] = {
    "time": draw_time,
    "angle": draw_angle,
    "landscape": draw_landscape,
    "error": draw_error,
    "joints": draw_joints,
    "timing": draw_timing,
}


def draw(
    run: Run, names: Sequence[str], formats: Sequence[str], folder: Path
) -> Iterator[tuple[str, Path | None, str]]:
    """Draw these pages: name, file and "" for each, or no file and why it was left out.

    Raises style.NoMatplotlib, and OSError when a file can't be written.
    """
    with style.settings():
        for name in names:
            try:
                figure = PAGES[name](run)
            except Missing as missing:
                yield name, None, str(missing)
                continue
            for suffix in formats:
                path = folder / f"{name}.{suffix}"
                style.save(figure, path)
                yield name, path, ""
