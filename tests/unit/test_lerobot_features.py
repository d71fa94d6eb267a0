"""What LeRobot's names are of a state and its frames; without LeRobot."""

import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.client.stream import read
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import HandState, TactileFrame
from tests.harness.golden_wire import sample

PACKAGE = Path(__file__).parents[2] / "lerobot_robot_softfinger"
# Alone: the package itself imports LeRobot.
features = runpy.run_path(str(PACKAGE / "lerobot_robot_softfinger" / "features.py"))
STATE, image, observation = (features[name] for name in ("STATE", "image", "observation"))


def frame(counts: list[list[int]], t: float, scale: float = 1000.0) -> TactileFrame:
    data = np.array(counts, "<u2")
    message = dict(zip(("rows", "cols"), data.shape, strict=True)) | {"data": data.tobytes()}
    given = {**sample(schema.TACTILE), **message, "scale": scale, "mono_ns": round(t * 1e9)}
    return read(TactileFrame, given)


def test_what_is_not_known_or_not_touched_is_zero():
    state = read(HandState, sample(schema.STATE))
    left = replace(state.left, q=0.1, contact=True, d=1e-3, theta=math.nan, force=2.0)
    right = replace(state.right, q=-0.2, contact=False, d=2e-3, force=3.0)
    unknown = replace(state.object, valid=False, angle=0.3)
    state = replace(state, left=left, right=right, object=unknown, mono_ns=5_000_000_000)
    given = {"left": frame([[0]], 4.99), "right": frame([[0]], 4.75)}
    found = observation(state, given)
    assert tuple(found) == STATE
    expected = {
        "left.pos": 0.1,
        "left.contact": 1.0,
        "left.d": 1e-3,
        "left.theta": 0.0,
        "left.force": 2.0,
        "left.touch_age": 0.01,
        "right.pos": -0.2,
        "right.contact": 0.0,
        "right.d": 0.0,
        "right.force": 0.0,
        "right.touch_age": 0.25,
        "object.angle": 0.0,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_an_image_is_linear_and_white_from_the_full_scale_on():
    found = image(frame([[0, 1, 50], [100, 101, 65535]], 0.0), full_scale=100e3)
    assert found.dtype == np.uint8
    assert found.shape == (2, 3, 3)
    for channel in range(3):
        np.testing.assert_array_equal(found[:, :, channel], [[0, 3, 128], [255, 255, 255]])
