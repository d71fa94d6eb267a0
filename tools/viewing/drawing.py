"""Logs the hand, the pressure maps and the landscape to Rerun, each from its newest message.

Rerun's pictures have y downwards; the hand's plane has it upwards, so y changes its sign here, and
lengths become mm.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from softfinger.daemon.client.records import read
from softfinger.daemon.wire.schema import TactileFrame
from softfinger.tools.terminal.feed import number
from softfinger.tools.viewing.known import Landscape, ShownHand
from softfinger.tools.viewing.planar import (
    COLOURS,
    GOAL,
    Footprint,
    HandPart,
    HandScene,
    Push,
    Touch,
    footprint,
    grid_of,
    tip_circle,
    touch,
)

_TRAIL = 160  # points in a trail on the landscape
_FADE = 0.995  # of the colour range with each frame, so that a single peak does not stay
_LEAST_PEAK = 8.0  # standard deviations of the noise: the least end of the colour range


class Drawing:
    """One hand's pictures. Logs at once what stands still: the landscape."""

    def __init__(self, recording: rr.RecordingStream, hand: ShownHand) -> None:
        self._recording = recording
        self._hand = hand
        self._scene = HandScene(hand)
        self._trails: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=_TRAIL) for name in hand.fingers
        }
        self._floor = _LEAST_PEAK * hand.settings.tactile.noise
        self._peak = self._floor
        self._grids: dict[str, Any] = {}
        self.landscape = hand.landscape()
        if self.landscape is not None:
            self._draw_landscape(self.landscape)

    def _draw_landscape(self, landscape: Landscape) -> None:
        self._still("landscape/picture", rr.Image(landscape.picture()))
        contours = [each for each in landscape.contours() if len(each.line) > 1]
        self._still(
            "landscape/contours",
            rr.LineStrips2D(
                [each.line for each in contours],
                colors=[(255, 255, 255, 110)] * len(contours),
                radii=rr.Radius.ui_points(0.6),
                draw_order=1.0,
            ),
        )
        spots = [each.line[len(each.line) // 8] for each in contours]
        names = [f"{1e3 * each.energy:g} mJ" for each in contours]
        ticks = landscape.ticks()
        self._still(
            "landscape/scale",
            rr.Points2D(
                [*spots, *(place for place, _ in ticks)],
                labels=[*names, *(name for _, name in ticks)],
                show_labels=True,
                radii=rr.Radius.ui_points(0.0),
                colors=[(235, 235, 235)] * len(spots) + [GOAL] * len(ticks),
                draw_order=2.0,
            ),
        )

    def forget(self) -> None:
        """Another daemon's states follow: no trail leads to them."""
        for trail in self._trails.values():
            trail.clear()
        self._scene.held.lose()
        self._peak = self._floor

    def truth(self, truth: dict[str, Any]) -> None:
        """Draw the simulated object's true pose."""
        self._part("simulated", self._scene.simulated(truth))

    def _part(self, name: str, part: HandPart) -> None:
        lines = rr.LineStrips2D(
            [_view(strip.points) for strip in part.strips],
            colors=[strip.colour for strip in part.strips],
            radii=[0.5 * strip.width for strip in part.strips],
        )
        self._recording.log(f"hand/{name}", lines)

    def state(self, state: dict[str, Any]) -> None:
        """Draw the hand, and its points on the landscape."""
        pushes: list[Push] = []
        for name, part in self._scene.parts(state).items():
            pushes += part.pushes
            self._part(name, part)
        self._recording.log(
            "hand/force",
            rr.Arrows2D(
                origins=[_view(push.at) for push in pushes],
                vectors=[_view(push.way) for push in pushes],
                labels=[push.text for push in pushes],
                show_labels=True,
                colors=[push.colour for push in pushes],
                radii=[0.9] * len(pushes),
                draw_order=30.0,
            ),
        )
        self._points([touch(state, name) for name in self._hand.fingers])

    def _points(self, contacts: list[Touch | None]) -> None:
        if self.landscape is None:
            return
        trails, now, colours, shades = [], [], [], []
        for name, contact in zip(self._hand.fingers, contacts, strict=True):
            trail = self._trails[name]
            if contact is None:
                trail.clear()
                continue
            trail.append((contact.d, contact.theta))
            d, theta = np.array(trail).T
            trails.append(self.landscape.place(d, theta))
            now.append(trails[-1][-1])
            colours.append(COLOURS[name])
            shades.append((*COLOURS[name], 170))
        self._recording.log(
            "landscape/trails",
            rr.LineStrips2D(trails, colors=shades, radii=rr.Radius.ui_points(1.4), draw_order=3.0),
        )
        self._recording.log(
            "landscape/now",
            rr.Points2D(now, colors=colours, radii=rr.Radius.ui_points(6.0), draw_order=4.0),
        )

    def frame(self, message: dict[str, Any], state: dict[str, Any] | None) -> None:
        """Draw a frame with its footprint. Raises ValueError when it isn't of this hand."""
        frame = read(TactileFrame, message)
        name = frame.finger
        if name not in self._hand.fingers:
            raise ValueError(f"a frame of finger {name!r}")
        scale = frame.scale if 0.0 < frame.scale < math.inf else 1.0
        peak = float(frame.counts.max()) * scale
        self._peak = max(_FADE * self._peak, self._floor, peak)
        self._recording.log(
            f"pressure/{name}/cells",
            rr.DepthImage(
                frame.counts,
                colormap=rr.components.Colormap.Inferno,
                depth_range=(0.0, self._peak / scale),
            ),
        )
        grid, radius = grid_of(message), self._hand.settings.tip.radius
        if grid is None:
            return
        if self._grids.get(name) != grid:
            self._grids[name] = grid
            self._still(
                f"pressure/{name}/rim",
                rr.LineStrips2D(
                    [tip_circle(grid, radius)],
                    colors=[(*COLOURS[name], 120)],
                    radii=rr.Radius.ui_points(0.7),
                ),
            )
        contact = touch(state, name)
        place = None
        if contact is not None:
            tilt_y = number(state, name, "tilt_y")
            tilt_y = tilt_y if math.isfinite(tilt_y) else 0.0
            place = footprint(grid, radius, contact.d, contact.theta, tilt_y)
        self._footprint(name, place, grid.shape, peak)

    def _footprint(
        self, name: str, place: Footprint | None, shape: tuple[int, int], peak: float
    ) -> None:
        outlines = [] if place is None else [place.outline]
        self._recording.log(
            f"pressure/{name}/footprint",
            rr.LineStrips2D(
                outlines, colors=[(255, 255, 255)], radii=rr.Radius.ui_points(1.2), draw_order=2.0
            ),
        )
        # With a white rim: the right finger's orange would be lost on a bright map.
        spots: list[Any] = [] if place is None else [place.centroid, place.centroid]
        sizes: list[Any] = [rr.Radius.ui_points(6.5), rr.Radius.ui_points(4.5)][: len(spots)]
        shades = [(255, 255, 255), COLOURS[name]][: len(spots)]
        self._recording.log(
            f"pressure/{name}/centroid",
            rr.Points2D(
                [*spots, (0.5 * shape[1], shape[0] - 1.5)],
                colors=[*shades, (200, 200, 200)],
                radii=[*sizes, rr.Radius.ui_points(0.0)],
                labels=[*[""] * len(spots), f"peak {1e-3 * peak:.1f} kPa"],
                show_labels=True,
                draw_order=3.0,
            ),
        )

    def _still(self, entity: str, what: Any) -> None:
        self._recording.log(entity, what, static=True)


def _view(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The hand's plane [m, y up] → Rerun's 2-D view [mm, y down]."""
    shown: NDArray[np.float64] = points * (1e3, -1e3)
    return shown
