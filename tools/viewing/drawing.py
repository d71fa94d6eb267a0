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
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import TactileFrame
from softfinger.tools.terminal.feed import number
from softfinger.tools.viewing.colours import COLOURS, GOAL, LEVELS, OBJECT, SPRING, between
from softfinger.tools.viewing.known import ShownHand
from softfinger.tools.viewing.landscape import Landscape
from softfinger.tools.viewing.planar import (
    FingerLines,
    Footprint,
    HeldObject,
    Touch,
    finger_lines,
    footprint,
    grid_of,
    tip_circle,
    touch,
    true_outline,
)

_TRAIL = 160  # points in a trail on the landscape
_ARROW = 1.6e-3  # m of a force's arrow a newton
_ARROW_LONGEST = 0.045  # m
_FADE = 0.995  # of the colour range with each frame, so that a single peak does not stay
_LEAST_PEAK = 8.0  # standard deviations of the noise: the least end of the colour range


class Drawing:
    """One hand's pictures. Logs at once what stands still: the palm and the landscape."""

    def __init__(self, recording: rr.RecordingStream, hand: ShownHand) -> None:
        self._recording = recording
        self._hand = hand
        self._object = HeldObject(hand.geometry)
        self._trails: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=_TRAIL) for name in hand.fingers
        }
        self._floor = _LEAST_PEAK * hand.settings.tactile.noise
        self._peak = self._floor
        self._grids: dict[str, Any] = {}
        self._height = hand.settings.simulation.object_height
        self.landscape = hand.landscape()
        half = 1e3 * hand.geometry.half_separation
        self._still(
            "hand/palm",
            rr.LineStrips2D(
                [[(-half - 12.0, 0.0), (half + 12.0, 0.0)]], colors=[SPRING], radii=[1.2]
            ),
        )
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
        self._object.lose()
        self._peak = self._floor

    def state(self, state: dict[str, Any]) -> None:
        """Draw the hand, and its points on the landscape."""
        contacts = [touch(state, name) for name in self._hand.fingers]
        lines: list[FingerLines] = []
        for name, contact in zip(self._hand.fingers, contacts, strict=True):
            q = number(state, name, "q")
            q = q if math.isfinite(q) else 0.0
            lines.append(finger_lines(self._hand.geometry, FINGERS.index(name), q, contact))
        self._fingers(lines)
        self._contacts(lines, contacts)
        self._held(state, contacts)
        self._points(contacts)

    def _fingers(self, lines: list[FingerLines]) -> None:
        strips, colours, radii = [], [], []
        for name, finger in zip(self._hand.fingers, lines, strict=True):
            for strip, radius in ((finger.link, 2.6), (finger.base, 1.2), (finger.skin, 0.5)):
                strips.append(_view(strip))
                colours.append((*COLOURS[name], 255))
                radii.append(radius)
            for spring, strain in zip(finger.springs, finger.strain, strict=True):
                share = min(4.0 * float(strain), 1.0)
                strips.append(_view(spring))
                colours.append((*between(SPRING, LEVELS["error"], share), 200))
                radii.append(0.25 + 0.35 * share)
        self._recording.log("hand/fingers", rr.LineStrips2D(strips, colors=colours, radii=radii))

    def _contacts(self, lines: list[FingerLines], contacts: list[Touch | None]) -> None:
        faces, origins, vectors, labels, colours, normals = [], [], [], [], [], []
        touching = zip(self._hand.fingers, lines, contacts, strict=True)
        for name, finger, contact in touching:
            if contact is None or finger.face is None or finger.push is None:
                continue
            faces.append(_view(finger.face))
            normals.append(_view(finger.normal))
            at, direction = finger.push
            length = min(_ARROW * contact.force, _ARROW_LONGEST)
            origins.append(_view(at[None])[0])
            vectors.append(_view(length * direction[None])[0])
            labels.append(f"{contact.force:.1f} N")
            colours.append(COLOURS[name])
        strips = [*faces, *normals]
        shades = [OBJECT] * len(faces) + [GOAL] * len(normals)
        radii = [1.0] * len(faces) + [0.35] * len(normals)
        self._recording.log(
            "hand/contact", rr.LineStrips2D(strips, colors=shades, radii=radii, draw_order=2)
        )
        self._recording.log(
            "hand/force",
            rr.Arrows2D(
                origins=origins,
                vectors=vectors,
                labels=labels,
                show_labels=True,
                colors=colours,
                radii=[0.9] * len(origins),
                draw_order=3.0,
            ),
        )

    def _held(self, state: dict[str, Any], contacts: list[Touch | None]) -> None:
        outline = self._object.shown(state, contacts, self._height)
        outlines = [] if outline is None else [_view(outline)]
        self._recording.log("hand/object", rr.LineStrips2D(outlines, colors=[OBJECT], radii=[0.7]))

    def truth(self, truth: dict[str, Any]) -> None:
        """Draw the simulated object's true pose."""
        outline = true_outline(self._hand.settings.simulation, truth)
        strips = [] if outline is None else [_view(outline)]
        self._recording.log("hand/simulated", rr.LineStrips2D(strips, colors=[GOAL], radii=[0.3]))

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


def _view(points: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """The hand's plane [m, y up] → Rerun's 2-D view [mm, y down]."""
    assert points is not None
    shown: NDArray[np.float64] = points * (1e3, -1e3)
    return shown
