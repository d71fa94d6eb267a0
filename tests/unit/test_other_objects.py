"""Test the daemon with wedges, discs and a sheet instead of blocks, and without an object."""

import math
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.control.state_machine import Gripping
from softfinger.daemon.perception.hand_state import TAPER
from softfinger.tools.simulated_daemon import SimulatedDaemon
from tests.harness.reference_hand import ReferenceHand

HAND = ReferenceHand()
SLOW: dict[str, Any] = {"rate": 25.0}


class Rig(SimulatedDaemon):
    """Simulated hand with actions and measurements for tests."""

    def grasp(self, force: float, seconds: float = 2.5) -> None:
        super().grasp(force)
        self.run(seconds)

    def turn(self, angle: float, seconds: float) -> None:
        self.command("rotate", angle=angle)
        self.run(seconds)

    def warnings(self) -> list[str]:
        return [kind for level, kind, _ in self.events if level in ("warning", "error")]


def width_at_the_contacts(plant: Any) -> float:
    """Return the distance between both contacts in the plant along the object's normal n."""
    found = []
    n = np.array([math.cos(plant.object_pose[2]), math.sin(plant.object_pose[2])])
    for finger, side in ((0, 1.0), (1, -1.0)):
        q = plant.q[finger]
        along = np.array([side * math.cos(q), -math.sin(q)])
        turned = plant.theta[finger]
        c, s = math.cos(turned), math.sin(turned)
        to = np.array([c * along[0] - s * along[1], s * along[0] + c * along[1]])
        found.append(HAND.tips(plant.q)[finger] + (HAND.tip_radius - plant.d[finger]) * to)
    return float((found[1] - found[0]) @ n)


@pytest.mark.parametrize(
    ("taper", "told", "frames"), [(0.2, 0.2, {}), (0.2, 0.13, {}), (-0.3, -0.3, SLOW)]
)
def test_a_wedge_is_measured_and_turned_correctly(taper, told, frames):
    sections = {
        "simulation": {"object_shape": "wedge", "object_taper": taper},
        "object": {"taper": told},
        "tactile": frames,
    }
    with Rig(sections) as rig:
        rig.grasp(8.0)
        for angle in (0.0, 0.05, -0.05):
            rig.turn(angle, 1.5)
            off = []
            for _ in range(50):
                rig.loop.advance(0.002)
                rig.plant.advance(rig.state.reading.t)
                theta = [contact.theta for contact in rig.state.contacts]
                off.append(
                    [*(theta - rig.plant.theta), rig.state.object.angle - rig.plant.object_pose[2]]
                )
            assert rig.state.mode == "holding"
            assert np.abs(np.mean(off, axis=0)).max() < 0.004
            assert rig.plant.object_pose[2] == pytest.approx(angle, abs=math.radians(0.3))
            assert rig.state.object.width == pytest.approx(
                width_at_the_contacts(rig.plant), abs=2e-4
            )
            held = rig.estimator.grasp
            used = np.abs(rig.plant.tangential / rig.plant.normal).max()
            assert held.shear == pytest.approx(used, abs=0.03)
            assert rig.estimator._state.mean[TAPER] == pytest.approx(taper, abs=0.005)
        assert rig.warnings() == []


def test_an_undeclared_taper_is_measured_and_reported():
    with Rig({"simulation": {"object_shape": "wedge", "object_taper": 0.17}}) as rig:
        rig.grasp(5.0)
        rig.plant.advance(rig.state.reading.t)
        found = [*(contact.theta for contact in rig.state.contacts), rig.state.object.angle]
        true = [*rig.plant.theta, rig.plant.object_pose[2]]
        assert found == pytest.approx(true, abs=0.004)
        assert rig.warnings() == ["hand.angle"]


@pytest.mark.parametrize(("force", "frames"), [(1.0, SLOW), (25.0, {})])
def test_without_an_object_between_the_tips_the_hand_opens(force, frames):
    with Rig({"simulation": {"object_shape": "none"}, "tactile": frames}) as rig:
        rig.grasp(force, 1.0)
        worst = 0.0
        for _ in range(600):
            rig.loop.advance(0.002)
            worst = max(worst, float(rig.plant.force.max()))
        rig.loop.advance(1.0)
        assert rig.state.mode == "armed"
        assert rig.state.reading.q == pytest.approx(rig.settings.hand.open_angle, abs=0.03)
        assert rig.warnings() == ["grasp"]
        assert 0.5 < worst < 4.0
        assert "no object between the tips" in next(
            text for *_, text in rig.events if "between" in text
        )


def test_fingers_that_do_not_reach_an_object_stop_at_their_limits():
    with Rig({"simulation": {"object_shape": "none"}, "hand": {"q_max": (0.3, 0.3)}}) as rig:
        rig.grasp(6.0, 5.0)
        assert rig.state.mode == "armed"
        (text,) = [text for _, kind, text in rig.events if kind == "grasp"]
        assert text == "the fingers found no object and stopped at their limits"


def test_a_declared_sheet_is_not_mistaken_for_a_missing_object():
    sheet = {"simulation": {"object_width": 0.001}, "object": {"width_min": 0.0005}}
    with Rig(sheet) as rig:
        rig.grasp(1.0, 1.6)
        assert not any("between" in text for *_, text in rig.events)
        assert isinstance(rig.control.state, Gripping)


def test_a_small_disc_is_not_mistaken_for_another_tip():
    """A disc causes a misfit, which could change d by more than half."""
    with Rig({"simulation": {"object_shape": "disc", "object_radius": 0.010}}) as rig:
        rig.grasp(8.0, 4.0)
        assert rig.state.mode == "holding"
        assert rig.contacts[0].misfit


def test_a_disc_is_held_and_turned_by_the_line_between_its_contacts():
    with Rig({"simulation": {"object_shape": "disc"}}) as rig:
        rig.grasp(8.0)
        assert rig.plant.force == pytest.approx([8.0, 8.0], rel=0.2)
        assert rig.state.contacts[0].d / rig.plant.d[0] == pytest.approx(0.72, abs=0.03)
        rig.turn(0.08, 2.0)
        assert rig.state.mode == "holding"
        assert rig.state.fault == ""
        tips = HAND.tips(rig.plant.q)
        line = math.atan2(*(tips[1] - tips[0])[::-1])
        # If the contact is curved, the estimated tilt is slightly too small.
        assert rig.state.object.angle == pytest.approx(0.95 * line, abs=0.01)
        # In addition, the disc has rolled on the tips.
        assert rig.plant.object_pose[2] > 2.0 * line
