"""The pages of ``softfinger plot``; matplotlib is imported when one is drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from softfinger.tools.analysis.plots_data import RecordedRun
from softfinger.tools.analysis.plots_error import draw_error
from softfinger.tools.analysis.plots_model import draw_angle, draw_landscape
from softfinger.tools.analysis.plots_time import draw_joints, draw_time
from softfinger.tools.analysis.plots_timing import draw_timing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGES: dict[str, Callable[[RecordedRun], Figure]] = {
    "time": draw_time,
    "angle": draw_angle,
    "landscape": draw_landscape,
    "error": draw_error,
    "joints": draw_joints,
    "timing": draw_timing,
}
