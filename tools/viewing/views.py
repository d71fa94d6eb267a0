"""The viewer's layout, and the names of what is in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from softfinger.tools.viewing.known import HEIGHT, WIDTH, ShownHand
from softfinger.tools.viewing.planar import COLOURS, GOAL, LATE, OBJECT

TIME = "time"  # the timeline: Unix time of the daemon
SECONDS = 12.0  # of the past in the plots

MODES = {
    "disarmed": (120, 120, 120),
    "armed": (86, 140, 190),
    "moving": (120, 100, 190),
    "grasping": (230, 160, 30),
    "holding": (0, 158, 115),
    "rotating": (60, 170, 210),
    "releasing": (190, 150, 90),
    "fault": (214, 54, 40),
}


Line = tuple[str, tuple[int, int, int], float]  # name, colour, width


class Plot:
    """One plot: entity, title, and the lines' names, colours and widths."""

    def __init__(self, name: str, title: str, lines: Sequence[Line]):
        self.entity = f"plots/{name}"
        self.title = title
        self._lines = lines

    def style(self) -> Any:
        """The lines' names, colours and widths for Rerun."""
        names, colours, widths = zip(*self._lines, strict=True)
        return rr.SeriesLines(names=names, colors=colours, widths=widths)

    def view(self) -> rrb.TimeSeriesView:
        """Its view: the last seconds, the axis by the data."""
        return rrb.TimeSeriesView(
            origin=self.entity,
            name=self.title,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftBottom),
            time_ranges=_past(SECONDS),
        )


def plots(hand: ShownHand) -> dict[str, Plot]:
    """The plots of a hand, by name; each has a line for each finger that takes part."""
    fingers: list[Line] = [(name, COLOURS[name], 2.0) for name in hand.fingers]
    goals: list[Line] = [(f"{name} goal", _pale(COLOURS[name]), 1.0) for name in hand.fingers]
    goal: list[Line] = [("goal", GOAL, 1.5)]
    shown = {
        "force": Plot("force", "Force [N]", fingers + goal),
        "energy": Plot("energy", "Energy [mJ]", fingers + goal),
        "d": Plot("d", "Displacement d [mm]", fingers),
        "theta": Plot("theta", "Tilt θ [°]", fingers),
        "tick": Plot("tick", "Tick [µs]", [("work", OBJECT, 1.5), ("late", LATE, 1.5)]),
    }
    if len(hand.fingers) == 2:
        shown["object"] = Plot("object", "Object's angle [°]", [("object", OBJECT, 2.0), *goal])
    if hand.servos:
        shown["q"] = Plot("q", "Joints [°]", fingers + goals)
        shown["current"] = Plot("current", "Currents [A]", fingers + goals)
    return shown


def blueprint(hand: ShownHand) -> rrb.Blueprint:
    """The layout for a hand, without views for what its scene lacks."""
    shown = plots(hand)
    pictures: list[Any] = [_hand_view(hand)]
    shares = [1.9]
    if hand.sensors:
        maps = [_map_view(hand, name) for name in hand.fingers]
        pictures = [maps[0], *pictures, *maps[1:]]
        shares = [1.0, 1.9, *[1.0] * (len(maps) - 1)]
    contact = [shown["force"].view(), shown["energy"].view()]
    more: list[Any] = [rrb.Vertical(shown["d"].view(), shown["theta"].view(), name="d and θ")]
    if hand.servos:
        more.append(rrb.Vertical(shown["q"].view(), shown["current"].view(), name="Joints"))
    if "object" in shown:
        more.append(shown["object"].view())
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*pictures, column_shares=shares),
            rrb.Horizontal(
                rrb.Spatial2DView(
                    origin="landscape",
                    name="Energy landscape U(d, θ)",
                    visual_bounds=rrb.VisualBounds2D(
                        x_range=[-56.0, WIDTH + 10.0], y_range=[-12.0, HEIGHT + 32.0]
                    ),
                ),
                rrb.Tabs(rrb.Vertical(*contact, name="Force and energy"), *more),
                rrb.Vertical(
                    rrb.Tabs(
                        shown["tick"].view(),
                        rrb.TextDocumentView(origin="statistics", name="Tick statistics"),
                    ),
                    rrb.StateTimelineView(origin="mode", name="Mode", **_MODE_RANGE),
                    rrb.TextLogView(origin="events", name="Events", columns=_event_columns()),
                    row_shares=[1.3, 0.8, 1.2],
                ),
                column_shares=[1.15, 1.3, 1.25],
            ),
            row_shares=[1.0, 1.15],
        ),
        rrb.TimePanel(timeline=TIME, state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _map_view(hand: ShownHand, name: str) -> rrb.Spatial2DView:
    tactile = hand.settings.tactile
    return rrb.Spatial2DView(
        origin=f"pressure/{name}",
        name=f"Pressure, {name} tip",
        background=[20, 22, 30],
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-1.0, tactile.cols + 1.0], y_range=[-1.0, 1.12 * tactile.rows]
        ),
    )


def _hand_view(hand: ShownHand) -> rrb.Spatial2DView:
    geometry = hand.geometry
    a = 1e3 * geometry.tip_radius
    half = 1e3 * geometry.half_separation + 1.3 * a
    top = 1e3 * geometry.reach + 1.9 * a
    return rrb.Spatial2DView(
        origin="hand",
        name="Hand [mm]",
        visual_bounds=rrb.VisualBounds2D(x_range=[-half, half], y_range=[-top, 0.4 * a]),
    )


def _event_columns() -> rrb.TextLogColumns:
    """Level and text; the time of day is in the text, where it is not cut off."""
    return rrb.TextLogColumns(
        timeline_columns=[_ENCODINGS.TimelineColumn(TIME, visible=False)],
        text_log_columns=["LogLevel", "Body"],
    )


def _past(seconds: float) -> Any:
    return rr.VisibleTimeRange(
        TIME,
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-seconds),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )


# Rerun before 0.38 calls encodings datatypes, and shows all of the modes.
_ENCODINGS: Any = getattr(rrb, "encodings", None) or getattr(rrb, "datatypes")  # noqa: B009
_MODE_RANGE: dict[str, Any] = {"time_ranges": _past(SECONDS)} if hasattr(rrb, "encodings") else {}


def _pale(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    return (colour[0] + 128) // 2, (colour[1] + 128) // 2, (colour[2] + 128) // 2
