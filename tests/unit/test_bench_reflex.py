"""The reflex's time, from records of an emulated hand that are made up."""

from __future__ import annotations

import math

from softfinger.tools.benchmarks.reflex import reaction


def report(left: list[tuple[float, float]], right: list[tuple[float, float]]) -> dict:
    """A hand whose object was pushed at 1 s and slipped at 1.004 s."""
    servos = [{"goal_currents": each} for each in (left, right)]
    return {"object": {"pushed": 1.0, "slipped": 1.004}, "servos": servos}


def test_the_reaction_is_the_first_goal_of_both_that_is_a_quarter_more() -> None:
    times = [0.99, 1.0, 1.006, 1.008, 1.010, 1.012]
    left = list(zip(times, (0.40, 0.42, 0.60, 0.50, 0.52, 0.53), strict=True))
    right = list(zip(times, (-0.41, -0.41, -0.30, -0.50, -0.52, -0.40), strict=True))
    # 0.82 A before, whatever the bounds' sign; 0.90 and 1.00 A are not a quarter more.
    assert math.isclose(reaction(report(left, right)), 0.006)
    assert reaction(report(left[:4], right[:4])) == math.inf
