"""Convert hand states and tactile frames to LeRobot features, without importing LeRobot."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import HandState, TactileFrame

_PLAIN = {"pos": "q", "vel": "dq", "current": "current", "contact": "contact"}
_FELT = ("d", "theta", "force")  # fields that are 0 without a contact
_OBJECT = ("angle", "width")  # fields that are 0 while the object pose is unknown
STATE = tuple(
    [f"{name}.{each}" for name in FINGERS for each in (*_PLAIN, *_FELT, "touch_age")]
    + [f"object.{each}" for each in _OBJECT]
)
JOINTS = tuple(f"{name}.pos" for name in FINGERS)
IMAGES = {name: f"{name}_touch" for name in FINGERS}
FULL_SCALE = 127.5e3  # full-scale pressure [Pa]; a step of an 8-bit image is 500 Pa


def observation(state: HandState, frames: Mapping[str, TactileFrame]) -> dict[str, float]:
    """Return the values of the `STATE` features in SI units.

    ``frames`` contains each finger's latest frame. ``touch_age`` [s] is the state's time minus the
    frame's sampling time.
    """
    values: list[float] = []
    for name in FINGERS:
        finger = getattr(state, name)
        values += [getattr(finger, field) for field in _PLAIN.values()]
        values += [getattr(finger, field) if finger.contact else 0.0 for field in _FELT]
        values.append((state.mono_ns - frames[name].mono_ns) * 1e-9)
    values += [getattr(state.object, field) if state.object.valid else 0.0 for field in _OBJECT]
    finite = (float(value) if math.isfinite(value) else 0.0 for value in values)
    return dict(zip(STATE, finite, strict=True))


def image(pressure: NDArray[np.float64], full_scale: float = FULL_SCALE) -> NDArray[np.uint8]:
    """Convert pressures [Pa] to an image [rows, cols, 3]; ``full_scale`` and above is white."""
    grey = np.clip(np.rint(pressure * (255.0 / full_scale)), 0.0, 255.0)
    return np.repeat(grey.astype(np.uint8)[:, :, np.newaxis], 3, axis=2)
