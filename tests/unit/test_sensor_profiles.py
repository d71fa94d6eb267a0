"""Hands with cells as people have them: grasped, turned and held, judged by the plant."""

import math
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.profile.load import load
from softfinger.tools.watched import Watched

FORCE = 8.0  # N


@pytest.mark.parametrize(
    ("profile", "off", "angle"), [("velostat", 0.06, 1.0), ("capacitive", 0.08, 0.5)]
)
def test_a_sensor_with_flaws_grasps_turns_and_holds_and_nothing_is_falsely_warned_of(
    profile, off, angle
):
    with Watched(load(Path(profile)).model_dump()) as hand:
        hand.run(0.3)
        hand.command("tare")
        hand.grasp(FORCE)
        hand.run(4.0)
        for wanted in (8.0, -8.0, 0.0):
            hand.command("rotate", angle=math.radians(wanted))
            hand.run(1.5)
            turned = np.degrees(hand.watch(0.5).angle)
            assert np.abs(turned - wanted).max() < angle
        hand.run(3.0)
        seen = hand.watch(1.0)
        assert np.abs(seen.force / FORCE - 1.0).max() < off
        for contact, force in zip(hand.contacts, seen.force[-1], strict=True):
            assert abs(contact.force - force) < 2.0 * contact.force_std
        assert hand.mode == "holding"
        assert [event for event in hand.events if event[0] != "info"] == []


def test_a_hand_that_does_not_know_of_its_cells_response_lets_go():
    sections = load(Path("velostat"), changes=["tactile.response=0"]).model_dump()
    with Watched(sections) as hand:
        hand.grasp(FORCE)
        hand.run(4.0)
        hand.command("rotate", angle=math.radians(8.0))
        hand.run(4.0)
        assert hand.mode != "holding"
