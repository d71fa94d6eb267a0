"""Format the stream's records as short texts and small pictures, for prompts and notebooks."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import FINGERS
from softfinger.kinematics.estimation.invalid import Invalid

if TYPE_CHECKING:
    from softfinger.daemon.wire.schema import FingerState, HandState, ObjectState, TactileFrame

_COLOUR = "#0a8078"  # colour that is readable on light and on dark pages
# Number of shades in a picture. More shades would make the SVG longer without a visible difference.
_SHADES = 12
_SIDE = 176  # longer side of a picture [px]
# The darkest shade represents at least this pressure [Pa], so that the noise of an unloaded tip
# stays faint.
_FULL = 10e3


def state_parts(state: HandState) -> list[str]:
    """Return texts with the mode, the tip forces, and the object's angle and width.

    During a fault, the texts contain only the mode and the fault.
    """
    if state.fault:
        return [state.mode, state.fault]
    parts = [state.mode]
    touching = [finger for finger in (state.left, state.right) if finger.contact]
    if touching:
        force = sum(finger.force for finger in touching) / len(touching)
        tips = ", ".join(map(_force, touching))
        parts.append(f"{force:.1f} N ({tips})")
    if state.object.valid:
        parts.append(object_text(state.object))
    reason = why_invalid(state)
    return [*parts, reason] if reason else parts


def why_invalid(state: HandState) -> str:
    """Return the reasons why the fingers' estimates are invalid; empty if they are valid."""
    reasons = {name: state.finger(name).invalid for name in FINGERS}
    return "; ".join(
        f"{name} not valid: {reason}"
        for name, reason in reasons.items()
        if reason not in ("", Invalid.NOT_IN_SCENE.text)
    )


def finger_text(finger: FingerState) -> str:
    """Return the force, displacement and tilt (with standard deviations) and the joint angle."""
    joint = f"joint {math.degrees(finger.q):z.1f}°"
    if finger.invalid:
        return f"not valid: {finger.invalid}, {joint}"
    if not finger.contact:
        return f"no contact, {joint}"
    return f"{_force(finger)} N, d {_depth(finger)} mm, θ {_tilt(finger)}°, {joint}"


def object_text(pose: ObjectState) -> str:
    """Return the object's angle and width."""
    if not pose.valid:
        return "not valid"
    return f"{math.degrees(pose.angle):z.1f}°, {1e3 * pose.width:.1f} mm"


def frame_text(frame: TactileFrame) -> str:
    """Return the finger, the grid size and the maximum pressure."""
    lost = "" if frame.valid else ", the board is disconnected"
    highest = 1e-3 * frame.pressure.max()
    return f"{frame.finger}, {frame.rows} × {frame.cols} cells, {highest:.1f} kPa at most{lost}"


def _force(finger: FingerState) -> str:
    return f"{finger.force:.1f} ± {finger.force_std:.1f}"


def _depth(finger: FingerState) -> str:
    return f"{1e3 * finger.d:.2f} ± {1e3 * finger.d_std:.2f}"


def _tilt(finger: FingerState) -> str:
    return f"{math.degrees(finger.theta):z.1f} ± {math.degrees(finger.theta_std):.1f}"


def state_html(state: HandState) -> str:
    """Return an HTML table of both fingers; the caption summarises the state in one line."""
    rows: dict[str, Callable[[FingerState], str]] = {
        "force [N]": lambda finger: _force(finger) if finger.contact else "",
        "d [mm]": lambda finger: _depth(finger) if finger.contact else "",
        "θ [°]": lambda finger: _tilt(finger) if finger.contact else "",
        "joint [°]": lambda finger: f"{math.degrees(finger.q):z.1f}",
        "current [A]": lambda finger: f"{finger.current:z.2f}",
        "temperature [°C]": lambda finger: f"{finger.temperature:.0f}",
    }
    heads = "".join(f"<th>{name}</th>" for name in ("", *FINGERS))
    cells = "".join(
        f"<tr><th>{name}</th>"
        + "".join(f"<td>{text(state.finger(each))}</td>" for each in FINGERS)
        + "</tr>"
        for name, text in rows.items()
    )
    caption = html.escape(", ".join(state_parts(state)))
    return f"<table><caption>{caption}</caption><tr>{heads}</tr>{cells}</table>"


def frame_html(frame: TactileFrame) -> str:
    """Return an SVG picture of the pressures (row 0 at the bottom) and the frame's text."""
    aspect = frame.rows * frame.pitch_y / (frame.cols * frame.pitch or math.nan)
    if not 0.01 < aspect < 100.0:  # The values may be invalid, because the stream is not trusted.
        aspect = frame.rows / frame.cols
    width, height = min(1.0, 1.0 / aspect) * _SIDE, min(1.0, aspect) * _SIDE
    paths = "".join(
        f'<path fill="{_COLOUR}" fill-opacity="{level / _SHADES:.2f}" d="{outline}"/>'
        for level, outline in _outlines(frame.pressure)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {frame.cols} {frame.rows}" preserveAspectRatio="none" '
        f'shape-rendering="crispEdges" style="border:1px solid {_COLOUR}">{paths}</svg>'
        f"<div>{html.escape(frame_text(frame))}</div>"
    )


def _outlines(pressure: NDArray[np.float64]) -> Iterator[tuple[int, str]]:
    """Yield each shade of a frame and the SVG path of its cells; adjacent cells are merged."""
    full = max(pressure.max(), _FULL)
    levels = np.rint(np.nan_to_num(pressure / full) * _SHADES).astype(int)[::-1]
    for level in range(1, _SHADES + 1):
        edges = np.diff(np.pad(levels == level, ((0, 0), (1, 1))).astype(int), axis=1)
        starts, ends = np.argwhere(edges > 0), np.argwhere(edges < 0)
        if len(starts):
            runs = zip(starts.tolist(), (ends - starts)[:, 1].tolist(), strict=True)
            yield level, "".join(f"M{x} {y}h{n}v1h-{n}z" for (y, x), n in runs)
