"""Sec. V's slow turn: the equations' balance against their own energy, and the simulated hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.tools.paper import slow_turn
from softfinger.tools.paper.sheets import Sheet


@pytest.fixture(scope="module")
def sheets() -> tuple[Sheet, ...]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slow_turn, "_SWING", 2.0)  # s
        slow_turn.slow_turn.cache_clear()
        found = slow_turn.slow_turn()
        slow_turn.slow_turn.cache_clear()
    return found


def test_forces_are_the_energys_slopes() -> None:
    """The balance, from finite differences of the energy along motions that roll."""
    here = slow_turn.turned(np.radians([2.0, 4.0]), slow_turn.gripped())[-1]
    step = 1e-6
    for k in range(5):
        moved = []
        for sign in (1.0, -1.0):
            x = np.r_[here.pose, here.q]
            x[k] += sign * step
            moved.append(slow_turn.held(x[3:], x[:3], here).energy())
        slope = (moved[0] - moved[1]) / (2.0 * step)
        expected = 0.0 if k < 3 else here.torques()[k - 3]
        assert slope == pytest.approx(expected, abs=1e-5)


def test_the_path_lies_on_the_floor_of_the_valley(sheets: tuple[Sheet, ...]) -> None:
    equations, _, land = sheets
    for lean in slow_turn.LEANS:
        angle, v = land[f"angle at {lean} deg"], land[f"V at {lean} deg"]
        parabola = np.polyfit(angle[15:26], v[15:26], 2)
        assert parabola[0] > 0.1  # mJ/°²
        floor = -0.5 * parabola[1] / parabola[0]
        order = np.argsort(equations["lean"])
        path = np.interp(lean, equations["lean"][order], equations["angle"][order])
        assert floor == pytest.approx(path, abs=0.05)


def test_the_simulated_hand_goes_the_equations_way(sheets: tuple[Sheet, ...]) -> None:
    equations, plant, _ = sheets
    order = np.argsort(equations["angle"])
    assert math.degrees(slow_turn.REACH) - 0.5 < np.max(plant["angle"])
    for name, within in (("lean", 0.01), ("energy of both tips", 0.02), ("shear force", 0.02)):
        there = np.interp(plant["angle"], equations["angle"][order], equations[name][order])
        assert np.abs(plant[name] - there).max() < within, name
