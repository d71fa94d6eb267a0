"""How stuck shear relaxes: creep against its exponential, micro-slip against its closed form."""

import math

import numpy as np
import pytest

from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from tests.harness.plant import PAPER, make, place

DEPTH = 0.004
STEP = 1e-4  # s
MU = 0.3


def pressed(**simulation: float) -> SimulatedHand:
    """The left tip upright on an object; neither moves by itself."""
    hand = make(PAPER, STEP, tip_friction=MU, **simulation)
    hand.plant.parameters.joints_held = hand.plant.parameters.object_held = True
    place(hand, (0.0, -0.3), (-0.010 - DEPTH, 0.08, 0.0))
    return hand


def sheared(hand: SimulatedHand, way: list[float]) -> list[float]:
    """The tip's T over μN at the end of each leg, its face moved to and fro from 0 [m]."""
    found, at = [], 0.0
    for target in way:
        for value in np.linspace(at, target, 400)[1:]:
            hand.shear[0] += value - at
            at = value
            hand.refresh()
            hand.advance(hand.t + STEP)
        found.append(float(hand.tangential[0] / (MU * hand.normal[0])))
    return found


def test_creep_relaxes_a_stuck_shear_exponentially():
    hand = pressed(tip_creep_time=0.5)
    hand.shear[0] = 0.2 * DEPTH * MU
    hand.refresh()
    first = hand.tangential[0]
    assert first > 0.1
    hand.advance(hand.t + 0.75)
    assert hand.tangential[0] == pytest.approx(first * math.exp(-1.5), rel=1e-3)


def test_slip_begins_at_the_edge_and_is_remembered_layer_by_layer() -> None:
    # Integrals of the springs' own friction: from rest 1 − (1 − u/μd)², after each turn twice that
    # of half the way, and after a loop where it was.
    def virgin(u: float) -> float:
        return 1.0 - (1.0 - min(u / (MU * DEPTH), 1.0)) ** 2

    part, back = 0.6 * MU * DEPTH, 0.2 * MU * DEPTH
    out, turned, again = sheared(pressed(tip_micro_slip=True), [part, back, part])
    assert out == pytest.approx(virgin(part), abs=0.01)
    assert turned == pytest.approx(out - 2.0 * virgin(0.5 * (part - back)), abs=0.01)
    assert again == pytest.approx(out, abs=1e-3)
    # To and fro with less and less takes all of it out, as a magnet is demagnetised.
    fading = [part * (-1.0) ** k * (1.0 - k / 30.0) for k in range(31)]
    (*_, left) = sheared(pressed(tip_micro_slip=True), fading)
    assert abs(left) < 0.05 * out
    (whole,) = sheared(pressed(), [0.6 * 0.5 * MU * DEPTH])
    assert whole == pytest.approx(0.6, rel=0.01), "without it a tip sticks until it slips as one"
